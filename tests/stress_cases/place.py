"""Scenes in other units, in other places, turned, under other lights."""

from __future__ import annotations

import xml.etree.ElementTree as ElementTree
from dataclasses import dataclass
from functools import partial

import numpy as np
import repository
from mitsuba_bdpt.measure.agreement import Sample

import mitsuba as mi  # isort: skip

from .agreement import WAYS, deviation, family, greens, together
from .case import Outcome, of_section

_case = of_section("Scale and place")
DEPTH, SIZE = 6, 32

# Samples per pixel of each way to render: by default so many that a pilot decides.
SPP = {"default parameters": 128, "all strategies": 16}


# -- placing a scene of scenes/ ---------------------------------------------------------------


def rotation(axis, degrees):
    """Matrix of a turn about an axis."""
    x, y, z = np.asarray(axis, dtype=float) / np.linalg.norm(axis)
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    angle = np.deg2rad(degrees)
    return np.eye(3) + np.sin(angle) * cross + (1 - np.cos(angle)) * cross @ cross


@dataclass(frozen=True)
class Place:
    """Where a scene is put, and how bright its light is.

    All lengths times ``scale`` (and intensities times its square, so that radiances stay), turned, moved by
    ``shift``; ``light``: times what all emitters shine.
    """

    scale: float = 1.0
    turn: object = None
    shift: tuple = (0.0, 0.0, 0.0)
    light: float = 1.0

    @property
    def rotation(self):
        return np.eye(3) if self.turn is None else self.turn

    def point(self, p):
        """Where a point comes to lie."""
        return self.rotation @ (self.scale * np.asarray(p)) + self.shift


def _numbers(text):
    return np.array([float(x) for x in text.replace(",", " ").split()])


def _text(values) -> str:
    return " ".join(repr(float(x)) for x in np.ravel(values))  # all digits: powers of two stay exact


def _vector(element):
    if element.get("value"):
        return _numbers(element.get("value"))
    return np.array([float(element.get(axis, 0)) for axis in "xyz"])


def _set_vector(element, values):
    element.attrib.pop("value", None)
    for axis, value in zip("xyz", values, strict=True):
        element.set(axis, repr(float(value)))


def _times(element, factor, *names):
    for name in names:
        for found in element.findall(f"*[@name='{name}']"):
            if found.get("value"):
                found.set("value", _text(_numbers(found.get("value")) * factor))


def _to_world(element):
    found = element.find("transform[@name='to_world']")
    if found is None:
        found = ElementTree.SubElement(element, "transform", name="to_world")
    return found


def _append(element, linear, shift=(0, 0, 0)):
    matrix = np.eye(4)
    matrix[:3, :3], matrix[:3, 3] = linear, shift
    ElementTree.SubElement(_to_world(element), "matrix", value=_text(matrix))


def _look_from(element, place: Place):
    """Sensors and spots must not be scaled themselves."""
    for lookat in element.iter("lookat"):
        for key in ("origin", "target"):
            lookat.set(key, _text(_numbers(lookat.get(key)) * place.scale))
    _append(element, place.rotation, place.shift)


def _full_path(element):
    for file in element.findall("string[@name='filename']"):
        file.set("value", str(repository.ROOT / "scenes" / file.get("value")))


def _place_sensor(sensor, place: Place):
    for name, default in (("near_clip", 0.01), ("far_clip", 1e4)):
        if sensor.find(f"*[@name='{name}']") is None:
            ElementTree.SubElement(sensor, "float", name=name, value=str(default))
    _times(sensor, place.scale, "near_clip", "far_clip", "aperture_radius", "focus_distance")
    _look_from(sensor, place)


def _place_emitter(emitter, place: Place):
    kind = emitter.get("type")
    _times(emitter, place.light, "radiance", "irradiance", "intensity")
    if kind in ("point", "spot"):
        _times(emitter, place.scale**2, "intensity")
    if kind == "point":
        position = emitter.find("point[@name='position']")
        _set_vector(position, place.point(_vector(position)))
    elif kind == "spot":
        _look_from(emitter, place)
    elif kind == "directional":
        direction = emitter.find("vector[@name='direction']")
        _set_vector(direction, place.rotation @ _vector(direction))
    elif kind == "envmap":
        _full_path(emitter)
        _append(emitter, place.rotation)
        ElementTree.SubElement(emitter, "float", name="scale", value=repr(place.light))


def _spot_for_point(root):
    """The point light of a scene becomes a spot that shines down."""
    emitter = root.find("emitter[@type='point']")
    emitter.set("type", "spot")
    position = emitter.find("point[@name='position']")
    origin = _vector(position)
    emitter.remove(position)
    lookat = {"origin": _text(origin), "target": _text(origin - [0.1, -0.2, 1]), "up": "0 1 0"}
    ElementTree.SubElement(_to_world(emitter), "lookat", lookat)
    ElementTree.SubElement(emitter, "float", name="cutoff_angle", value="60")


@dataclass(frozen=True)
class Subject:
    """A scene of scenes/ and how it is compared.

    What of it matters here, what is changed in its file, whether `path` sees its light, how many times the
    usual samples it takes, and how far off its tiles may be far away.
    """

    scene: str
    words: str
    edit: object = None
    by_path: bool = True
    samples: int = 1
    moved: float = 0.03

    def load(self, place: Place = Place(), size: int = SIZE):
        """The scene in its place."""
        root = ElementTree.parse(repository.scene_file(self.scene)).getroot()
        if self.edit is not None:
            self.edit(root)
        for sensor in root.findall("sensor"):
            _place_sensor(sensor, place)
        for shape in root.findall("shape"):
            _full_path(shape)
            _append(shape, place.rotation * place.scale, place.shift)
        for emitter in root.iter("emitter"):
            _place_emitter(emitter, place)
        text = ElementTree.tostring(root, encoding="unicode")
        return mi.load_string(text, parallel=False, resolution=size)


SUBJECTS = {
    "area": Subject("cornell_box", "`cornell_box` (area light)"),
    "point": Subject("lamp_behind_glass", "`lamp_behind_glass` (point light, glass, a mesh)", by_path=False),
    "spot": Subject(
        "smallvcm_cornell_point",
        "`smallvcm_cornell_point` with a spot for its lamp (glass, mirror)",
        _spot_for_point,
    ),
    "envmap": Subject("window_room", "`window_room` (environment with a sun)"),
    "sun": Subject("smallvcm_cornell_sun", "`smallvcm_cornell_sun` (directional light, glass, mirror)"),
    # Its lamps have radii of 0.04 and 0.06: rays start up to half of that off the floor and the lamps.
    "lens": Subject(
        "thin_lens", "`thin_lens` (thin lens, lamps on spheres and a disk, glass)", samples=4, moved=0.05
    ),
}


# -- what is compared -------------------------------------------------------------------------


# Times as many samples for tests of tiles, so that the standard error of a tile is below `MOST_ERROR` of the
# mean. (With 5 seeds a side and 64 comparisons a tile that is off by nine of them is seen every other time.)
MORE = {"default parameters": 2, "all strategies": 8}
MOST_ERROR = 0.02

# How far pixels of images that should be equal up to the rounding of all lengths may be apart, over the mean.
NEAR = 1e-3


def _render(scene, parameters, spp, seed):
    """Image, and the statistics of bdpt."""
    integrator = mi.load_dict({"type": "bdpt", "max_depth": DEPTH} | parameters)
    image = np.array(integrator.render(scene, seed=seed, spp=spp), dtype=np.float64)
    return image, integrator.statistics


def _decided(statistics, keys=("light_paths", "connections", "coefficients")):
    """What was decided; by default without figures."""
    return [[record[key] for key in keys] for record in statistics["decisions"]]


# How far two images that should be equal in every digit may be apart, over their mean: the order in which
# pixels' sums are taken, and an intensity that Mitsuba's point lights round differently at each distance.
EXACT = 1e-5

# Share of the pixels that may differ all the same: those in whose draws something took part that is 0 in
# single precision in one unit and not in the other, or is rounded another way, as tables of emission are. In
# `thin_lens` connections of copper with copper (Beckmann's distribution, 1e-20 each) are 0 until lights are
# times 2^28; the threshold of roulette follows their cost: 2 % of the pixels, by 3e-3 at most.
DRAWN = 0.04

# How far the means of such images may be apart, relative: a pixel that differs is off by a share of its own
# value, and `DRAWN` of them by a fortieth each make a thousandth of the mean.
MEANS = 1e-3


def _exact(subject: Subject, places: dict) -> Outcome:
    """Images in all ``places`` equal the plain one (times the light) in every digit; so do the decisions.

    One seed.
    """
    return _equal(subject, Place(), places, EXACT)


def _equal(subject: Subject, first: Place, places: dict, digits: float, **parameters) -> Outcome:
    """Images in all ``places`` equal that of the ``first`` one (times the light), and so do the decisions.

    One seed; up to ``digits`` of its mean in all but `DRAWN` of the pixels. ``parameters`` of both ways.
    """
    worst, differing, ok, words = 0.0, 0.0, True, []
    for way, of_way in WAYS.items():
        of_way = of_way | parameters
        plain, statistics = _render(subject.load(first), of_way, SPP[way], 3)
        decided, draws = _decided(statistics), _decided(statistics, ("cost", "emission"))
        ok &= plain.mean() > 0.01 and (way != "default parameters" or bool(decided))
        for name, place in places.items():
            image, statistics = _render(subject.load(place), of_way, SPP[way], 3)
            apart = np.abs(image / place.light - plain) / plain.mean()
            limit = digits if _decided(statistics, ("cost", "emission")) == draws else DRAWN
            differing = max(differing, float((apart > limit).mean()))
            worst = max(worst, abs(float(image.mean() / place.light / plain.mean()) - 1))
            if _decided(statistics) != decided or statistics["non_finite"]:
                ok = False
                words.append(f"{way}, {name}: {_decided(statistics)}, {statistics['non_finite']} not finite")
    ok &= differing <= DRAWN and worst < MEANS
    text = f"{100 * differing:.2g} % of the pixels differ at most, means by {worst:.1g}"
    return Outcome(bool(ok), "; ".join([text, *words] if words else [text, "decisions the same"]))


def _tiles(scene, parameters, spp, seeds) -> Sample:
    """As `greens`, of the first bounces."""
    return Sample.of(greens(scene, {"max_depth": DEPTH} | parameters, seeds, spp)[0])


def _turned(subject: Subject) -> Outcome:
    """Tile means of the turned scene agree with those of the plain one.

    In other units it looks the same, seed for seed; without tables of emission, of which one path that
    rounding sends another way changes a cell, and so the draws of all others.
    """
    pairs = []
    for way, parameters in WAYS.items():
        parameters = {"type": "bdpt"} | parameters
        spp = SPP[way] * subject.samples * MORE[way]
        plain, turned = (
            _tiles(subject.load(place), parameters, spp, seeds)
            for place, seeds in ((Place(), range(5)), (SMALL, range(10, 15)))
        )
        pairs.append((turned, plain))
    scaled = _equal(subject, SMALL, {"1e4": LARGE}, NEAR, guiding="photons")
    return together({"turned": family(pairs, MOST_ERROR), "scaled": scaled})


AWAY = Place(shift=(7000.0, -5000.0, 5000.0))  # 1e4 units


# Times as many samples for it as `SPP`, so that the standard error of a tile is below a third of what it may
# be off (`SURE`): what is just within that is not noise.
FOR_MOVED = {"default parameters": 4, "all strategies": 16}
SURE = 3


def _deviation(subject: Subject, parameters, spp) -> tuple[float, float]:
    """How far the tiles of the moved scene are off, and the standard error of that of a tile."""
    plain, moved = (
        _tiles(subject.load(place), parameters, spp * subject.samples, seeds)
        for place, seeds in ((Place(), range(5)), (AWAY, range(10, 15)))
    )
    return deviation(plain, moved)


def _moved(subject: Subject) -> Outcome:
    """Our own error far from the origin is small, and that of `path` larger."""
    found = [
        _deviation(subject, {"type": "bdpt"} | parameters, SPP[way] * FOR_MOVED[way])
        for way, parameters in WAYS.items()
    ]
    ours, error = (max(numbers) for numbers in zip(*found, strict=True))
    ok = ours < subject.moved and error < subject.moved / SURE
    text = f"tiles off by {100 * ours:.2g} %, standard error {100 * error:.2g} %"
    if subject.by_path:
        theirs, _ = _deviation(subject, {"type": "path"}, 128)
        ok, text = ok and ours < theirs, f"{text}; under `path` by {100 * theirs:.2g} %"
    return Outcome(bool(ok), text)


TURN = rotation([1, 2, 3], 35.7)
SCALES = {f"2^{k}": Place(2.0**k) for k in (-13, -10, 10, 13)}
LIGHTS = {f"2^{k}": Place(light=2.0**k) for k in (-40, -20, 20, 40)}
SMALL, LARGE = (Place(scale, TURN) for scale in (1e-4, 1e4))

_EXACTLY = (
    "the same image, seed for seed, by default and with all strategies, and the same decision of the pilot; "
    f"its mean to {MEANS:g}. "
    f"Powers of two are exact in floating point: {100 * DRAWN:g} % of the pixels may differ by more than "
    f"{EXACT:g} of the mean, where something takes part in a draw that is 0 in one of the units"
)


def _cases():
    for name, subject in SUBJECTS.items():
        words = subject.words
        quick = name == "sun"
        yield _case(
            f"scale-{name}",
            f"{words}, lengths times 2^-13 (1.2e-4), 2^-10, 2^10, 2^13",
            _EXACTLY,
            partial(_exact, subject, SCALES),
            quick,
        )
        yield _case(
            f"light-{name}",
            f"{words}, lights times 2^-40 (0.9e-12), 2^-20, 2^20, 2^40",
            _EXACTLY,
            partial(_exact, subject, LIGHTS),
            name == "envmap",
        )
        yield _case(
            f"turned-{name}",
            f"{words}, turned by 35.7° about (1, 2, 3), lengths times 1e-4 and 1e4",
            "tile means as of the plain scene (other seeds, 5 a side): Welch's t-test with Šidák at 1e-3, "
            f"standard error of a tile below {100 * MOST_ERROR:g} % of the mean; at 1e-4 the image and the "
            f"decision of 1e4, seed for seed (`guiding=photons`: a path that rounding sends another "
            f"way changes the tables, and so all draws): {100 * DRAWN:g} % of the pixels may differ by more "
            f"than {NEAR:g} of the mean, where rounding does that, the image's mean by {MEANS:g}; defaults "
            "and all strategies",
            partial(_turned, subject),
        )
        yield _case(
            f"moved-{name}",
            f"{words}, moved by 1e4",
            f"tiles off by less than {100 * subject.moved:g} % of the mean (root mean square, less noise; "
            "its standard error is below a third of that): coordinates of 1e4 have steps of "
            "1e-3, rays start 0.01 to 0.02 off a surface (32 steps of 2^-24); scenes are 2 to 5 wide, and "
            + ("these lamps have radii of 0.04; " if name == "lens" else "")
            + "`path`, where it sees the light, is off by more",
            partial(_moved, subject),
        )


CASES = tuple(_cases())
