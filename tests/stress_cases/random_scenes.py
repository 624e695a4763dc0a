"""Random scenes, drawn by hypothesis: shapes, BSDFs, emitters, sensors, and which strategies are in use."""

from bsdf_parts import blend, bumps, tilted
from hypothesis import strategies as st
from scene_parts import T, film, grey, sky_bitmap

from scenes import area, floor


def sides(bsdf):
    return {"type": "twosided", "bsdf": bsdf}


def rough(kind, alpha):
    return {"type": kind, "alpha": alpha}


MATTE = {"type": "diffuse", "reflectance": 0.6}

# By name, of a roughness.
BSDFS = {
    "diffuse": lambda a: grey(0.6),
    "conductor": lambda a: sides({"type": "conductor"}),
    "dielectric": lambda a: {"type": "dielectric"},
    "thindielectric": lambda a: {"type": "thindielectric"},
    "plastic": lambda a: sides({"type": "plastic"}),
    "roughconductor": lambda a: sides(rough("roughconductor", a)),
    "roughdielectric": lambda a: rough("roughdielectric", a),
    "roughplastic": lambda a: sides(rough("roughplastic", a)),
    "principled": lambda a: {"type": "principled", "roughness": a, "metallic": 0.3, "spec_trans": 0.3},
    "mask": lambda a: {"type": "mask", "opacity": 0.6, "bsdf": grey(0.6)},
    "blend": lambda a: sides(blend(0.4, MATTE, rough("roughconductor", a))),
    "bumpmap": lambda a: sides(bumps(MATTE)),
    "normalmap": lambda a: sides(tilted(rough("roughconductor", a))),
}


def turned(center, angle, scale=1.0):
    return T().translate(center).rotate([0.26726124, 0.53452248, 0.80178373], angle).scale(scale)


SHAPES = {
    name: lambda center, angle, size, name=name: {"type": name, "to_world": turned(center, angle, size)}
    for name in ("sphere", "cube", "disk", "cylinder", "rectangle")
}


def shining(shape):
    return shape | {"bsdf": {"type": "diffuse", "reflectance": 0.3}, "emitter": area(4.0)}


# By name, of a place, an angle and a size.
LAMPS = {
    **{name: lambda c, a, s, make=make: shining(make(c, a, s)) for name, make in SHAPES.items()},
    # Seen under cones of which Mitsuba's density cancels.
    "bulb": lambda c, a, s: shining(SHAPES["sphere"](c, a, 0.05 * s)),
    "glint": lambda c, a, s: shining(SHAPES["sphere"](c, a, 2e-3 * s)),
    "around": lambda c, a, s: shining({"type": "sphere", "radius": 9.0, "flip_normals": True}),
    "point": lambda c, a, s: {"type": "point", "position": c},
    "spot": lambda c, a, s: {"type": "spot", "cutoff_angle": 30 + a / 9, "to_world": turned(c, a)},
    "directional": lambda c, a, s: {"type": "directional", "direction": [c[0], -2, c[2]]},
    "constant": lambda c, a, s: {"type": "constant"},
    "envmap": lambda c, a, s: {
        "type": "envmap",
        "bitmap": sky_bitmap(),
        "to_world": turned([0, 0, 0], a),
    },
}
SKIES = ("constant", "envmap")


def between(low, high):
    """One of 65 numbers: floats of hypothesis are often nearly zero."""
    return st.integers(0, 64).map(lambda i: low + (high - low) * i / 64)


PLACES = st.tuples(between(-1.5, 1.5), between(-0.5, 1.5), between(-1.5, 1.5)).map(list)
LARGE = between(0.25, 0.75)


@st.composite
def objects(draw):
    """One shape."""
    shape = SHAPES[draw(st.sampled_from(sorted(SHAPES)))](draw(PLACES), draw(between(0, 360)), draw(LARGE))
    bsdf = BSDFS[draw(st.sampled_from(sorted(BSDFS)))](draw(between(0.125, 0.5)))
    return shape | {"bsdf": bsdf}


@st.composite
def lamps(draw, kinds):
    """One or two emitters by name, with a weight each; the first is the next one of ``kinds``."""
    names = draw(st.lists(st.sampled_from(sorted(LAMPS)), min_size=1, max_size=2))
    # All is drawn before the kind is known: hypothesis expects the same draws after the same values.
    drawn = [[draw(d) for d in (PLACES, between(0, 360), LARGE, between(0.125, 8))] for _ in names]
    names[0] = next(kinds)
    if set(names) <= set(SKIES):
        names = names[:1]  # a scene has one environment
    found = {}
    for number, (name, (place, angle, size, weight)) in enumerate(zip(names, drawn, strict=False)):
        lamp = LAMPS[name](place, angle, size)
        lamp.get("emitter", lamp)["sampling_weight"] = weight
        found[f"lamp {number} {name}"] = lamp
    return found


def kinds_of(scene) -> list[str]:
    """Names in `LAMPS` of a scene's emitters."""
    return [key.split()[2] for key in scene if key.startswith("lamp ")]


@st.composite
def sensors(draw):
    """A camera that looks at the middle."""
    x, y = draw(between(-3, 3)), draw(between(0.5, 3))
    sensor = {
        "type": draw(st.sampled_from(["perspective", "thinlens"])),
        "fov": draw(between(30, 90)),
        "near_clip": 0.125,
        "far_clip": 100.0,
        "to_world": T().look_at([x, y, 4], [0, 0, 0], [0, 1, 0]),
        "film": film(16, height=12),
    }
    lens = {"aperture_radius": draw(between(0.0625, 0.5)), "focus_distance": 4.0}
    return sensor | (lens if sensor["type"] == "thinlens" else {})


@st.composite
def scenes(draw, kinds):
    """A scene as a dictionary: shapes on a floor, `lamps`, a sensor."""
    bsdf = BSDFS[draw(st.sampled_from(["diffuse", "plastic", "roughconductor", "blend"]))](0.25)
    scene = {"type": "scene", "sensor": draw(sensors()), "floor": floor(-1, 4, bsdf)}
    scene |= {f"object {i}": o for i, o in enumerate(draw(st.lists(objects(), min_size=1, max_size=3)))}
    return scene | draw(lamps(kinds))


@st.composite
def renders(draw, kinds):
    """A scene, and parameters that put strategies in use with different coefficients.

    The first of the scene's lamps is the next one of ``kinds``.
    """
    share = draw(st.sampled_from([1.0, 0.25, 0.0625]))
    skip = draw(st.sampled_from(["none", "impossible"]))
    connections = draw(st.sampled_from(["all", "one"]))
    return draw(scenes(kinds)), {"light_paths": share, "skip": skip, "connections": connections}
