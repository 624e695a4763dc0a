"""Colour: `colour-science` as the judge of spectra, ``path`` as that of images, in every LLVM variant.

Objects of one variant are of no use in another, so scenes are made inside the tests. Raw bitmaps are left
out: Mitsuba refuses them in spectral variants. Its dielectrics have one index for all wavelengths.

Statistics, where noise decides: the sample is the mean of a tile in one render, renders have seeds of their
own on both sides, Welch's t with Sidak's correction (see ``welch``) at 1e-3, seeds fixed.
"""

from __future__ import annotations

import warnings

import mitsuba as mi
import numpy as np
import pytest
import variants
import views
from mitsuba_bdpt.image.layers import strategies
from welch import Comparisons, assert_agree, compare_images, tile_means, welch

with warnings.catch_warnings():
    warnings.simplefilter("ignore")  # notes on packages that colour misses and that are not used here
    import colour

SIZE, TILES = 16, 4
RUNS = 24
CHANNELS = np.array([0.5, 1.0, 1.5])  # one number per pixel that sees every channel

# The variants in which a scene has colours of its own: one number, four wavelengths per sample.
VARIANTS = [variants.of("mono"), variants.of("spectral")]


def transform():
    return mi.ScalarTransform4f()


def sensor(origin, target, fov=60, kind="perspective", **more):
    return views.camera(kind, origin, target, fov, **more)


def rgb(*value):
    return {"type": "rgb", "value": list(value)}


def matte(*value):
    return {"type": "diffuse", "reflectance": rgb(*value)}


def ball(center, radius, **more):
    return {"type": "sphere", "center": list(center), "radius": radius, **more}


def bdpt(**more):
    return mi.load_dict({"type": "bdpt", **more})


def path(**more):
    return mi.load_dict({"type": "path", **more})


def renders(scene, integrator, spp, first_seed, runs=RUNS):
    """Tile means of ``runs`` renders, (runs, tiles, channels)."""
    return np.stack(
        [
            tile_means(mi.render(scene, integrator=integrator, spp=spp, seed=first_seed + i), TILES)
            for i in range(runs)
        ]
    )


def compare(a, b, label) -> Comparisons:
    """Tiles of all channels together, and each channel's mean: a wrong hue may leave their sum alone.

    The channels share their paths, so only the former take part in the test of uniformity.
    """
    weights = CHANNELS if a.shape[2] == 3 else np.ones(1)
    family = [compare_images(a @ weights, b @ weights, label)]
    for channel in range(a.shape[2]):
        a_mean, b_mean = (x[..., channel].mean(1, keepdims=True) for x in (a, b))
        alone = welch(a_mean, b_mean, label, [f"channel {channel}"])
        alone.continuous[:] = False
        family.append(alone)
    return Comparisons.join(family)


# -- spectra, judged by colour-science ---------------------------------------------------------------

NODES = colour.SpectralShape(360, 830, 5)  # those of Mitsuba's tables of the observer
OBSERVER = colour.MSDS_CMFS["CIE 1931 2 Degree Standard Observer"].copy().align(NODES)
CHART = {
    name: np.interp(NODES.wavelengths, sd.wavelengths, sd.values)
    for name, sd in colour.SDS_COLOURCHECKERS["BabelColor Average"].items()
}
ILLUMINANTS = {
    name: np.interp(NODES.wavelengths, sd.wavelengths, sd.values) / 100
    for name, sd in ((name, colour.SDS_ILLUMINANTS[name]) for name in ("A", "D65"))
}


def spectrum(values):
    """Mitsuba's plugin for values at the nodes; linear between them."""
    text = ", ".join(f"{x:.9g}" for x in values)
    return {"type": "regular", "wavelength_min": 360.0, "wavelength_max": 830.0, "values": text}


def distribution(values):
    return colour.SpectralDistribution(values, NODES)


def known_xyz(reflectances, illuminant):
    """CIE XYZ (patches, 3) by colour-science, Y of a reflectance of 1 being 1."""
    light = distribution(illuminant)
    return np.stack(
        [colour.sd_to_XYZ(distribution(r), OBSERVER, light, method="Integration") / 100 for r in reflectances]
    )


def delta_e(a, b, white):
    """CIEDE2000 (patches,) of CIE XYZ, both under the white point of XYZ ``white``."""
    xy = colour.XYZ_to_xy(white)
    return colour.delta_E(colour.XYZ_to_Lab(a, xy), colour.XYZ_to_Lab(b, xy), method="CIE 2000")


def chart_scene(reflectances, illuminant):
    """5 x 5 matte squares that fill the view, under a sky of the illuminant: each has the radiance
    reflectance x illuminant, whatever it is seen by."""
    half = np.degrees(np.arctan(1 / 3))
    scene = {
        "type": "scene",
        "sensor": sensor([0, 0, 3], [0, 0, 0], 2 * half, size=40, pixel_format="xyz"),
        "sky": {"type": "constant", "radiance": spectrum(illuminant)},
    }
    for i, reflectance in enumerate(reflectances):
        row, column = divmod(i, 5)
        scene[f"patch {i}"] = {
            "type": "rectangle",
            "to_world": transform().translate([0.4 * (column - 2), 0.4 * (2 - row), 0]).scale(0.2),
            "bsdf": {"type": "diffuse", "reflectance": spectrum(reflectance)},
        }
    return mi.load_dict(scene)


@pytest.mark.parametrize("skip", ["none", "auto"])
@pytest.mark.parametrize("name", ILLUMINANTS)
def test_colour_chart(name, skip):
    """The 24 patches of a ColorChecker (BabelColor's spectra) have the colours that colour-science computes.

    Rationale: wavelengths, their weights and the conversion to colour, against an implementation by others.
    Expected: with the white square beside them for the scale, deltaE 2000 below 0.5 for every patch: half of
    what is just visible. 64 pixels x 1024 samples per patch leave 0.07 to 0.17 of noise in the worst patch.
    """
    mi.set_variant(variants.of("spectral"))
    illuminant = ILLUMINANTS[name]
    reflectances = [*CHART.values(), np.ones(len(illuminant))]
    assert len(reflectances) == 25
    image = mi.render(chart_scene(reflectances, illuminant), integrator=bdpt(skip=skip), spp=1024)
    xyz = tile_means(image, 5)
    known = known_xyz(reflectances, illuminant)
    found = delta_e(xyz / xyz[-1, 1], known, known[-1])
    report = {patch: round(e, 3) for patch, e in zip([*CHART, "white square"], found, strict=True)}
    assert (found < 0.5).all(), report


@pytest.mark.parametrize("skip", ["none", "auto"])
def test_interreflections_multiply_spectra(skip):
    """Inside a glowing sphere of reflectance r the radiance of up to four edges is L (1 + r + r^2 + r^3).

    Rationale: the chart has no second bounce, and its strategies no inner connections; here each product of
    spectra is made in up to five ways. Expected: the colours that colour-science computes for that
    spectrum, deltaE 2000 below 0.25 (256 pixels x 256 samples leave up to 0.05 of noise); the scale is that
    of the sphere seen directly, which must have the luminance of L to 0.3 % (Mitsuba's constant for the
    observer's integral is 0.1 % smaller than the sum of its table).
    """
    mi.set_variant(variants.of("spectral"))
    light = ILLUMINANTS["A"]
    names = ["blue", "green", "red", "white 9.5 (.05 D)"]
    series = [(1 + r + r**2 + r**3) / 4 for r in (CHART[name] for name in names)]
    known = known_xyz(series, light)
    found = []
    for name in names:
        scene = {
            "type": "scene",
            "sensor": sensor([0.1, -0.05, 0.5], [0, 0, -1], pixel_format="xyz"),
            "wall": ball(
                [0, 0, 0],
                1,
                flip_normals=True,
                bsdf={"type": "diffuse", "reflectance": spectrum(CHART[name])},
                emitter={"type": "area", "radiance": spectrum(light)},
            ),
        }
        scene = mi.load_dict(scene)
        glow, image = (
            np.array(mi.render(scene, integrator=bdpt(skip=skip, max_depth=k), spp=256), float).mean((0, 1))
            for k in (1, 4)
        )
        found.append(image / glow[1] / 4)
        # Mitsuba's unit of luminance: that of a spectrum of 1 is 1.
        assert glow[1] == pytest.approx(
            (light * OBSERVER.values[:, 1]).sum() / OBSERVER.values[:, 1].sum(), rel=0.003
        )
    errors = delta_e(np.array(found), known, known_xyz([np.ones(len(light))], light)[0])
    assert (errors < 0.25).all(), dict(zip(names, errors.round(3), strict=True))


# -- images, judged by path --------------------------------------------------------------------------


def lamps():
    """Coloured lamps of three kinds in a closed room, seen through a lens. The point lamps are behind the
    sensor, for ``path`` does not see them directly."""
    return {
        "sensor": sensor(
            [0.1, -0.05, 0.5], [0, 0, -1], kind="thinlens", aperture_radius=0.08, focus_distance=1.2
        ),
        "wall": ball([0, 0, 0], 1, flip_normals=True, bsdf=matte(0.7, 0.5, 0.3)),
        "gold": ball(
            [-0.35, -0.25, -0.25], 0.3, bsdf={"type": "roughconductor", "material": "Au", "alpha": 0.3}
        ),
        "lamp": ball(
            [0.25, 0.3, -0.2],
            0.2,
            bsdf=matte(0, 0, 0),
            emitter={
                "type": "area",
                "radiance": {"type": "spectrum", "value": [(400, 1), (500, 3), (600, 6), (700, 8)]},
            },
        ),
        "point": {"type": "point", "position": [0.1, 0.2, 0.55], "intensity": rgb(0.1, 0.4, 0.9)},
        "spot": {
            "type": "spot",
            "to_world": transform().look_at([-0.2, 0.2, 0.6], [-0.1, -0.3, -1], [0, 1, 0]),
            "intensity": rgb(3, 1, 0.5),
            "cutoff_angle": 40,
            "beam_width": 20,
        },
    }


def outside():
    """A coloured floor with a ball of glass and one of plastic."""
    return {
        "sensor": sensor([0, 1.2, 4], [0, 0.3, 0], 35),
        "floor": {
            "type": "rectangle",
            "to_world": transform().rotate([1, 0, 0], -90).scale(3),
            "bsdf": matte(0.2, 0.5, 0.7),
        },
        "glass": ball([-0.6, 0.55, 0], 0.5, bsdf={"type": "dielectric", "int_ior": "bk7"}),
        "plastic": ball(
            [0.6, 0.55, -0.2], 0.5, bsdf={"type": "plastic", "diffuse_reflectance": rgb(0.6, 0.1, 0.2)}
        ),
    }


def sky():
    return outside() | {"sky": {"type": "constant", "radiance": rgb(0.5, 0.8, 1.1)}}


def picture(height, width, seed):
    """A bitmap of smooth colours between 0.1 and 0.9."""
    phase = np.random.default_rng(seed).random((2, 3)) * 2 * np.pi
    y, x = np.meshgrid(
        *(np.linspace(0, 2 * np.pi, n, endpoint=False) for n in (height, width)), indexing="ij"
    )
    value = 0.5 + 0.4 * np.sin(x[..., None] + phase[0]) * np.cos(y[..., None] + phase[1])
    return mi.Bitmap(value.astype(np.float32))


def textures():
    """A coloured surrounding, and a lamp that is a picture."""
    return outside() | {
        "around": {"type": "envmap", "bitmap": picture(8, 16, 1)},
        "lamp": {
            "type": "rectangle",
            "to_world": transform().translate([0, 1.6, -1.2]).rotate([1, 0, 0], 30).scale(0.7),
            "bsdf": matte(0, 0, 0),
            "emitter": {"type": "area", "radiance": {"type": "bitmap", "bitmap": picture(8, 8, 2)}},
        },
    }


@pytest.mark.parametrize("make", [lamps, sky, textures])
@pytest.mark.parametrize("variant", VARIANTS)
def test_scene_equals_path(variant, make):
    """Coloured lamps and surfaces of every kind, in one number and in four wavelengths.

    Rationale: emission, next-event estimation, splats and connections each evaluate spectra themselves.
    Expected: with all strategies and by default the mean of ``path``'s renders. Statistic: Welch per tile
    and per channel, Sidak; Kolmogorov-Smirnov.
    """
    mi.set_variant(variant)
    scene = mi.load_dict({"type": "scene", **make()})
    reference = renders(scene, path(max_depth=5), 256, 0)
    family = [
        compare(reference, renders(scene, bdpt(max_depth=5, skip=skip), 64, seed), f"{make.__name__} {skip}")
        for skip, seed in (("none", 1000), ("auto", 2000))
    ]
    assert_agree(Comparisons.join(family), at_least=24)


UNPOLARIZED = [v for v in mi.variants() if v.startswith(variants.BACKEND) and not v.endswith("polarized")]


def test_every_colour_mode_is_there():
    """The wheel has a variant of each colour mode for the test below (the others are refused in words, see
    ``test_properties``)."""
    assert {variants.of("rgb"), variants.of("mono"), variants.of("spectral")} <= set(UNPOLARIZED)


@pytest.mark.parametrize("variant", UNPOLARIZED)
def test_cornell_box(variant):
    """Every LLVM variant that is neither scalar nor polarized renders the Cornell box.

    Expected: with all strategies and by default the mean of ``path``'s renders. Statistic: Welch per tile
    and per channel, Sidak; Kolmogorov-Smirnov.
    """
    mi.set_variant(variant)
    scene = mi.cornell_box()
    scene["sensor"]["film"].update(width=SIZE, height=SIZE, rfilter={"type": "box"})
    scene = mi.load_dict(scene)
    reference = renders(scene, path(max_depth=6), 128, 0)
    family = [
        compare(reference, renders(scene, bdpt(max_depth=6, skip=skip), 32, seed), f"{variant} {skip}")
        for skip, seed in (("none", 1000), ("auto", 2000))
    ]
    assert_agree(Comparisons.join(family), at_least=24)


# -- strategies, judged by each other ----------------------------------------------------------------

DEPTH = 4


def unweighted(scene, first_seed):
    """Tile means of each strategy's own image, {(s, t): (runs, tiles)}; layers are RGB in every variant."""
    integrator = bdpt(skip="none", rr_depth=100, max_depth=DEPTH, layers="strategies")
    tiles = renders(scene, integrator, 64, first_seed)
    layers = tiles[..., -6 * len(strategies(DEPTH)) :].reshape(RUNS, TILES**2, -1, 2, 3) @ CHANNELS
    return {(s, t): layers[:, :, i, 1] for i, (_, s, t) in enumerate(strategies(DEPTH))}


@pytest.mark.parametrize("variant", VARIANTS)
def test_strategies_agree(variant):
    """Every strategy alone makes the same image of the paths of one length, in colour too.

    Rationale: they evaluate the spectra of lamp and surfaces from either end; a strategy of small weight
    could be wrong and not be seen in the sum. Inside a sphere each has a finite variance. Expected: for
    k = 1 ... 4 the unweighted image of (s, t) has the mean of the next one's. Statistic: Welch per tile
    (the images compared come from different seeds), Sidak; Kolmogorov-Smirnov.
    """
    mi.set_variant(variant)
    parts = {name: part for name, part in lamps().items() if name in ("wall", "gold", "lamp")}
    parts["sensor"] = sensor([0.1, -0.05, 0.5], [0, 0, -1])
    scene = mi.load_dict({"type": "scene", **parts})
    a, b = unweighted(scene, 0), unweighted(scene, 1000)
    family = [
        compare_images(a[s, k + 1 - s], b[s + 1, k - s], f"k={k} s={s} vs s={s + 1}")
        for k in range(1, DEPTH + 1)
        for s in range(k)
    ]
    assert_agree(Comparisons.join(family), at_least=100)
