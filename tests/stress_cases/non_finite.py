"""NaN and infinity from BSDFs, lamps and textures, nearly all compared with their twins (`twins`)."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from mitsuba_bdpt.settings import HEURISTICS

import mitsuba as mi  # isort: skip

from .agreement import together
from .case import Outcome, of_section
from .poisons import (
    BAD_TEXELS,
    INF,
    NAN,
    SIZE,
    TEXELS,
    brightness,
    down,
    filled,
    painted,
    register,
    room,
    texture,
)
from .twins import EVERYTHING, PILOT_TOO, PILOTED, SPP, TWIN, both_ways, compared, decided, rendered
from .warned import Warned

_case = of_section("NaN and infinity")


def bsdf_cases():
    """Poisoned BSDFs, in all strategies and by default."""
    said = {
        "weight": "weight of sampled directions",
        "direction": "sampled directions",
        "eta": "index of refraction, beside glass,",
        "eval": "value",
        "pdf": "density",
    }
    zero = {"eval": ["eval"], "pdf": ["weight", "eval"]}
    # Nobody asks for the index of refraction in a scene that refracts nothing.
    more = {"eta": {"other": {"type": "sphere", "radius": 0.1, "bsdf": {"type": "dielectric"}}}}

    def make(name):
        def made(value):
            register()
            names = [name] if value != 0 else zero.get(name, ["weight"])
            return room({"type": "poison"} | dict.fromkeys(names, value), **more.get(name, {}))

        return made

    def run(name):
        return together(both_ways(make(name), NAN, "nan") | both_ways(make(name), INF, "inf"))

    return [
        _case(
            f"bsdf-{name}",
            f"a user's BSDF: on half a plate its {said[name]} NaN or infinite; all strategies, and defaults",
            PILOT_TOO,
            lambda name=name: run(name),
            name == "pdf",
        )
        for name in said
    ]


def heuristics_case():
    """Densities that are not finite under both heuristics."""

    def plate(value):
        register()
        names = ["pdf"] if value != 0 else ["weight", "eval"]
        return room({"type": "poison"} | dict.fromkeys(names, value))

    skies = [(said, make, bad) for said, make, bad in own_lamps() if "densities" in said]
    poisoned = [("a plate's densities NaN", plate, NAN), ("a plate's densities infinite", plate, INF), *skies]

    def run():
        outcomes = {}
        for heuristic in HEURISTICS:
            for said, make, bad in poisoned:
                ways = EVERYTHING | {"heuristic": heuristic, "hide_emitters": True}
                outcomes[f"{heuristic}, {said}"] = compared(make, bad, ways)
        return together(outcomes)

    tried = (
        "densities NaN or infinite, of half a plate or of half a user's environment, under both heuristics"
    )
    return _case("heuristics-nan", tried, TWIN, run, True)


def own_lamps():
    """What is said of a user's environment, how it is made with a number, and a bad number.

    Rendered under ``hide_emitters``, for a sky seen directly is asked for no density.
    """

    def make(name):
        def made(value):
            register()
            # Where the density is 0, so is what is sampled there: the twin's other half is black.
            names = [name] if value != 0 else ["eval"]
            return room(wall=None, sky={"type": "poison_lamp"} | dict.fromkeys(names, value))

        return made

    return (
        ("a user's environment: half its radiance NaN", make("eval"), NAN),
        ("a user's environment: half its radiance infinite", make("eval"), INF),
        ("a user's environment: half its densities NaN", make("pdf"), NAN),
        # With an infinite density beside a finite weight, next-event estimation would be believed alone.
        ("a user's environment: half its densities infinite", make("pdf"), INF),
    )


def mitsubas_lamps():
    """The same of Mitsuba's emitters."""

    def point(value):
        return room(other={"type": "point", "intensity": brightness(value)})

    def glowing(value):
        at = mi.ScalarTransform4f().translate([-0.4, 0.5, -0.3]).rotate([1, 0, 0], 60).scale(0.2)
        other = {"type": "rectangle", "to_world": at, "emitter": {"type": "area", "radiance": value}}
        # Mitsuba orders shapes by their addresses: with two lamps on shapes, random numbers would choose
        # another one in the twin.
        return room(other=other, lamp={"type": "point", "position": [0.3, 0.7, 0], "intensity": 0.5})

    def sky(value):
        return room(wall=None, sky={"type": "constant", "radiance": brightness(value)})

    def sun(value):
        return room(wall=None, sun={"type": "directional", "direction": [0, -1, -1], "irradiance": value})

    def spot(value):
        lamp = {"type": "spot", "intensity": 5.0, "cutoff_angle": 40, "to_world": down()}
        return room(other=lamp | {"texture": texture(value)})

    return (
        ("point light of intensity NaN", point, NAN),
        ("point light of infinite intensity", point, INF),
        ("area light of radiance NaN", glowing, NAN),
        ("sky of radiance NaN", sky, NAN),
        ("directional light of irradiance NaN", sun, NAN),
        ("spot light through a texture with NaN", spot, NAN),
    )


def lamp_cases():
    """Poisoned emitters; the plate of the room keeps a lamp that is sound."""

    def run(lamps):
        outcomes = {}
        for said, make, bad in lamps():
            outcomes |= both_ways(make, bad, said, {"hide_emitters": True})
        return together(outcomes)

    tried = "radiance or density NaN or infinite in half of all directions; all strategies, and defaults"
    return [
        _case("lamp-own", f"a user's environment: {tried}", PILOT_TOO, lambda: run(own_lamps), True),
        _case(
            "lamp-mitsuba",
            "Mitsuba's lamps with radiances that are NaN or infinite; all strategies, and defaults",
            PILOT_TOO,
            lambda: run(mitsubas_lamps),
        ),
    ]


# -- textures, layers, passes, with exact counts -------------------------------------------------


def reflecting(value):
    return filled(painted(value))


def red(value):
    return filled(painted([value, 0, 0]))


def glowing_plate(value):
    return filled(
        None, plate={"type": "rectangle", "emitter": {"type": "area", "radiance": texture(value)}}, lamp=None
    )


def lit(value):
    """A closed white sphere with nothing in it but a point light."""
    wall = {"type": "sphere", "bsdf": {"type": "twosided", "bsdf": {"type": "diffuse"}}}
    return room(
        wall=wall,
        plate=None,
        lamp={"type": "point", "position": [0.2, 0, 0.1], "intensity": brightness(value)},
    )


@dataclass(frozen=True)
class Counted:
    """A scene with numbers that are not finite, and how many of its values count as such.

    ``tried``: what is not finite in the scene of ``make`` under ``parameters``; ``count`` in words, and the
    ``number`` of values of each of ``SPP`` samples, over the poisoned pixels or ``everywhere``.
    """

    tried: str
    count: str
    make: Callable
    parameters: dict
    number: int
    everywhere: bool = False

    def run(self) -> Outcome:
        pixels = SIZE**2 if self.everywhere else SIZE**2 * BAD_TEXELS // TEXELS
        check = finite_and_counted if self.everywhere else compared
        return check(self.make, NAN, self.parameters, self.number * pixels * SPP, SPP)


BY_CAMERA = {"light_paths": 0, "max_depth": 2}
TWO = "two values of each camera sample on them"

COUNTED = {
    "reflectance": Counted(
        "texels of a reflectance NaN, light and camera at the front",
        f"{TWO}: s = 1, and the subpath that would go on",
        reflecting,
        BY_CAMERA,
        2,
    ),
    "reflectance-red": Counted(
        "texels of a reflectance that are NaN in red and 0 in green and blue",
        f"{TWO}: a colour that is NaN in part is not black",
        red,
        BY_CAMERA,
        2,
    ),
    "radiance": Counted(
        "texels of an area light's radiance NaN, seen directly",
        "one value of each camera sample on them",
        glowing_plate,
        {"light_paths": 0, "max_depth": 1},
        1,
    ),
    "feature": Counted(
        "texels of a reflectance NaN, shown by `aovs` (albedo), nothing else rendered",
        "one value of each camera sample on them",
        reflecting,
        {"aovs": "a:albedo", "max_depth": 0},
        1,
    ),
    "emission": Counted(
        "point light of intensity NaN in a closed sphere, all strategies, depth 3",
        "three values of each sample: its light subpath, s = 1 at two vertices",
        lit,
        {"skip": "none", "max_depth": 3},
        3,
        everywhere=True,
    ),
    "passes": Counted(
        "texels of a reflectance NaN, in passes of 3 samples",
        f"{TWO}, one warning for all passes",
        reflecting,
        BY_CAMERA | {"spp_per_pass": 3},
        2,
    ),
    "variance": Counted(
        "texels of a reflectance NaN, layers of the variance",
        TWO,
        reflecting,
        BY_CAMERA | {"layers": "variance"},
        2,
    ),
}


def counted_cases():
    """Cases in which the number of values that are not finite follows from the scene."""

    def run(names):
        found = {name: COUNTED[name] for name in names}
        return together({f"{c.tried}, {c.count}": c.run() for c in found.values()})

    def case(name, tried, names, quick=False):
        expected = "the number that follows from the scene, exactly; " + TWIN
        return _case(f"exact-{name}", tried, expected, lambda: run(names), quick)

    return [
        case(
            "reflectance",
            "texels of a reflectance NaN in all colours, or in one of black; in passes; with `variance`",
            ("reflectance", "reflectance-red", "passes", "variance"),
            True,
        ),
        case(
            "lamps",
            "texels of a lamp seen directly, or a point light's intensity, NaN",
            ("radiance", "emission"),
        ),
        case("feature", "texels of an albedo NaN, shown by `aovs`", ("feature",)),
        _case(
            "strategy-images-nan",
            "half a plate's BSDF has the value NaN: all layers of `layers=strategies`",
            TWIN,
            lambda: compared(_poisoned("eval"), NAN, EVERYTHING | {"layers": "strategies"}),
        ),
    ]


def _poisoned(name):
    def make(value):
        register()
        return room({"type": "poison", name: value})

    return make


def finite_and_counted(make, bad, parameters, count, spp) -> Outcome:
    """Whether ``make(bad)`` renders black, counts ``count`` values and says so once.

    The scene has no other light.
    """
    image, statistics, warnings = rendered(make(bad), parameters, spp)
    found = statistics["non_finite"]
    ok = (image == 0).all() and found == count and len(warnings) == 1 and "intensity" in warnings[0]
    text = f"{found} counted, exactly {count} expected; {len(warnings)} warnings"
    return Outcome(bool(ok), text + (f": {warnings[0]}" if warnings else ""))


# -- decisions, interruptions, Mitsuba's own distributions ---------------------------------------


def _pilot() -> Outcome:
    def met(value):
        bdpt = mi.load_dict({"type": "bdpt", "max_depth": 4})
        scene = _poisoned("eval")(value)
        with Warned() as warnings:
            bdpt.render(scene, spp=PILOTED)
        text = bdpt.explain(scene, spp=PILOTED)
        return bdpt.statistics, warnings, "\ninvalid samples" in text

    (statistics, warnings, explained), (twin, quiet, silent) = met(NAN), met(0.0)
    found, same = statistics["non_finite_in_pilot"], decided(statistics) == decided(twin)
    ok = found > 0 and same and bool(twin["decisions"])
    ok = ok and len(warnings) == 1 and f"{found} of the pilot" in warnings[0]
    ok = ok and explained and not silent and not quiet
    return Outcome(
        ok, f"{found} counted in the pilot; decisions {'the same' if same else 'differ'}; {warnings}"
    )


def spectrally_painted(value):
    """`reflecting` under a spectral variant: the coefficients of its texels set after loading.

    Mitsuba fits a spectrum to NaN as well. Where ``value`` is 0, they are set to those of black.
    """
    scene = reflecting(0.5)
    parameters = mi.traverse(scene)
    (name,) = [name for name, _ in parameters if name.endswith("reflectance.data")]
    data = np.array(parameters[name])
    painted_texels = np.array(texture(0.0)["bitmap"])[..., 0] == 0
    data[painted_texels] = value if value != 0 else (0, 0, -INF)
    parameters[name] = mi.TensorXf(data)
    parameters.update()
    return scene


def _spectral() -> Outcome:
    """Under a spectral variant, where a poisoned value has as many wavelengths as a path."""
    before = mi.variant()
    mi.set_variant("llvm_ad_spectral")
    try:
        lamps = {said: (make, bad) for said, make, bad in (*own_lamps(), *mitsubas_lamps())}
        outcomes = {}
        for said in SPECTRAL_LAMPS:
            make, bad = lamps[said]
            outcomes[said] = compared(make, bad, EVERYTHING | {"hide_emitters": True})
        outcomes["half a plate's BSDF of value NaN"] = compared(_poisoned("eval"), NAN, EVERYTHING)
        texels = replace(COUNTED["reflectance"], make=spectrally_painted)
        for counted in (texels, COUNTED["emission"]):
            outcomes[f"{counted.tried}, {counted.count}"] = counted.run()
        return together(outcomes)
    finally:
        mi.set_variant(before)


SPECTRAL_LAMPS = (
    "a user's environment: half its radiance NaN",
    "a user's environment: half its densities infinite",
    "point light of intensity NaN",
    "sky of radiance NaN",
)


def _interrupted() -> Outcome:
    bdpt = mi.load_dict({"type": "bdpt", "max_depth": 2, "spp_per_pass": 4})

    def stop(report):
        if report.spp_done >= 8:
            raise KeyboardInterrupt

    bdpt.on_pass = stop
    with Warned() as warnings:
        try:
            bdpt.render(filled(painted(NAN)), spp=64)
        except KeyboardInterrupt:
            interrupted = True
        else:
            interrupted = False
    found = bdpt.statistics["non_finite"]
    text = f"{'interrupted' if interrupted else 'no `KeyboardInterrupt`'}, {found} counted, "
    return Outcome(interrupted and found > 0 and len(warnings) == 1, f"{text}{len(warnings)} warning")


CASES = (
    *bsdf_cases(),
    *lamp_cases(),
    heuristics_case(),
    *counted_cases(),
    _case(
        "pilot-nan",
        "a pilot meets a BSDF of value NaN",
        "counted apart (`non_finite_in_pilot`), in the warning and in `explain`; the decision is its twin's",
        _pilot,
    ),
    _case(
        "spectral-nan",
        "`llvm_ad_spectral`: lamps, a texture and a BSDF that are NaN, an infinite density; all strategies",
        TWIN + "; the numbers that follow from the scene, exactly",
        _spectral,
    ),
    _case(
        "interrupted-nan",
        "texels of a reflectance NaN, Ctrl-C after the second pass",
        "`KeyboardInterrupt`, and the warning comes all the same",
        _interrupted,
    ),
)
