"""NaN and infinity from textures, lamps, meshes and plugins of the user's.

Nearly all cases compare a scene with its *twin*, in which the same number is 0 instead of NaN or infinity:
same seed, same random numbers, so that the images are the same up to the order of sums, whatever is in them.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cache

import drjit as dr
import numpy as np
from mitsuba_bdpt import choice

import mitsuba as mi  # isort: skip

from .agreement import against, tiles, together
from .case import Case, Outcome

SECTION = "NaN and infinity"

# Of the brightest value: sums in single precision, in the order in which threads come to them.
ROUNDING = 1e-5

NAN, INF = float("nan"), float("inf")

SAID = {"everything": "all strategies", "default": "default parameters"}
EVERYTHING = {"skip": "none", "max_depth": 4}
DEFAULTS = {"max_depth": 4}

# Each way to render with its samples per pixel: by default so many that a pilot is asked.
SIZE = 16
PILOTED = choice.LEAST_SAMPLES // SIZE**2
WAYS = {"everything": (EVERYTHING, 16), "default": (DEFAULTS, PILOTED)}


class Warned:
    """Collects what is logged as a warning while it is entered."""

    def __enter__(self) -> list[str]:
        texts = []

        class Appender(mi.Appender):
            def append(self, level, text):
                if level == mi.LogLevel.Warn and "bdpt:" in text:
                    texts.append(text.partition("bdpt: ")[2])

            def log_progress(self, *_):
                pass

        self._appender = Appender()
        mi.logger().add_appender(self._appender)
        return texts

    def __exit__(self, *_):
        mi.logger().remove_appender(self._appender)


# -- things that are poisoned -----------------------------------------------------------------


class Scales:
    """The numbers that a poisoned plugin multiplies with, by what they multiply; 1 where none is given."""

    def __init__(self, props, *names):
        self._factors = {name: dr.opaque(mi.Float, props.get(name, 1.0)) for name in names}

    def of(self, name, where):
        """The factor of ``name`` at the places in ``where``, else 1."""
        return dr.select(where, self._factors[name], 1)


def poison():
    """The class of the BSDF ``poison``. (Mitsuba's classes exist once a variant is chosen.)"""

    class Poison(mi.BSDF):
        """Diffuse; where u > 0.5, the scales multiply the sampled weight, the direction, the value, the
        density."""

        def __init__(self, props):
            super().__init__(props)
            self.inner = mi.load_dict({"type": "diffuse", "reflectance": 0.6})
            self.m_flags = self.inner.flags()
            self.m_components = [self.m_flags]
            self.scales = Scales(props, "weight", "direction", "eval", "pdf")

        def scale(self, name, si):
            return self.scales.of(name, si.uv.x > 0.5)

        def sample(self, ctx, si, u1, u2, active=True):
            bs, weight = self.inner.sample(ctx, si, u1, u2, active)
            bs.wo *= self.scale("direction", si)
            bs.pdf *= self.scale("pdf", si)
            return bs, weight * self.scale("weight", si)

        def eval(self, ctx, si, wo, active=True):
            return self.inner.eval(ctx, si, wo, active) * self.scale("eval", si)

        def pdf(self, ctx, si, wo, active=True):
            return self.inner.pdf(ctx, si, wo, active) * self.scale("pdf", si)

        def eval_pdf(self, ctx, si, wo, active=True):
            return self.eval(ctx, si, wo, active), self.pdf(ctx, si, wo, active)

        def to_string(self):
            return "Poison[]"

    return Poison


def poison_lamp():
    """The class of the emitter ``poison_lamp``."""

    class PoisonLamp(mi.Emitter):
        """Surroundings of radiance 1; in the half x > 0 of all directions, the scales multiply radiance and
        density. The weight of a sampled direction is what a sound density would make it."""

        def __init__(self, props):
            super().__init__(props)
            self.m_flags = int(mi.EmitterFlags.Infinite)
            self.scales = Scales(props, "eval", "pdf")

        def scale(self, name, d):
            return self.scales.of(name, d.x > 0)

        def sample_direction(self, it, sample, active=True):
            d = mi.warp.square_to_uniform_sphere(sample)
            ds = dr.zeros(mi.DirectionSample3f)
            ds.dist = mi.Float(100)
            ds.p, ds.d, ds.n, ds.uv, ds.time = it.p + d * ds.dist, d, -d, mi.Point2f(sample), it.time
            ds.pdf = dr.select(active, dr.inv_four_pi * self.scale("pdf", d), 0)
            ds.delta, ds.emitter = mi.Bool(False), mi.EmitterPtr(self)
            return ds, dr.select(active, mi.Spectrum(4 * dr.pi * self.scale("eval", d)), 0)

        def pdf_direction(self, it, ds, active=True):
            return dr.select(active, dr.inv_four_pi * self.scale("pdf", ds.d), 0)

        def eval(self, si, active=True):
            return dr.select(active, mi.Spectrum(self.scale("eval", -si.wi)), 0)

        def sample_wavelengths(self, si, sample, active=True):
            raise NotImplementedError

        def bbox(self):
            return mi.ScalarBoundingBox3f()

        def to_string(self):
            return "PoisonLamp[]"

    return PoisonLamp


def register():
    """Register the plugins ``poison`` (a BSDF) and ``poison_lamp`` (an emitter) for the variant in use."""
    _register(mi.variant())


@cache
def _register(variant: str):
    mi.register_bsdf("poison", poison())
    mi.register_emitter("poison_lamp", poison_lamp())


def texture(bad, base=0.6):
    """4 x 4 texels of which three are ``bad``, a number or one per colour; no texel spreads into others."""
    data = np.full((4, 4, 3), base, dtype=np.float32)
    data[0, 1] = data[2, 2] = data[3, 0] = bad
    # Raw colours are no spectra.
    return {"type": "bitmap", "bitmap": mi.Bitmap(data), "raw": not mi.is_spectral, "filter_type": "nearest"}


BAD_TEXELS, TEXELS = 3, 16


def brightness(value):
    """Of a lamp. (A spectral variant scales a number by daylight, and refuses such a spectrum that is 0.)"""
    return {"type": "uniform", "value": value} if mi.is_spectral else value


def to_world():
    """The plate of `room` in its place."""
    return mi.ScalarTransform4f().translate([0, -0.3, -0.2]).rotate([1, 0, 0], -50).scale(0.45)


def down():
    """From above onto the plate of `room`."""
    return mi.ScalarTransform4f().look_at([0, 0.5, 0.3], [0, -0.3, -0.2], [0, 0, 1])


def camera(**keys):
    film = {
        "type": "hdrfilm",
        "width": SIZE,
        "height": SIZE,
        "pixel_format": "rgb",
        "component_format": "float32",
    }
    placed = mi.ScalarTransform4f().look_at([0, 0.1, 0.8], [0, -0.1, -1], [0, 1, 0])
    return {
        "type": "perspective",
        "fov": 70,
        "near_clip": 1e-3,
        "to_world": placed,
        "film": film | {"rfilter": {"type": "box"}},
    } | keys


def room(bsdf=None, **parts):
    """A closed sphere with a plate of the ``bsdf`` that fills a part of the view, and a lamp; or other
    ``parts`` in their place."""
    grey = {"type": "twosided", "bsdf": {"type": "diffuse", "reflectance": 0.5}}
    lamp_at = mi.ScalarTransform4f().translate([0.3, 0.8, 0]).rotate([1, 0, 0], 90).scale(0.2)
    inside = {
        "wall": {"type": "sphere", "bsdf": grey},
        "plate": {"type": "rectangle", "to_world": to_world(), "bsdf": bsdf or grey},
        "lamp": {"type": "rectangle", "to_world": lamp_at, "emitter": {"type": "area", "radiance": 4.0}},
    }
    parts = {name: part for name, part in (inside | parts).items() if part is not None}
    return mi.load_dict({"type": "scene", "sensor": camera(), **parts})


def filled(bsdf, **parts):
    """A plate that fills the film: each texel covers 4 x 4 pixels; lit by a point above all of it, which each
    of its points sees."""
    fov = float(np.rad2deg(2 * np.arctan(0.25)))
    facing = mi.ScalarTransform4f().look_at([0, 0, 4], [0, 0, 0], [0, 1, 0])
    scene = {
        "type": "scene",
        "sensor": camera(fov=fov, to_world=facing),
        "plate": {"type": "rectangle", "bsdf": bsdf},
        "lamp": {"type": "point", "position": [0, 0, 3.0], "intensity": 5.0},
    }
    return mi.load_dict({name: part for name, part in (scene | parts).items() if part is not None})


# -- what is expected -------------------------------------------------------------------------


def rendered(scene, parameters, spp, seed=1):
    """Image, statistics and warnings of a render."""
    bdpt = mi.load_dict({"type": "bdpt", **parameters})
    with Warned() as warnings:
        image = np.array(bdpt.render(scene, spp=spp, seed=seed), dtype=np.float64)
    return image, bdpt.statistics, warnings


def decided(statistics) -> list[dict]:
    """The decisions, without what they cost: rays are traced for NaN and infinity, but not for 0."""
    return [{name: x for name, x in d.items() if name != "cost"} for d in statistics["decisions"]]


def compared(make, bad, parameters, count=None, spp=16) -> Outcome:
    """Whether ``make(bad)`` renders as ``make(0.0)`` does, counts ``count`` values (some, if None) and says
    so once, and the twin none; with `PILOTED` samples also whether a pilot was asked."""
    image, statistics, warnings = rendered(make(bad), parameters, spp)
    twin, of_twin, quiet = rendered(make(0.0), parameters, spp)
    found = statistics["non_finite"]
    # An image of features may be all that there is.
    off = np.abs(image - twin).max() / np.abs(twin).max()
    counted = found == count if count is not None else found > 0
    ok = bool(np.isfinite(image).all()) and off <= ROUNDING and counted
    ok &= len(warnings) == 1 and f"{found} values" in warnings[0]
    ok &= of_twin["non_finite"] == 0 and not quiet and decided(statistics) == decided(of_twin)
    exactly = f", exactly {count} expected" if count is not None else ""
    piloted, asked = spp >= PILOTED, bool(statistics["decisions"]) and statistics["seconds"]["pilot"] > 0
    text = f"{found} counted{exactly}, off by {off:.1g}, {len(warnings)} warning"
    text += ", decided by a pilot" if asked else ""
    return Outcome(bool(ok and asked == piloted), text)


def both_ways(make, bad, said, more=None) -> dict[str, Outcome]:
    """`compared` by all `WAYS`, with ``more`` parameters; what was tried is ``said``."""
    return {
        f"{said}, {SAID[how]}": compared(make, bad, parameters | (more or {}), spp=spp)
        for how, (parameters, spp) in WAYS.items()
    }


TWIN = (
    "the image of its twin, in which that is 0, to 1e-5 of its maximum (same random numbers; only the order "
    "of sums differs); counted; one warning"
)
PILOT_TOO = TWIN + "; by default with so many samples that a pilot decides, as it does for the twin"


def bsdf_cases():
    """Poisoned BSDFs, in all strategies and by default."""
    said = {
        "weight": "weight of sampled directions",
        "direction": "sampled directions",
        "eval": "value",
        "pdf": "density",
    }
    zero = {"weight": ["weight"], "direction": ["weight"], "eval": ["eval"], "pdf": ["weight", "eval"]}

    def make(name):
        def made(value):
            register()
            names = [name] if value != 0 else zero[name]
            return room({"type": "poison"} | dict.fromkeys(names, value))

        return made

    def run(name):
        return together(both_ways(make(name), NAN, "nan") | both_ways(make(name), INF, "inf"))

    return [
        Case(
            f"bsdf-{name}",
            SECTION,
            f"a user's BSDF: on half a plate its {said[name]} NaN or infinite; all strategies, and defaults",
            PILOT_TOO,
            lambda name=name: run(name),
            name == "pdf",
        )
        for name in said
    ]


def own_lamps():
    """What is said of a user's environment, how it is made with a number, and a bad number. (Rendered under
    ``hide_emitters``, for a sky seen directly is asked for no density.)"""

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
        Case("lamp-own", SECTION, f"a user's environment: {tried}", PILOT_TOO, lambda: run(own_lamps), True),
        Case(
            "lamp-mitsuba",
            SECTION,
            "Mitsuba's lamps with radiances that are NaN or infinite; all strategies, and defaults",
            PILOT_TOO,
            lambda: run(mitsubas_lamps),
        ),
    ]


# -- textures, layers, passes, with exact counts -------------------------------------------------


def painted(bad):
    return {"type": "diffuse", "reflectance": texture(bad)}


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
    """``tried``: what is not finite in the scene of ``make`` under ``parameters``; ``count`` in words, and
    the ``number`` of values of each of ``SPP`` samples, over the poisoned pixels or ``everywhere``."""

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


SPP = 16
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
        BY_CAMERA | {"variance": True},
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
        return Case(f"exact-{name}", SECTION, tried, expected, lambda: run(names), quick)

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
        Case(
            "strategy-images-nan",
            SECTION,
            "half a plate's BSDF has the value NaN: all layers of `strategy_images`",
            TWIN,
            lambda: compared(_poisoned("eval"), NAN, EVERYTHING | {"strategy_images": True}),
        ),
    ]


def _poisoned(name):
    def make(value):
        register()
        return room({"type": "poison", name: value})

    return make


def finite_and_counted(make, bad, parameters, count, spp) -> Outcome:
    """Whether ``make(bad)``, which has no other light, renders black, counts ``count`` values and says so
    once."""
    image, statistics, warnings = rendered(make(bad), parameters, spp)
    found = statistics["non_finite"]
    ok = (image == 0).all() and found == count and len(warnings) == 1 and "intensity" in warnings[0]
    return Outcome(
        bool(ok), f"{found} counted, exactly {count} expected; {len(warnings)} warning: {warnings[0]}"
    )


# -- decisions, interruptions, Mitsuba's own distributions ---------------------------------------


def _pilot() -> Outcome:
    def make(value):
        register()
        return room({"type": "poison", "eval": value})

    def decided(value):
        bdpt = mi.load_dict({"type": "bdpt", "max_depth": 4})
        scene = make(value)
        with Warned() as warnings:
            bdpt.render(scene, spp=1024)
        text = bdpt.explain(scene, spp=1024)
        return bdpt.statistics, warnings, "not finite" in text

    (statistics, warnings, explained), (twin, quiet, silent) = decided(NAN), decided(0.0)
    found, same = statistics["non_finite_in_pilot"], statistics["decisions"] == twin["decisions"]
    ok = (
        found > 0
        and same
        and bool(twin["decisions"])
        and len(warnings) == 1
        and f"{found} of the pilot" in warnings[0]
    )
    ok = ok and explained and not silent and not quiet
    return Outcome(
        ok, f"{found} counted in the pilot; decisions {'the same' if same else 'differ'}; {warnings}"
    )


def spectrally_painted(value):
    """`reflecting` under a spectral variant: the coefficients of its texels set after loading, since Mitsuba
    fits a spectrum to NaN as well; where ``value`` is 0, to those of black."""
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
            pass
    found = bdpt.statistics["non_finite"]
    return Outcome(found > 0 and len(warnings) == 1, f"{found} counted, {len(warnings)} warning")


def _lost_whole(lamp: Callable, parameter: str) -> Outcome:
    """Whether nothing is left of the only light, ``lamp(NAN)``, and ``parameter`` is named; with a number in
    its place there is light, and nothing to say."""
    texts, ok = [], True
    scene, sound = (room(wall=None, lamp=None, other=lamp(value)) for value in (NAN, 1.0))
    for parameters, spp in WAYS.values():
        image, statistics, warnings = rendered(scene, parameters, spp)
        found = statistics["non_finite"]
        ok = ok and (image == 0).all() and found > 0 and len(warnings) == 1 and parameter in warnings[0]
        light, of_sound, quiet = rendered(sound, parameters, spp)
        ok = ok and light.mean() > LIT and of_sound["non_finite"] == 0 and not quiet
        texts.append(f"mean {image.mean():.2g}, without NaN {light.mean():.2g}; {found} counted")
    path = np.array(mi.load_dict({"type": "path", "max_depth": 4}).render(scene, spp=64))
    return Outcome(bool(ok), f"{'; '.join(texts)}; `path`: mean {np.nanmean(path):.2g}, says nothing")


# Mean of an image that is lit.
LIT = 0.01


def distribution_cases():
    """Textures from which Mitsuba makes a distribution, which is NaN everywhere if one number is."""

    def sky(value):
        data = np.full((8, 16, 3), 1.0, dtype=np.float32)
        data[0, 0] = value
        return {"type": "envmap", "bitmap": mi.Bitmap(data)}

    def projector(value):
        return {"type": "projector", "irradiance": texture(value), "fov": 50, "to_world": down()}

    def lamp(value):
        at = mi.ScalarTransform4f().translate([-0.2, 0.6, -0.3]).rotate([1, 0, 0], 60).scale(0.3)
        return room(
            other={
                "type": "rectangle",
                "to_world": at,
                "emitter": {"type": "area", "radiance": texture(value)},
            }
        )

    def of_area(parameters):
        spp, seeds = PILOTED, range(8)
        ours = tiles(lamp(NAN), {"type": "bdpt", **parameters}, seeds, spp)
        return against(ours, tiles(lamp(0.0), {"type": "bdpt", **parameters}, seeds, spp), 0.02, "twin")

    def lost():
        return together(
            {
                "`envmap`": _lost_whole(sky, "other.data"),
                "`projector`": _lost_whole(projector, "irradiance.data"),
            }
        )

    return [
        Case(
            "distribution-nan",
            SECTION,
            "texels of an `envmap`, or of a `projector`, NaN",
            "all light that takes Mitsuba's distribution is lost, and said so: black, counted, named; with a "
            "number in their place there is light, and nothing to say",
            lost,
        ),
        Case(
            "area-texels-nan",
            SECTION,
            "texels of an area light NaN; all strategies, and defaults",
            "only these texels are lost: the image of its twin, in which they are 0; Welch's test over tiles "
            "(level 1e-3, 8 seeds each), which sees errors of 2 %",
            lambda: together({SAID[how]: of_area(parameters) for how, (parameters, _) in WAYS.items()}),
        ),
    ]


# -- meshes -----------------------------------------------------------------------------------


def mesh(data, bad):
    """The plate as a mesh with one of its four vertices' ``data`` bad."""
    corners = np.array([[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]], dtype=np.float32)
    numbers = {
        "vertex_positions": np.array([list(to_world() @ mi.ScalarPoint3f(*c)) for c in corners]),
        "vertex_normals": np.tile(np.array(to_world() @ mi.ScalarNormal3f(0, 0, 1)), (4, 1)),
        "vertex_texcoords": (corners[:, :2] + 1) / 2,
    }
    numbers["vertex_normals"] = (
        numbers["vertex_normals"] / np.linalg.norm(numbers["vertex_normals"], axis=1)[:, None]
    )
    numbers[data][3] = bad
    props = mi.Properties()
    props["bsdf"] = mi.load_dict({"type": "twosided", "bsdf": painted(0.1)})
    made = mi.Mesh("plate", 4, 2, has_vertex_normals=True, has_vertex_texcoords=True, props=props)
    parameters = mi.traverse(made)
    for name, values in numbers.items():
        parameters[name] = np.asarray(values, dtype=np.float32).ravel()
    parameters["faces"] = np.array([0, 1, 2, 0, 2, 3], dtype=np.uint32)
    parameters.update()
    return made


def _mesh(data, bad) -> Outcome:
    scene = room(plate=mesh(data, bad))
    seeds = range(8)
    ours = tiles(scene, {"type": "bdpt", "max_depth": 4}, seeds, PILOTED)
    theirs = tiles(scene, {"type": "path", "max_depth": 4}, seeds, PILOTED)
    outcome = against(ours, theirs, 0.02)
    _, statistics, warnings = rendered(scene, DEFAULTS, 16)
    found, expected = statistics["non_finite"], data == "vertex_normals"
    ok = outcome.ok and (found > 0) == expected == bool(warnings)
    return Outcome(ok, f"{outcome.happened}; {found} counted")


def textured_lamp(faces, emits=True, bad=None):
    """Triangles of a square, with the texture coordinates of its last corner ``bad``."""
    corners = np.array([[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]], dtype=np.float32)
    place = mi.ScalarTransform4f().translate([-0.2, 0.6, -0.3]).rotate([1, 0, 0], 60).scale(0.3)
    texcoords = (corners[:, :2] + 1) / 2
    if bad is not None:
        texcoords[3] = bad
    props = mi.Properties()
    props["bsdf"] = mi.load_dict({"type": "diffuse", "reflectance": 0.5})
    if emits:
        texels = np.random.default_rng(1).random((4, 4, 3)).astype(np.float32)
        radiance = {"type": "bitmap", "bitmap": mi.Bitmap(texels), "raw": True}
        props["emitter"] = mi.load_dict({"type": "area", "radiance": radiance})
    made = mi.Mesh("square", 4, len(faces), has_vertex_texcoords=True, props=props)
    parameters = mi.traverse(made)
    parameters["vertex_positions"] = np.ravel([list(place @ mi.ScalarPoint3f(*c)) for c in corners])
    parameters["vertex_texcoords"] = texcoords.ravel()
    parameters["faces"] = np.array(faces, dtype=np.uint32).ravel()
    parameters.update()
    return made


def _lamp_texcoords(bad) -> Outcome:
    sound, spoiled = [0, 1, 2], [0, 2, 3]
    scene = room(lamp=None, other=textured_lamp([sound, spoiled], bad=bad))
    dark = room(lamp=None, other=textured_lamp([sound]), more=textured_lamp([spoiled], emits=False))
    theirs = tiles(dark, {"type": "path", "max_depth": 4}, range(8), 4 * PILOTED)
    outcomes = {}
    for how, (parameters, spp) in WAYS.items():
        ours = tiles(scene, {"type": "bdpt", **parameters}, range(8), max(spp, 256))
        outcome = against(ours, theirs, 0.02)
        _, statistics, warnings = rendered(scene, parameters, 16)
        found = statistics["non_finite"]
        ok = outcome.ok and found > 0 and len(warnings) == 1 and "other.vertex_texcoords" in warnings[0]
        outcomes[SAID[how]] = Outcome(ok, f"{outcome.happened}; {found} counted")
    return together(outcomes)


def mesh_cases():
    """Vertices of a mesh that are not finite."""
    what = {
        "vertex_positions": "their triangles meet no ray, as under `path`, and are not counted",
        "vertex_normals": "their triangles reflect nothing, as under `path`; subpaths that end there count",
        "vertex_texcoords": "Mitsuba looks up some texel, as under `path`; nothing to count",
    }
    lamp = Case(
        "mesh-lamp-texcoords",
        SECTION,
        "`vertex_texcoords` of one of the four vertices of a textured lamp NaN; all strategies, and defaults",
        "that triangle is dark, counted and named (`path` is NaN all over); Welch's test over tiles against "
        "`path` with a dark triangle there (level 1e-3, 8 seeds each), which sees errors of 2 %",
        lambda: _lamp_texcoords(NAN),
    )
    return [
        lamp,
        *(
            Case(
                f"mesh-{data.replace('_', '-')}",
                SECTION,
                f"`{data}` of one of four vertices NaN or infinite, set after loading",
                f"{expected}; Welch's test over tiles against `path` (level 1e-3, 8 seeds each), which sees "
                "errors of 2 %",
                lambda data=data: together({str(bad): _mesh(data, bad) for bad in (NAN, INF)}),
            )
            for data, expected in what.items()
        ),
    ]


CASES = (
    *bsdf_cases(),
    *lamp_cases(),
    *counted_cases(),
    Case(
        "pilot-nan",
        SECTION,
        "a pilot meets a BSDF of value NaN",
        "counted apart (`non_finite_in_pilot`), in the warning and in `explain`; the decision is its twin's",
        _pilot,
    ),
    Case(
        "spectral-nan",
        SECTION,
        "`llvm_ad_spectral`: lamps, a texture and a BSDF that are NaN, an infinite density; all strategies",
        TWIN + "; the numbers that follow from the scene, exactly",
        _spectral,
    ),
    Case(
        "interrupted-nan",
        SECTION,
        "texels of a reflectance NaN, Ctrl-C after the second pass",
        "the warning comes all the same",
        _interrupted,
    ),
    *distribution_cases(),
    *mesh_cases(),
)
