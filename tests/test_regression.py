"""Mitsuba's own render-regression scenes, by Mitsuba's rule with our own variance.

The data belong to the Mitsuba project and stay out of this one: they are read from
``../shared/regression``, or from the folder that ``MITSUBA_DATA`` names (that of ``tests/scenes``).
"""

import os
import xml.etree.ElementTree as ElementTree
from pathlib import Path

import mitsuba as mi
import numpy as np
import pytest
from scipy import stats

ROOT = Path(__file__).resolve().parents[1]
DATA = Path(os.environ.get("MITSUBA_DATA") or ROOT.parent / "shared" / "regression")

# Those with a perspective sensor and no projector.
SCENES = [
    "bsdf_spheres/test_pointlight_path",
    "bsdf_spheres/test_arealight_path",
    "bsdf_spheres/test_constant_path",
    "floating_sphere/test_directional_direct",
    "spot_light/test_spot_direct",
]
SAMPLES = 2e6  # per scene, as in Mitsuba's test
REFERENCE_SPP = 32_000
# The references' conversion between colour spaces: white is (0.95075, 1, 1.08846) in them where it
# is (0.95046, 1, 1.08875) in Mitsuba 3.9.1, and `path` itself is off by as much.
CONVERSION = 5e-4
SEEDS = 16

pytestmark = pytest.mark.skipif(
    not (DATA / "tests" / "scenes").is_dir(),
    reason=f"Mitsuba's regression scenes are not in {DATA}; MITSUBA_DATA may name another folder",
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


def reference(path: Path):
    """Mean and variance of a sample of Mitsuba's ``path``."""
    kind = path.stem.rpartition("_")[0]  # test_spot_direct -> test_spot
    stem = path.parent / "refs" / f"{kind}_ref_rgb"
    return xyz(mi.Bitmap(f"{stem}.exr")), xyz(mi.Bitmap(f"{stem}_var.exr"))


def test_depths_are_found():
    """The depths of paths, read through an included fragment and from the name."""
    depths = {name: max_depth(DATA / "tests" / "scenes" / f"{name}.xml") for name in SCENES}
    assert set(depths.values()) == {2}


@pytest.mark.parametrize("skip", ["none", "auto"])
@pytest.mark.parametrize("name", SCENES)
def test_image_is_mitsubas(name, skip):
    """Our image equals the reference that Mitsuba ships.

    Rationale: images made by others, on scenes with textures, masks, rough glass, meshes. Expected:
    at least 99.75 % of the values pass, and the image's mean is within 4.5 sigma (plus 5e-4 for the
    references' colour conversion). Statistic:
    Z = |mean - ref| / sqrt(v / seeds + var / 32000 + 1e-4 / spp) with v our variance over 16 seeds
    and var the reference's, Student's t with 15 degrees, Sidak at 0.01 over the pixels: Mitsuba's
    rule, but with our variance, for `path` has next to none where a bidirectional image has some.
    2e6 samples in total; with 5e5 the rare splats of (1,1) from the sky, 6 % of a pixel each, are too
    few for Student's t. The floor of 1e-4 hides biases below 1 % in dark pixels; the mean does not.
    """
    path = DATA / "tests" / "scenes" / f"{name}.xml"
    scene = mi.load_file(str(path))
    ref, ref_variance = reference(path)
    pixels = ref.shape[0] * ref.shape[1]
    spp = int(np.ceil(SAMPLES / pixels / SEEDS))
    integrator = mi.load_dict({"type": "bdpt", "max_depth": max_depth(path), "skip": skip})
    images = []
    for seed in range(SEEDS):
        image = mi.render(scene, integrator=integrator, spp=spp, seed=seed)
        images.append(xyz(mi.Bitmap(image[..., :3])))
    images = np.stack(images)
    mean, variance = images.mean(0), images.var(0, ddof=1)
    error = np.sqrt(variance / SEEDS + np.maximum(ref_variance, 0) / REFERENCE_SPP + 1e-4 / (spp * SEEDS))
    p = 2 * stats.t.sf(np.abs(mean - ref) / error, SEEDS - 1)
    passed = (p > 1 - (1 - 0.01) ** (1 / pixels)).mean()

    own = images.mean((1, 2))  # per seed and channel
    sigma = np.sqrt(
        own.var(0, ddof=1) / SEEDS + np.maximum(ref_variance, 0).mean((0, 1)) / REFERENCE_SPP / pixels
    )
    gap = np.abs(own.mean(0) - ref.mean((0, 1))) - CONVERSION * ref.mean((0, 1))
    off = np.maximum(gap, 0) / sigma
    relative = own.mean(0) / ref.mean((0, 1)) - 1
    report = (
        f"{name}, skip={skip}: {passed:.4%} of values pass, mean off by {off.round(2)} sigma, "
        f"relative {relative.round(5)}"
    )
    assert passed >= 0.9975, report
    assert (off < 4.5).all(), report
