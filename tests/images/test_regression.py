"""Mitsuba's own render-regression scenes in its three colour modes, by Mitsuba's rule with our own variance.

The data belong to the Mitsuba project and stay out of this one: they are read from
``../shared/regression`` (scenes with media: ``../shared/regression-media``), or from the folder that
``MITSUBA_DATA`` names (that of ``tests/scenes``).
"""

import itertools
import os
import xml.etree.ElementTree as ElementTree
from pathlib import Path

import mitsuba as mi
import numpy as np
import pytest
import variants
from scipy import stats

ROOT = Path(__file__).resolve().parents[2]


def data(name: str) -> Path:
    """The folder of Mitsuba's data, or that of this ``name`` beside the project."""
    return Path(os.environ.get("MITSUBA_DATA") or ROOT.parent / "shared" / name)


DATA, MEDIA_DATA = data("regression"), data("regression-media")

SCENES = [
    "bsdf_spheres/test_pointlight_path",
    "bsdf_spheres/test_arealight_path",
    "bsdf_spheres/test_constant_path",
    "floating_sphere/test_directional_direct",
    "orthographic_sensor/test_orthographic_path",
    "projector/test_projector_constant_direct",
    "projector/test_projector_textured_direct",
    "spot_light/test_spot_direct",
]
MEDIA_SCENES = [
    "participating_media/test_homo_null_envmap_volpath",
    "participating_media/test_homo_spectral_sigmat_volpathmis",
    "participating_media/test_hetero_sigmat_volpath",
]
COLOURS = ["rgb", "mono", "spectral"]  # each has references of its own
POLARIZED = "spectral_polarized"  # of scenes without media; intensities alone
SAMPLES = 2e6  # per scene, as in Mitsuba's test
REFERENCE_SPP = 32_000
# The references' conversion between colour spaces: white is (0.95075, 1, 1.08846) in them where it
# is (0.95046, 1, 1.08875) in Mitsuba 3.9.1, and `path` itself is off by as much.
CONVERSION = 5e-4
# By how much `volpath` of Mitsuba 3.9.1 is off beside a reference, relative (.00234 +- .00034 in mono).
OLD = {"test_homo_spectral_sigmat_volpathmis": 2.5e-3}
SEEDS = 16


def needs(folder: Path):
    """Mark of a test that is skipped without these data."""
    return pytest.mark.skipif(
        not (folder / "tests" / "scenes").is_dir(),
        reason=f"Mitsuba's regression scenes are not in {folder}; MITSUBA_DATA may name another folder",
    )


def max_depth(path: Path) -> int:
    """``max_depth`` of the scene's integrator, wherever it stands; `direct` has 2."""
    root = ElementTree.parse(path).getroot()
    for integrator in root.iter("integrator"):
        for value in integrator.findall("integer[@name='max_depth']"):
            return int(value.get("value"))
    for include in root.iter("include"):
        return max_depth(path.parent / include.get("filename"))
    assert path.stem.endswith("_direct"), f"{path} names no max_depth"
    return 2


def xyz(bitmap) -> np.ndarray:
    """CIE XYZ, in which Mitsuba's test compares."""
    converted = bitmap.convert(mi.Bitmap.PixelFormat.XYZ, mi.Struct.Type.Float32, False)
    return np.array(converted, dtype=np.float64)


def xyz_of_render(image) -> np.ndarray:
    """As `xyz`; in a monochromatic variant, where images have one channel, X = Y = Z."""
    if mi.is_monochromatic:
        return np.repeat(np.array(image, dtype=np.float64)[..., :1], 3, axis=2)
    return xyz(mi.Bitmap(image[..., :3]))


def reference(path: Path, colour: str):
    """Mean and variance of a sample of Mitsuba's ``path``."""
    kind = path.stem.rpartition("_")[0]  # test_spot_direct -> test_spot
    stem = path.parent / "refs" / f"{kind}_ref_{colour}"
    return xyz(mi.Bitmap(f"{stem}.exr")), xyz(mi.Bitmap(f"{stem}_var.exr"))


def cases(folder, scenes, colours):
    """Every scene and colour mode, with all strategies and with those that a pilot chooses in turns; every
    second scene in one channel."""
    return [
        pytest.param(
            *(folder, name, colour, ("auto", "none")[(i + j) % 2]), marks=needs(folder), id=f"{name} {colour}"
        )
        for (i, name), (j, colour) in itertools.product(enumerate(scenes), enumerate(colours))
        if colour != "mono" or i % 2
    ]


@pytest.mark.parametrize(
    "folder, name, colour, skip",
    cases(DATA, SCENES, [*COLOURS, POLARIZED]) + cases(MEDIA_DATA, MEDIA_SCENES, COLOURS),
)
def test_image_is_mitsubas(folder, name, colour, skip):
    """Images made by others, on scenes with textures, masks, rough glass, meshes; with media by ``volpath``
    (``volpathmis``): fog in a null boundary, a chromatic medium, a grid around a matte ball.

    Expected: at least 99.75 % of the values pass, and the image's mean is within 4.5 sigma (plus 5e-4 for the
    references' colour conversion). Statistic: Z = |mean - ref| / sqrt(v / seeds + var / 32000 + 1e-4 / spp),
    v our variance over 16 seeds and var the reference's, Student's t with 15 degrees, Šidák at 0.01 over the
    pixels: Mitsuba's rule, but with our variance, for `path` has next to none where a bidirectional image has
    some. With 5e5 samples the rare splats of (1,1) from the sky, 6 % of a pixel each, are too few for
    Student's t. The floor of 1e-4 hides biases below 1 % in dark pixels; the mean does not.
    """
    compare(folder / "tests" / "scenes" / f"{name}.xml", colour, skip)


def rendered(scene, integrator, spp: int) -> np.ndarray:
    """CIE XYZ of `SEEDS` renders."""
    images = (mi.render(scene, integrator=integrator, spp=spp, seed=seed) for seed in range(SEEDS))
    return np.stack([xyz_of_render(image) for image in images])


def judged(images, path: Path, colour: str, spp: int) -> tuple[bool, str]:
    """Whether ``images`` pass beside the reference, and how they do."""
    ref, ref_variance = reference(path, colour)
    pixels = ref.shape[0] * ref.shape[1]
    mean, variance = images.mean(0), images.var(0, ddof=1)
    error = np.sqrt(variance / SEEDS + np.maximum(ref_variance, 0) / REFERENCE_SPP + 1e-4 / (spp * SEEDS))
    p = 2 * stats.t.sf(np.abs(mean - ref) / error, SEEDS - 1)
    passed = (p > 1 - (1 - 0.01) ** (1 / pixels)).mean()

    own = images.mean((1, 2))  # per seed and channel
    sigma = np.sqrt(
        own.var(0, ddof=1) / SEEDS + np.maximum(ref_variance, 0).mean((0, 1)) / REFERENCE_SPP / pixels
    )
    gap = np.abs(own.mean(0) - ref.mean((0, 1))) - (CONVERSION + OLD.get(path.stem, 0)) * ref.mean((0, 1))
    off = np.maximum(gap, 0) / sigma
    relative = own.mean(0) / ref.mean((0, 1)) - 1
    text = f"{passed:.4%} of values pass, mean off by {off.round(2)} sigma, relative {relative.round(5)}"
    return bool(passed >= 0.9975 and (off < 4.5).all()), text


def compare(path: Path, colour: str, skip: str):
    """Render the scene and compare it with its reference; if it fails, say how Mitsuba's integrator does."""
    mi.set_variant(variants.of(colour))
    scene, depth = mi.load_file(str(path)), max_depth(path)
    spp = int(np.ceil(SAMPLES / np.prod(scene.sensors()[0].film().size()) / SEEDS))
    bdpt = mi.load_dict({"type": "bdpt", "max_depth": depth, "skip": skip})
    ok, text = judged(rendered(scene, bdpt, spp), path, colour, spp)
    if not ok:
        name = path.stem.rpartition("_")[2]  # test_homo_null_envmap_volpath -> volpath
        theirs = mi.load_dict({"type": "path" if name == "direct" else name, "max_depth": depth})
        _, beside = judged(rendered(scene, theirs, spp), path, colour, spp)
        pytest.fail(f"{path.stem}, {mi.variant()}, skip={skip}: {text}; with Mitsuba's integrator: {beside}")
