"""Denoised images: ``layers=denoised`` of the integrator, ``--denoise`` of the command."""

import sys
from pathlib import Path

import mitsuba as mi
import numpy as np
import OpenEXR
import pytest
import repository
from mitsuba_bdpt.cli.arguments import main
from mitsuba_bdpt.errors import UnsupportedError, UsageError
from mitsuba_bdpt.image import denoising
from mitsuba_bdpt.measure.metrics import TRIM, rel_mse

SCENES = ("cornell_box", "glass_caustics", "veach_bidir", "ajar_door", "uplight_room", "open_sky")
SIZE, SPP = 128, 16


def layers(scene, sensor=0):
    """Names of the film's channels after those of the colours."""
    return [channel.name for channel in scene.sensors()[sensor].film().bitmap().struct_()]


def guides(scene) -> tuple[np.ndarray, np.ndarray]:
    """Albedo and normals by Mitsuba's plugin ``aov``, which has no normals of maps in world space."""
    aov = mi.load_dict({"type": "aov", "aovs": denoising.GUIDES})
    image = np.array(mi.render(scene, integrator=aov, spp=64, seed=7))
    return image[..., -6:-3], image[..., -3:]


@pytest.mark.parametrize("name", SCENES)
def test_what_it_does_to_the_error(name):
    """At most three quarters of the relMSE; the colours are those without the parameter. Of bdpt trimmed: in
    six pixels beside the lamp of `glass_caustics` halos are more than all noise of guided renders. Of `path`
    raw: fireflies are its noise. (Not in `veach_mis`: docs/development/experiments.md, "Denoising".)"""
    scene, depth = repository.load_scene(name, resolution=SIZE), repository.benchmark_depth(name)
    expected = repository.load_reference(name, SIZE, depth).image
    common = {"type": "bdpt", "max_depth": depth}
    raw = np.array(mi.load_dict(common).render(scene, seed=1, spp=SPP))[..., :3]
    both = np.array(mi.load_dict(common | {"layers": "denoised"}).render(scene, seed=1, spp=SPP))
    assert layers(scene)[-3:] == ["denoised.R", "denoised.G", "denoised.B"]
    found = both[..., -3:]
    assert np.all(np.isfinite(found)) and np.allclose(both[..., :3], raw, rtol=1e-4, atol=1e-5)
    before, after = rel_mse(raw, expected, TRIM), rel_mse(found, expected, TRIM)
    assert after < 0.75 * before, (before, after)
    path = np.array(mi.load_dict({"type": "path", "max_depth": depth}).render(scene, seed=1, spp=SPP))
    found = denoising.denoised(path[..., :3], *guides(scene))
    assert np.all(np.isfinite(found))
    assert rel_mse(found, expected) < 0.75 * rel_mse(path[..., :3], expected)


def test_other_layers_are_untouched():
    scene = repository.load_scene("cornell_box", resolution=16)
    more = {"aovs": "albedo:albedo,dd:depth", "max_depth": 3}
    images = {}
    for on in (False, True):
        made = mi.load_dict({"type": "bdpt", "layers": "variance,strategies" + ",denoised" * on, **more})
        images[on] = np.array(made.render(scene, spp=16)), layers(scene)
    (without, names), (image, more_names) = images[False], images[True]
    first = names.index("variance.R")
    assert more_names == [*names[:first], "denoised.R", "denoised.G", "denoised.B", *names[first:]]
    kept = np.delete(image, slice(first, first + 3), axis=-1)
    assert np.allclose(kept, without, rtol=1e-4, atol=1e-5)


def test_a_film_that_keeps_alpha_or_luminance():
    """Alpha is no colour: among them it would move the mean by half and more; the denoiser blurs by less than
    a tenth."""
    for pixel_format, channels in (("rgba", 4), ("luminance", 1)):
        described = mi.cornell_box()
        described["sensor"]["film"] |= {"width": 16, "height": 16, "pixel_format": pixel_format}
        scene = mi.load_dict(described)
        image = np.array(mi.load_dict({"type": "bdpt", "layers": "denoised"}).render(scene, spp=4))
        assert image.shape[-1] == channels + 3 and np.all(np.isfinite(image))
        colours = image[..., : min(channels, 3)]
        assert abs(image[..., -3:].mean() / colours.mean() - 1) < 0.1


def test_what_is_refused(monkeypatch):
    mi.set_variant("llvm_ad_spectral")
    described = mi.cornell_box()
    described["sensor"]["film"] = {
        "type": "specfilm",
        "width": 8,
        "height": 8,
        "band": {"type": "spectrum", "value": [(400, 1.0), (700, 1.0)]},
    }
    made = mi.load_dict({"type": "bdpt", "layers": "denoised"})
    with pytest.raises(UnsupportedError, match="layers=denoised is not possible with film"):
        made.render(mi.load_dict(described), spp=1)
    mi.set_variant("llvm_ad_rgb")
    made = mi.load_dict({"type": "bdpt", "layers": "denoised"})
    monkeypatch.setitem(sys.modules, "mitsuba_oidn", None)
    with pytest.raises(UsageError, match=r"pip install 'mitsuba-bdpt\[denoise\]'"):
        made.render(mi.load_dict(mi.cornell_box()), spp=1)


def test_the_command(tmp_path, capsys):
    """The PNG shows the denoised image."""
    scene = str(Path(repository.SCENES) / "cornell_box.xml")
    arguments = ["render", scene, "--size", "32x32", "--spp", "4", "-o", str(tmp_path / "a.exr")]
    assert main([*arguments, "--denoise"]) == 0
    channels = OpenEXR.File(str(tmp_path / "a.exr"), separate_channels=True).channels()
    raw, found = (np.stack([channels[p + c].pixels for c in "RGB"], axis=-1) for p in ("", "denoised."))
    assert not np.allclose(raw, found, rtol=0.05)
    shown = np.array(
        mi.Bitmap(str(tmp_path / "a.png")).convert(mi.Bitmap.PixelFormat.RGB, mi.Struct.Type.Float32, False)
    )
    assert np.abs(shown - np.clip(found, 0, 1)).max() < 0.02 < np.abs(shown - np.clip(raw, 0, 1)).max()
    assert main([*arguments, "--denoise", "--integrator", "path"]) == 2
    assert "denoise is for the integrator bdpt, not for path" in capsys.readouterr().err
