"""Scenes in other units, in other places, turned, under other lights."""

import xml.etree.ElementTree as ElementTree

import mitsuba as mi
import numpy as np
import pytest
import repository
from mitsuba_bdpt.measure.agreement import Sample, welch
from scipy.spatial.transform import Rotation

from .compare import WAYS, family, tiles

DEPTH, SIZE = 6, 32

# Samples per pixel of each way to render: by default so many that a pilot decides.
SPP = {"defaults": 128, "all strategies": 16}

# The scene of each kind of emitter.
SCENES = {
    "area": "cornell_box",
    "point": "lamp_behind_glass",
    "envmap": "window_room",
    "sun": "smallvcm_cornell_sun",
    "lens": "thin_lens",
}


# -- placing a scene of scenes/ -------------------------------------------------------------------


def numbers(text):
    return np.array([float(x) for x in text.replace(",", " ").split()])


def text(values) -> str:
    return " ".join(repr(float(x)) for x in np.ravel(values))  # all digits: powers of two stay exact


def times(element, factor, *names):
    for found in element.findall("*[@value]"):
        if found.get("name") in names:
            found.set("value", text(numbers(found.get("value")) * factor))


def append(element, linear, shift=(0, 0, 0)):
    """Add a matrix to ``to_world``."""
    matrix = np.eye(4)
    matrix[:3, :3], matrix[:3, 3] = linear, shift
    to_world = element.find("transform[@name='to_world']")
    if to_world is None:
        to_world = ElementTree.SubElement(element, "transform", name="to_world")
    ElementTree.SubElement(to_world, "matrix", value=text(matrix))


def look_from(element, scale, turn, shift):
    """Sensors must not be scaled themselves."""
    for lookat in element.iter("lookat"):
        for key in ("origin", "target"):
            lookat.set(key, text(numbers(lookat.get(key)) * scale))
    append(element, turn, shift)


def place_emitter(emitter, scale, turn, shift, light):
    times(emitter, light, "radiance", "irradiance", "intensity")
    times(emitter, scale**2, "intensity")
    vector = emitter.find("*[@x]")
    values = None if vector is None else np.array([float(vector.get(axis)) for axis in "xyz"])
    if emitter.get("type") in ("point", "directional"):
        point = emitter.get("type") == "point"
        for axis, value in zip(
            "xyz", turn @ (values * scale) + shift if point else turn @ values, strict=True
        ):
            vector.set(axis, repr(float(value)))
    elif emitter.get("type") == "envmap":
        append(emitter, turn)
        ElementTree.SubElement(emitter, "float", name="scale", value=repr(light))


def placed(kind, scale=1.0, turn=np.eye(3), shift=(0.0, 0.0, 0.0), light=1.0):  # noqa: B008
    """The scene with all lengths times ``scale`` (and intensities times its square, so that radiances stay),
    turned, moved by ``shift``; what emitters shine times ``light``."""
    root = ElementTree.parse(repository.scene_file(SCENES[kind])).getroot()
    for file in root.iterfind(".//string[@name='filename']"):
        file.set("value", str(repository.ROOT / "scenes" / file.get("value")))
    sensor = root.find("sensor")
    for name, default in (("near_clip", "0.01"), ("far_clip", "1e4")):
        if sensor.find(f"*[@name='{name}']") is None:
            ElementTree.SubElement(sensor, "float", name=name, value=default)
    times(sensor, scale, "near_clip", "far_clip", "aperture_radius", "focus_distance")
    look_from(sensor, scale, turn, shift)
    for shape in root.findall("shape"):
        append(shape, turn * scale, shift)
    for emitter in root.iter("emitter"):
        place_emitter(emitter, scale, turn, shift, light)
    return mi.load_string(ElementTree.tostring(root, encoding="unicode"), parallel=False, resolution=SIZE)


TURN = Rotation.from_rotvec(np.deg2rad(35.7) * np.array([1, 2, 3]) / np.sqrt(14)).as_matrix()
SMALL, LARGE = {"scale": 1e-4, "turn": TURN}, {"scale": 1e4, "turn": TURN}


# -- comparisons ----------------------------------------------------------------------------------

# How far two images that should be equal in every digit may be apart, over their mean: the order in which
# pixels' sums are taken, and an intensity that Mitsuba's point lights round differently at each distance. And
# where only the rounding of all lengths differs.
EXACT, NEAR = 1e-5, 1e-3

# Share of the pixels that may differ all the same: those in whose draws something took part that is 0 in
# single precision in one unit and not in the other, or is rounded another way, as tables of emission are. In
# `thin_lens` connections of copper with copper (Beckmann's distribution, 1e-20 each) are 0 until lights are
# times 2^28; the threshold of roulette follows their cost: 2 % of the pixels, by 3e-3 at most.
DRAWN = 0.04

# How far the means of such images may be apart, relative: a pixel that differs is off by a share of its own
# value, and `DRAWN` of them by a fortieth each make a thousandth of the mean.
MEANS = 1e-3


def rendered(kind, place, parameters, spp):
    """Image, what was decided, and the figures that go into draws."""
    integrator = mi.load_dict({"type": "bdpt", "max_depth": DEPTH} | parameters)
    image = np.array(integrator.render(placed(kind, **place), seed=3, spp=spp), dtype=np.float64)
    assert integrator.statistics["non_finite"] == 0
    keys = ("light_paths", "connections", "coefficients"), ("cost", "emission")
    made = integrator.statistics["decisions"]
    return image, *([[record[key] for key in names] for record in made] for names in keys)


def same(kind, places, digits, **parameters):
    """Images in all ``places`` equal the first one (over the light), and so do the decisions; one seed."""
    for way, of_way in WAYS.items():
        plain, decided, draws = rendered(kind, places[0], of_way | parameters, SPP[way])
        assert bool(decided) == (way == "defaults")
        for place in places[1:]:
            image, ours, drawn = rendered(kind, place, of_way | parameters, SPP[way])
            assert ours == decided
            image /= place.get("light", 1.0)
            differing = (np.abs(image - plain) / plain.mean() > (digits if drawn == draws else DRAWN)).mean()
            mean = image.mean() / plain.mean()
            print(f"{100 * differing:.2g} % of the pixels differ, means by {mean - 1:.1g}")
            assert differing <= DRAWN
            assert abs(mean - 1) < MEANS


@pytest.mark.parametrize("kind", SCENES)
@pytest.mark.parametrize("what, exponents", [("scale", (-13, -10, 10, 13)), ("light", (-40, -20, 20, 40))])
def test_powers_of_two(what, exponents, kind):
    """A scene with an area light, a point light, an environment with a sun, a sun, a thin lens; all
    lengths times 2^-13 to 2^13, or all lights times 2^-40 to 2^40.

    Expected: the same image, seed for seed, by default and with all strategies, and the same decision of the
    pilot; its mean to 0.001. Powers of two are exact in floating point: 4 % of the pixels may differ by more
    than 1e-5 of the mean, where something takes part in a draw that is 0 in one of the units.
    """
    same(kind, [{}, *({what: 2.0**k} for k in exponents)], EXACT)


@pytest.mark.parametrize("kind", SCENES)
def test_turned(kind):
    """These scenes turned by 35.7° about (1, 2, 3), lengths times 1e-4 and 1e4.

    Expected: tile means as of the plain scene (other seeds, 5 a side): Welch's t-test with Šidák at 1e-3,
    standard error of a tile below 2 % of the mean. At 1e-4 the image and the decision of 1e4, seed for seed
    (`guiding=photons`: a path that rounding sends another way changes the tables, and so all draws): 4 % of
    the pixels may differ by more than 1e-3 of the mean, where rounding does that, the image's mean by 1e-3.
    """
    # So many samples that a tile that is off by nine standard errors is seen every other time.
    more = {"defaults": 2, "all strategies": 8}
    pairs = [
        [
            Sample.of(tiles(placed(kind, **place), WAYS[way] | {"max_depth": DEPTH}, seeds, spp))
            for place, seeds in ((SMALL, range(10, 15)), ({}, range(5)))
        ]
        for way, spp in ((way, SPP[way] * more[way] * (4 if kind == "lens" else 1)) for way in WAYS)
    ]
    family(pairs, 0.02)
    same(kind, [SMALL, LARGE], NEAR, guiding="photons")


def deviation(kind, parameters, spp):
    """Root mean square of what the tiles of the moved scene are off, less noise, and that noise; over the
    mean."""
    moved = {"shift": (7000.0, -5000.0, 5000.0)}
    a, b = (
        Sample.of(tiles(placed(kind, **place), parameters | {"max_depth": DEPTH}, seeds, spp))
        for place, seeds in (({}, range(5)), (moved, range(10, 15)))
    )
    found = welch(a, b)
    noise = (found.error**2).mean()
    return [float(np.sqrt(max(x, 0)) / a.mean.mean()) for x in ((found.value**2).mean() - noise, noise)]


@pytest.mark.parametrize("kind", SCENES)
def test_moved(kind):
    """These scenes moved by 1e4.

    Expected: tiles off by less than 3 % of the mean (5 % for lamps of radius 0.04; root mean square, less
    noise; its standard error is below a third of that): coordinates of 1e4 have steps of 1e-3, rays start
    0.01 to 0.02 off a surface (32 steps of 2^-24); scenes are 2 to 5 wide. `path`, where it sees the light,
    is off by more.
    """
    most, more = (0.05, 4) if kind == "lens" else (0.03, 1)
    times = {"defaults": 4, "all strategies": 16}
    found = [deviation(kind, WAYS[way], SPP[way] * times[way] * more) for way in WAYS]
    ours, error = (max(values) for values in zip(*found, strict=True))
    print(f"tiles off by {100 * ours:.2g} %, standard error {100 * error:.2g} %")
    assert ours < most
    assert error < most / 3
    if kind != "point":  # behind glass
        theirs, _ = deviation(kind, {"type": "path"}, 128 * more)
        print(f"under `path` by {100 * theirs:.2g} %")
        assert ours < theirs
