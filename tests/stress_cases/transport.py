"""Light that bounces long, through glass in glass, off mirrors, and off surfaces of every roughness."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

import mitsuba as mi  # isort: skip

from .agreement import WAYS, Judged, against, against_known, tiles, worst
from .case import Outcome, of_section
from .poisons import camera
from .warned import Warned

_case = of_section("Transport")

SEEDS = range(8)

# With this ``rr_depth``, what roulette makes noisy is 0.99^1200 of the light.
LATE = 1200

# Of the steepest ray in the corridor of mirrors, in both directions across it: 32 reflections each.
SLOPE = 0.323

# Relative error of a tile of the corridor's end. Rays start 32 * 2^-24 of the largest coordinate, 100, off a
# mirror, which is a corridor narrower by 2e-4: 2e-4 of light after 64 bounces. There is noise of 1e-4.
OFF = 5e-4

WELCH = "Welch's test over tiles (level 1e-3, 8 seeds each)"
STUDENT = "Student's test over tiles (level 1e-3, 8 seeds)"


def place():
    """The identity, to which transformations are added."""
    return mi.ScalarTransform4f()


def diffuse(reflectance: float) -> dict:
    return {"type": "twosided", "bsdf": {"type": "diffuse", "reflectance": reflectance}}


def scene(sensor=None, **parts):
    """A scene of these parts, seen from within the unit sphere unless a ``sensor`` is given."""
    return mi.load_dict({"type": "scene", "sensor": sensor or camera(), **parts})


def look(origin, target, fov):
    """Keys of `camera` for another view."""
    return {"fov": fov, "to_world": place().look_at(list(origin), list(target), [0, 1, 0])}


def bdpt(**parameters) -> dict:
    return {"type": "bdpt", **parameters}


# -- closed rooms: radiances known in closed form ------------------------------------------------


def point_in_sphere(albedo: float, depth: int):
    """A point light of intensity pi in the unit sphere: after m reflections the radiance is albedo^m.

    The scene, and the sum for paths of up to ``depth`` edges (-1: of all).
    """
    wall = {"type": "sphere", "bsdf": diffuse(albedo)}
    lamp = {"type": "point", "intensity": float(np.pi)}
    total = sum(albedo**m for m in range(1, depth)) if depth >= 0 else albedo / (1 - albedo)
    return scene(wall=wall, lamp=lamp), total


def glowing_cube(albedo: float, depth: int):
    """A closed cube that emits radiance 1 everywhere: after m reflections it is albedo^m."""
    wall = {"type": "cube", "flip_normals": True, "bsdf": diffuse(albedo)}
    wall["emitter"] = {"type": "area", "radiance": 1.0}
    total = sum(albedo**m for m in range(depth)) if depth >= 0 else 1 / (1 - albedo)
    return scene(wall=wall), total


def closed_rooms():
    """Cases of closed rooms that absorb nothing, or a hundredth."""
    rooms = {
        "point": ("point light in a closed sphere", point_in_sphere),
        "cube": ("closed cube that glows everywhere", glowing_cube),
    }

    def run(make, limits):
        outcomes = {}
        for albedo, depth, spp in limits:
            target, known = make(albedo, depth)
            late = {} if depth >= 0 else {"rr_depth": LATE}
            for way, parameters in WAYS.items():
                means = tiles(target, bdpt(max_depth=depth, **late, **parameters), SEEDS, spp)
                outcomes[f"max_depth={depth}, {way}"] = against_known(means, known, 0.03)
        return worst(outcomes)

    families = {
        "white": ("albedo 1, max_depth 4 and 40", ((1.0, 4, 64), (1.0, 40, 32))),
        "grey": (f"albedo 0.99, no limit of the depth, rr_depth={LATE}", ((0.99, -1, 8),)),
    }
    return [
        _case(
            f"closed-{name}-{family}",
            f"{room}, {said}; all strategies, and defaults",
            f"the sum of albedo^m over all reflections; {STUDENT}, which sees errors of 3 % of the image's "
            "mean (roulette makes long paths noisy)",
            lambda make=make, limits=limits: run(make, limits),
        )
        for name, (room, make) in rooms.items()
        for family, (said, limits) in families.items()
    ]


def _roulette() -> Outcome:
    target, known = point_in_sphere(0.99, -1)
    texts, ok = [f"known {known:g}"], True
    for integrator in (bdpt(), {"type": "path"}):
        means = tiles(target, integrator, SEEDS, 16)
        ok &= bool(np.isfinite(means).all())
        texts.append(f"`{integrator['type']}` {means[:, -1].min():.3g} to {means[:, -1].max():.3g}")
    return Outcome(ok, ", ".join(texts))


def _too_bright_depth() -> Outcome:
    target, known = point_in_sphere(1.5, 7)
    with Warned() as warnings:
        means = tiles(target, bdpt(max_depth=7), SEEDS, 64)
    outcome = against_known(means, known, 0.03)
    once = len(warnings) == 1 and "up to 1.5" in warnings[0]
    return Outcome(
        outcome.ok and once, f"{outcome.happened}; {len(warnings)} warnings of {len(SEEDS)} renders"
    )


def _too_bright_unlimited() -> Outcome:
    bitmap = mi.Bitmap(np.full((4, 4, 3), 1.2, dtype=np.float32))
    bright = {"type": "diffuse", "reflectance": {"type": "bitmap", "bitmap": bitmap, "raw": True}}
    wall = {"type": "sphere", "bsdf": {"type": "twosided", "bsdf": bright}}
    made = mi.load_dict(bdpt())
    with Warned() as warnings:
        image = np.array(made.render(scene(wall=wall, lamp={"type": "point"}), spp=32))
    count = made.statistics["non_finite"]
    first = warnings[0] if warnings else "of nothing"
    ok = np.isfinite(image).all() and "up to 1.2" in first and len(warnings) == 1 + bool(count)
    return Outcome(bool(ok), f"mean {image.mean():.3g}; {count} values not finite; warned: {first}")


def _black() -> Outcome:
    lamp_at = place().translate([0.3, 0.8, 0]).rotate([1, 0, 0], 90).scale(0.2)
    target = scene(
        wall={"type": "sphere", "bsdf": diffuse(0.0)},
        ball={
            "type": "sphere",
            "center": [0.2, -0.3, -0.4],
            "radius": 0.2,
            "bsdf": {"type": "dielectric", "specular_reflectance": 0.0, "specular_transmittance": 0.0},
        },
        plate={
            "type": "rectangle",
            "to_world": place().translate([-0.3, -0.4, -0.3]).scale(0.2),
            "bsdf": {"type": "roughconductor", "specular_reflectance": 0.0},
        },
        lamp={"type": "rectangle", "to_world": lamp_at, "emitter": {"type": "area", "radiance": 4.0}},
    )
    texts, ok = [], True
    for parameters in WAYS.values():
        made = mi.load_dict(bdpt(hide_emitters=True, **parameters))
        with Warned() as warnings:
            image = np.array(made.render(target, spp=32))
        rays = made.statistics["rays"]
        ok &= not image.any() and not warnings and made.statistics["non_finite"] == 0
        ok &= rays["shadow_inner"] == rays["shadow_s1"] == rays["shadow_t1"] == 0
        texts.append(f"largest value {image.max():g}, {sum(rays.values())} rays")
    return Outcome(bool(ok), "; ".join(texts))


# -- mirrors and glass: white furnaces, and `path` -------------------------------------------------


def corridor(reflectance: float, end: dict):
    """A square tube of mirrors, 100 times as long as wide, seen from one end.

    The steepest rays meet 64 of them before the ``end``.
    """
    mirror = {"type": "conductor", "material": "none", "specular_reflectance": reflectance}
    sides = {
        f"side{i}": {
            "type": "rectangle",
            "bsdf": {"type": "twosided", "bsdf": mirror},
            "to_world": place()
            .rotate([0, 0, 1], 90 * i)
            .translate([0.5, 0, -49])
            .rotate([0, 1, 0], -90)
            .scale([51, 0.6, 1]),  # beyond the corners, so that no ray slips out between two sides
        }
        for i in range(4)
    }
    plate = {"type": "rectangle", "to_world": place().translate([0, 0, -100]).scale(0.6)} | end
    fov = float(np.rad2deg(2 * np.arctan(SLOPE)))
    return scene(camera(**look((0, 0, 0), (0, 0, -1), fov)), end=plate, **sides)


def _corridor(reflectance: float) -> Outcome:
    target = corridor(reflectance, {"emitter": {"type": "area", "radiance": 1.0}, "bsdf": diffuse(0)})
    means = tiles(target, bdpt(max_depth=70, rr_depth=200), SEEDS, 64)
    # After n reflections about x or y; slopes are even over the film, and the tube is 1 wide.
    slopes = (np.arange(1 << 16).reshape(4, -1) + 0.5) / (1 << 15) - 1
    along = (reflectance ** np.floor(100 * SLOPE * np.abs(slopes) + 0.5)).mean(axis=1)
    known = np.outer(along, along).ravel()
    known = np.append(known, known.mean())
    text = f"mean {means[:, -1].mean():.6g}, "
    if reflectance < 1:
        off = np.abs(means.mean(axis=0) / known - 1).max()
        return Outcome(off <= OFF, f"{text}known {known[-1]:.6g}; tiles off by {off:.2g} at most")
    # Without noise but for the lamp seen directly, where one sample of 64 more or less counts for s = 0.
    off = np.abs(means - known).max()
    return Outcome(off <= 2 / (64 * 16), f"{text}tiles off by {off:.2g} at most")


def glass(inside=None, **keys):
    """A ball of glass in a white world, with what is ``inside`` it."""
    ball = {"type": "sphere", "bsdf": {"type": "dielectric", "int_ior": 1.5, "ext_ior": 1.0}}
    parts = {"ball": ball, "sky": {"type": "constant", "radiance": 1.0}} | (inside or {})
    return scene(camera(**look((0, 0, 4), (0, 0, 0), 40)) | keys, **parts)


def nested(inner: float, radius: float, centre=(0.0, 0.0, 0.0)) -> dict:
    """A smaller ball of another index in the glass of `glass`."""
    bsdf = {"type": "dielectric", "int_ior": inner, "ext_ior": 1.5}
    return {"inner": {"type": "sphere", "center": list(centre), "radius": radius, "bsdf": bsdf}}


def _nested(inner: float, parameters: dict) -> Judged:
    target = glass(nested(inner, 0.6, (0.2, 0.1, 0.0)))
    # Deeper paths carry what total reflection keeps inside: nothing here, for all light came from outside.
    return against_known(tiles(target, bdpt(rr_depth=200, **parameters), SEEDS, 64), 1.0, 0.02)


def _from_within() -> Judged:
    """Known: the light of a white world from the centre of glass is the square of its index."""
    target = glass(**look((0, 0, 0), (0.3, 0.1, -1), 60))
    return against_known(tiles(target, bdpt(rr_depth=200), SEEDS, 64), 1.5**2, 0.02)


def _total_reflection(parameters: dict) -> Judged:
    """A lamp in a glass cube, of whose sides light leaves within the critical angle only."""
    parts = {
        "cube": {
            "type": "cube",
            "to_world": place().rotate([0.70710678, 0.70710678, 0], 30).scale(0.5),
            "bsdf": {"type": "dielectric", "int_ior": 1.8},
        },
        "lamp": {
            "type": "sphere",
            "radius": 0.2,
            "bsdf": diffuse(0.3),
            "emitter": {"type": "area", "radiance": 3.0},
        },
        "floor": {
            "type": "rectangle",
            "bsdf": diffuse(0.6),
            "to_world": place().translate([0, -1, 0]).rotate([1, 0, 0], -90).scale(2),
        },
    }
    target = scene(camera(**look((0, 1, 3.5), (0, -0.2, 0), 40)), **parts)
    ours = tiles(target, bdpt(max_depth=16, **parameters), SEEDS, 256)
    return against(ours, tiles(target, {"type": "path", "max_depth": 16}, SEEDS, 1024), 0.03)


# -- surfaces of every roughness -----------------------------------------------------------------


def surface(bsdf: dict):
    """A ball and a plate of the ``bsdf`` in a room with a wide lamp."""
    t = place()
    return scene(
        camera(**look((0, 0.4, 3.2), (0, 0.1, 0), 45)),
        floor={
            "type": "rectangle",
            "bsdf": diffuse(0.5),
            "to_world": t.translate([0, -0.6, 0]).rotate([1, 0, 0], -90).scale(2.5),
        },
        back={"type": "rectangle", "bsdf": diffuse(0.4), "to_world": t.translate([0, 0.9, -1.5]).scale(2.5)},
        ball={"type": "sphere", "center": [-0.6, 0, 0], "radius": 0.55, "bsdf": bsdf},
        plate={
            "type": "rectangle",
            "to_world": t.translate([0.8, 0, -0.2]).rotate([0, 1, 0], -25).scale(0.5),
            "bsdf": bsdf,
        },
        lamp={
            "type": "rectangle",
            "to_world": t.translate([0, 2.2, 0.5]).rotate([1, 0, 0], 90).scale(0.9),
            "bsdf": diffuse(0),
            "emitter": {"type": "area", "radiance": 2.0},
        },
        sky={"type": "constant", "radiance": 0.1},
    )


def like_path(bsdf: dict, parameters: dict, reach=0.02) -> Judged:
    """Whether `surface` looks as under `path`, and every value is finite."""
    target = surface(bsdf)
    made = mi.load_dict(bdpt(max_depth=6, **parameters))
    made.render(target, spp=16)
    count = made.statistics["non_finite"]
    ours = tiles(target, bdpt(max_depth=6, **parameters), SEEDS, 128)
    outcome = against(ours, tiles(target, {"type": "path", "max_depth": 6}, SEEDS, 512), reach)
    text = f"{outcome.happened}; {count} values not finite"
    return replace(outcome, ok=outcome.ok and count == 0, happened=text)


def surfaces() -> dict:
    """BSDFs by name: what is tried, and the plugin."""
    found = {}
    for kind in ("roughconductor", "roughdielectric", "roughplastic"):
        for alpha in (1e-4, 1e-3, 1e-2, 0.1, 1.0):
            found[f"{kind}-{alpha:g}"] = (f"`{kind}` of roughness {alpha:g}", {"type": kind, "alpha": alpha})
    smooth_glass = {"type": "dielectric"}
    sharp = {"type": "roughconductor", "alpha": 1e-4}
    found["sharp-beside-glass"] = (
        "`blendbsdf` of a `roughconductor` of roughness 1e-4 and a `dielectric`",
        {"type": "blendbsdf", "weight": 0.5, "one": sharp, "two": smooth_glass},
    )
    found["sharp-glass-beside-glass"] = (
        "`blendbsdf` of a `roughdielectric` of roughness 1e-4 and a `dielectric`",
        {
            "type": "blendbsdf",
            "weight": 0.5,
            "one": {"type": "roughdielectric", "alpha": 1e-4},
            "two": smooth_glass,
        },
    )
    found["sharp-plastic-beside-mask"] = (
        "`mask` of opacity 0.5 over a `roughplastic` of roughness 1e-4",
        {"type": "mask", "opacity": 0.5, "bsdf": {"type": "roughplastic", "alpha": 1e-4}},
    )
    found["principled-sharp"] = (
        "`principled` of roughness 0.01, half transmitting, with a clear coat",
        {"type": "principled", "roughness": 0.01, "spec_trans": 0.5, "clearcoat": 1.0, "base_color": 0.7},
    )
    return found


def surface_cases():
    """Every surface by default, sharp ones with all strategies too."""
    families = {}
    for name in surfaces():
        kind, _, alpha = name.partition("-")
        families.setdefault(kind if alpha[:1].isdigit() else name, []).append(name)

    def run(names):
        outcomes = {}
        for name in names:
            text, bsdf = surfaces()[name]
            sharp = "sharp" in name or name.endswith("-0.0001")
            for way in WAYS if sharp else ("default parameters",):
                outcomes[f"{text}, {way}"] = like_path(bsdf, WAYS[way])
        return worst(outcomes)

    def case(family, names):
        tried = surfaces()[names[0]][0] if len(names) == 1 else f"`{family}` of roughness 1e-4 to 1"
        return _case(
            f"surface-{family}",
            tried,
            f"as `path`, every value finite: {WELCH}, which sees errors of 2 % of the image's mean",
            lambda: run(names),
        )

    return [case(family, names) for family, names in families.items()]


def glass_cases():
    """Mirrors, glass in glass, total reflection."""
    inside = {"water": 1.33, "air": 1.0, "diamond": 2.4}
    return [
        *(
            _case(
                f"corridor-{reflectance:g}",
                f"up to 64 bounces in a corridor of mirrors of reflectance {reflectance:g}, a lamp behind",
                f"that reflectance to the number of bounces; {tolerance}",
                lambda r=reflectance: _corridor(r),
                reflectance == 1,
            )
            for reflectance, tolerance in (
                (1.0, "tiles of 16 pixels to 2e-3, two samples of 64 in one of these"),
                (
                    0.98,
                    (
                        f"means of tiles over 8 seeds to {OFF:g}, since rays start 2e-4 of the width off "
                        "a mirror and so bounce the sooner (under `path` tiles are off by 4e-3)"
                    ),
                ),
            )
        ),
        _case(
            "nested-dielectrics",
            "balls of water, air and diamond in a ball of glass in a white world; all strategies, and "
            "defaults; the white world from the centre of glass",
            f"radiance 1, as nothing is absorbed, and 1.5^2 from within: {STUDENT}, which sees errors of 2 %",
            lambda: worst(
                {
                    f"{name}, {way}": _nested(ior, parameters)
                    for name, ior in inside.items()
                    for way, parameters in WAYS.items()
                }
                | {"from within": _from_within()}
            ),
            True,
        ),
        _case(
            "total-reflection",
            "a lamp in a glass cube of index 1.8: most of its light is reflected totally",
            f"as `path`: {WELCH}, which sees errors of 3 % (few paths leave the cube)",
            lambda: worst({way: _total_reflection(parameters) for way, parameters in WAYS.items()}),
        ),
    ]


CASES = (
    *closed_rooms(),
    *glass_cases(),
    *surface_cases(),
    _case(
        "closed-point-0.99-roulette",
        "point light in a closed sphere, albedo 0.99, no limit of the depth, roulette from edge 5",
        "finite; no more can be asked: survival is 0.95 at most, as in `path`, so squares grow by 0.99^2 / "
        "0.95 with each bounce and the variance is infinite, for `path` as well",
        _roulette,
    ),
    _case(
        "black",
        "all BSDFs black: diffuse, glass, rough metal; emitters hidden",
        "an image of zeros exactly, and no visibility ray",
        _black,
    ),
    _case(
        "too-bright-limited",
        "a closed sphere of reflectance 1.5, max_depth=7",
        f"the sum of 1.5^m ({STUDENT}, which sees errors of 3 %); one warning for all renders of the scene",
        _too_bright_depth,
        True,
    ),
    _case(
        "too-bright-unlimited",
        "a closed sphere whose texture reflects 1.2, no limit of the depth",
        "finite, and one warning; the true value is infinite",
        _too_bright_unlimited,
    ),
)
