"""NaN and infinity in what Mitsuba makes a distribution of, and in vertices of meshes."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

import mitsuba as mi  # isort: skip

from .agreement import against, tiles, together, worst
from .case import Outcome, of_section
from .poisons import INF, NAN, down, painted, room, texture, to_world
from .twins import DEFAULTS, PILOTED, RENDERS, rendered

_case = of_section("NaN and infinity")

# Mean of an image that is lit.
LIT = 0.01


def _lost_whole(lamp: Callable, parameter: str) -> Outcome:
    """Whether nothing is left of the only light, ``lamp(NAN)``, and ``parameter`` is named.

    With a number in its place there is light, and nothing to say.
    """
    texts, ok = [], True
    scene, sound = (room(wall=None, lamp=None, other=lamp(value)) for value in (NAN, 1.0))
    for parameters, spp in RENDERS.values():
        image, statistics, warnings = rendered(scene, parameters, spp)
        found = statistics["non_finite"]
        ok = ok and (image == 0).all() and found > 0 and len(warnings) == 1 and parameter in warnings[0]
        light, of_sound, quiet = rendered(sound, parameters, spp)
        ok = ok and light.mean() > LIT and of_sound["non_finite"] == 0 and not quiet
        texts.append(f"mean {image.mean():.2g}, without NaN {light.mean():.2g}; {found} counted")
    path = np.array(mi.load_dict({"type": "path", "max_depth": 4}).render(scene, spp=64))
    return Outcome(bool(ok), f"{'; '.join(texts)}; `path`: mean {np.nanmean(path):.2g}, says nothing")


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
        _case(
            "distribution-nan",
            "texels of an `envmap`, or of a `projector`, NaN",
            "all light that takes Mitsuba's distribution is lost, with a warning: black, counted, named; "
            "with a number in their place there is light, and nothing to say",
            lost,
        ),
        _case(
            "area-texels-nan",
            "texels of an area light NaN; all strategies, and defaults",
            "only these texels are lost: the image of its twin, in which they are 0; Welch's test over tiles "
            "(level 1e-3, 8 seeds each), which sees errors of 2 %",
            lambda: worst({way: of_area(parameters) for way, (parameters, _) in RENDERS.items()}),
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
    for way, (parameters, spp) in RENDERS.items():
        ours = tiles(scene, {"type": "bdpt", **parameters}, range(8), max(spp, 256))
        outcome = against(ours, theirs, 0.02)
        _, statistics, warnings = rendered(scene, parameters, 16)
        found = statistics["non_finite"]
        ok = outcome.ok and found > 0 and len(warnings) == 1 and "other.vertex_texcoords" in warnings[0]
        outcomes[way] = Outcome(ok, f"{outcome.happened}; {found} counted")
    return together(outcomes)


def mesh_cases():
    """Vertices of a mesh that are not finite."""
    what = {
        "vertex_positions": "their triangles meet no ray, as under `path`, and are not counted",
        "vertex_normals": "their triangles reflect nothing, as under `path`; subpaths that end there count",
        "vertex_texcoords": "Mitsuba looks up some texel, as under `path`; nothing to count",
    }
    lamp = _case(
        "mesh-lamp-texcoords",
        "`vertex_texcoords` of one of the four vertices of a textured lamp NaN; all strategies, and defaults",
        "that triangle is dark, counted and named (`path` is NaN all over); Welch's test over tiles against "
        "`path` with a dark triangle there (level 1e-3, 8 seeds each), which sees errors of 2 %",
        lambda: _lamp_texcoords(NAN),
    )
    return [
        lamp,
        *(
            _case(
                f"mesh-{data.replace('_', '-')}",
                f"`{data}` of one of four vertices NaN or infinite, set after loading",
                f"{expected}; Welch's test over tiles against `path` (level 1e-3, 8 seeds each), which sees "
                "errors of 2 %",
                lambda data=data: together({str(bad): _mesh(data, bad) for bad in (NAN, INF)}),
            )
            for data, expected in what.items()
        ),
    ]


CASES = (*distribution_cases(), *mesh_cases())
