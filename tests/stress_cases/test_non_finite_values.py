"""NaN and infinity from BSDFs, lamps, textures and vertices of meshes, mostly compared with their twins."""

from functools import partial

import mitsuba as mi
import numpy as np
import pytest
from meshes import as_ply
from scene_parts import T
from warned import Warned

from scenes import square

from .compare import agree, tiles
from .poisons import BAD_TEXELS, BSDFS, INF, NAN, brightness, painted, reflecting, sky_of, texture
from .rooms import SIZE, area, down, filled, plate, room
from .twins import DEFAULTS, EVERYTHING, PILOTED, RENDERS, SPP, compare_with_twin, decided, rendered

# -- compared with twins --------------------------------------------------------------------------


def glowing(value):
    # Mitsuba orders shapes by their addresses: random numbers would choose another of two lamps on shapes.
    lamp = {"type": "point", "position": [0.3, 0.7, 0], "intensity": 0.5}
    return room(other=square((-0.4, 0.5, -0.3), ([1, 0, 0], 60), 0.2, emitter=area(value)), lamp=lamp)


def spot(value):
    lamp = {"type": "spot", "intensity": 5.0, "cutoff_angle": 40, "to_world": down()}
    return room(other=lamp | {"texture": texture(value)})


def point(value):
    return room(other={"type": "point", "intensity": brightness(value)})


def sky(value):
    return room(wall=None, sky={"type": "constant", "radiance": brightness(value)})


def sun(value):
    return room(wall=None, sun={"type": "directional", "direction": [0, -1, -1], "irradiance": value})


def glowing_plate(value):
    return filled(None, plate={"type": "rectangle", "emitter": area(texture(value))}, lamp=None)


def spectrally_painted(value):
    """`reflecting` under a spectral variant: the coefficients of its texels set after loading.

    Mitsuba fits a spectrum to NaN as well. Where ``value`` is 0, they are set to those of black.
    """
    scene = reflecting(0.5)
    parameters = mi.traverse(scene)
    (name,) = [name for name, _ in parameters if name.endswith("reflectance.data")]
    data = np.array(parameters[name])
    data[np.array(texture(0.0)["bitmap"])[..., 0] == 0] = value if value != 0 else (0, 0, -INF)
    parameters[name] = mi.TensorXf(data)
    parameters.update()
    return scene


LAMPS = {
    "radiance NaN": (sky_of("eval"), NAN),
    "radiance infinite": (sky_of("eval"), INF),
    "densities NaN": (sky_of("pdf"), NAN),
    # With an infinite density beside a finite weight, next-event estimation would be believed alone.
    "densities infinite": (sky_of("pdf"), INF),
    "point NaN": (point, NAN),
    "point infinite": (point, INF),
    "area NaN": (glowing, NAN),
    "sky NaN": (sky, NAN),
    "sun NaN": (sun, NAN),
    "spot NaN": (spot, NAN),
}
# A sky seen directly is asked for no density, and a lamp of 0 has no table of emission.
UNSEEN = {"hide_emitters": True, "guiding": "photons"}
BY_CAMERA = {"light_paths": 0, "max_depth": 2}
POWER = EVERYTHING | UNSEEN | {"heuristic": "power"}

# Values that count of the bad texels: of s = 1 and of the subpath that would go on; of what is seen directly.
TEXELS = int(SIZE**2 * BAD_TEXELS) * SPP


def spectral(*arguments, **count):
    mi.set_variant("llvm_ad_spectral")
    compare_with_twin(*arguments, **count)


# Comparisons by their names.
TWINS = {
    f"{name} {bad}, {way}": partial(compare_with_twin, make, bad, *RENDERS[way])
    for name, make in BSDFS.items()
    for bad in (NAN, INF)
    for way in RENDERS
}
for way, (parameters, spp) in RENDERS.items():
    for name, lamp in LAMPS.items():
        TWINS[f"{name}, {way}"] = partial(compare_with_twin, *lamp, parameters | UNSEEN, spp)
for name, make in ("pdf", BSDFS["pdf"]), ("densities", sky_of("pdf")):
    for bad in (NAN, INF):
        TWINS[f"{name} {bad}, power"] = partial(compare_with_twin, make, bad, POWER)
for name, make, parameters, values in (
    ("reflectance", reflecting, BY_CAMERA, 2),
    ("red", lambda x: filled(painted([x, 0, 0])), BY_CAMERA, 2),  # in part NaN is not black
    ("passes", reflecting, BY_CAMERA | {"spp_per_pass": 3}, 2),
    ("variance", reflecting, BY_CAMERA | {"layers": "variance"}, 2),
    ("radiance", glowing_plate, {"light_paths": 0, "max_depth": 1}, 1),
    ("feature", reflecting, {"aovs": "a:albedo", "max_depth": 0}, 1),
):
    TWINS[name] = partial(compare_with_twin, make, NAN, parameters, count=values * TEXELS)
for name in ("radiance NaN", "densities infinite", "point NaN", "sky NaN"):
    TWINS[f"{name}, spectral"] = partial(spectral, *LAMPS[name], EVERYTHING | UNSEEN)
TWINS |= {
    "strategies": partial(compare_with_twin, BSDFS["eval"], NAN, EVERYTHING | {"layers": "strategies"}),
    "eval, spectral": partial(spectral, BSDFS["eval"], NAN, EVERYTHING),
    "texels, spectral": partial(spectral, spectrally_painted, NAN, BY_CAMERA, count=2 * TEXELS),
}


@pytest.mark.parametrize("name", TWINS)
def test_twins(name):
    """NaN or infinity: of a user's BSDF on half a plate (weight of sampled directions, these, the index of
    refraction beside glass, value, density), of half a user's environment, of Mitsuba's lamps, of texels of a
    spot, a reflectance, a lamp, an albedo; all strategies, and by default with so many samples that a pilot
    decides; the power heuristic; in passes; with layers; in `llvm_ad_spectral`.

    Expected: the image of its twin, in which that is 0, to 1e-5 of its maximum (same random numbers; only the
    order of sums differs); counted, of texels in the number that follows from the scene; one warning; the
    pilot finds the same mean, and the twin renders by its decision.
    """
    TWINS[name]()


def test_pilot():
    """A pilot meets a BSDF of value NaN.

    Expected: counted apart (`non_finite_in_pilot`), in the warning and in `explain`; the decision is its
    twin's.
    """

    def met(value):
        bdpt, scene = mi.load_dict({"type": "bdpt", "max_depth": 4}), BSDFS["eval"](value)
        with Warned() as warnings:
            bdpt.render(scene, spp=PILOTED)
        return bdpt.statistics, warnings, "\ninvalid samples" in bdpt.explain(scene, spp=PILOTED)

    (statistics, warnings, explained), (twin, quiet, silent) = met(NAN), met(0.0)
    assert statistics["non_finite_in_pilot"] > 0
    assert decided(statistics) == decided(twin) != []
    assert len(warnings) == 1
    assert f"{statistics['non_finite_in_pilot']} of the pilot" in warnings[0]
    assert explained
    assert not silent
    assert not quiet


def test_interrupted_with_nan():
    """Texels of a reflectance NaN, Ctrl-C after the second pass.

    Expected: `KeyboardInterrupt`, and the warning comes all the same.
    """
    bdpt = mi.load_dict({"type": "bdpt", "max_depth": 2, "spp_per_pass": 4})

    def stop(report):
        if report.spp_done >= 8:
            raise KeyboardInterrupt

    bdpt.on_pass = stop
    with Warned() as warnings, pytest.raises(KeyboardInterrupt):
        bdpt.render(filled(painted(NAN)), spp=64)
    assert bdpt.statistics["non_finite"] > 0
    assert len(warnings) == 1


# -- light that is lost ---------------------------------------------------------------------------


def envmap(value):
    data = np.full((8, 16, 3), 1.0, dtype=np.float32)
    data[0, 0] = value
    return {"type": "envmap", "bitmap": mi.Bitmap(data)}


def projector(value):
    return {"type": "projector", "irradiance": texture(value), "fov": 50, "to_world": down()}


def bulb(value):
    return {"type": "point", "position": [0.2, 0, 0.1], "intensity": brightness(value)}


LOST = {
    "envmap": (envmap, "other.data"),
    "projector": (projector, "irradiance.data"),
    "point": (bulb, "intensity"),
}


@pytest.mark.parametrize("way", RENDERS)
@pytest.mark.parametrize(
    "lamp, variant", [*((lamp, "llvm_ad_rgb") for lamp in LOST), ("point", "llvm_ad_spectral")]
)
def test_lost(lamp, way, variant):
    """The only light NaN: a point; texels of an `envmap` or of a `projector`, of which Mitsuba makes a
    distribution.

    Expected: black, counted, named in one warning; with a number in their place there is light, and nothing
    to say.
    """
    mi.set_variant(variant)
    make, parameter = LOST[lamp]
    scene, sound = (room(wall=None, lamp=None, other=make(value)) for value in (NAN, 1.0))
    image, statistics, warnings = rendered(scene, *RENDERS[way])
    assert not image.any()
    assert statistics["non_finite"] > 0
    assert len(warnings) == 1
    assert parameter in warnings[0]
    light, statistics, quiet = rendered(sound, *RENDERS[way])
    assert light.mean() > 0.01
    assert statistics["non_finite"] == 0
    assert not quiet


@pytest.mark.parametrize("way", RENDERS)
def test_area_texels(way):
    """Texels of an area light NaN; all strategies, and defaults.

    Expected: only these texels are lost: the image of its twin, in which they are 0; Welch's test of tiles
    (1e-3), which sees errors of 2 %.
    """
    place = (-0.2, 0.6, -0.3), ([1, 0, 0], 60), 0.3
    scenes = (room(other=square(*place, emitter=area(texture(value)))) for value in (NAN, 0.0))
    agree(*(tiles(scene, RENDERS[way][0], range(8), PILOTED) for scene in scenes), 0.02)


# -- meshes ---------------------------------------------------------------------------------------

CORNERS = np.array([[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]])
NORMALS, COORDINATES = CORNERS * 0 + [0, 0, 1], (CORNERS[:, :2] + 1) / 2
FACES = np.array([[0, 1, 2], [0, 2, 3]])


def spoil(scene, name, bad):
    """Set the data ``name`` of the last corner of a scene's mesh, which files must not hold."""
    parameters = mi.traverse(scene)
    data = np.array(parameters[name])
    data[-len(data) // 4 :] = bad
    parameters[name] = mi.Float(data)
    parameters.update()
    return scene


@pytest.mark.parametrize("bad", [NAN, INF])
@pytest.mark.parametrize("data", ["vertex_positions", "vertex_normals", "vertex_texcoords"])
def test_vertices(data, bad):
    """A position, a normal or texture coordinates of one of four vertices NaN or infinite, set after loading.

    Expected: as `path`: triangles of such positions meet no ray, of such normals reflect nothing (subpaths
    that end there count, and are warned of); Welch's test of tiles (1e-3), which sees errors of 2 %.
    """
    mesh = as_ply(CORNERS, FACES, NORMALS, COORDINATES) | {"to_world": plate()["to_world"]}
    scene = room(plate=mesh | {"bsdf": {"type": "twosided", "bsdf": painted(0.1)}})
    scene = spoil(scene, f"plate.{data}", bad)
    theirs = tiles(scene, {"type": "path", "max_depth": 4}, range(8), PILOTED)
    agree(tiles(scene, {"max_depth": 4}, range(8), PILOTED), theirs, 0.02)
    _, statistics, warnings = rendered(scene, DEFAULTS, 16)
    assert (statistics["non_finite"] > 0) == bool(warnings) == (data == "vertex_normals")


@pytest.mark.parametrize("way", RENDERS)
def test_texture_coordinates_of_lamps(way):
    """`vertex_texcoords` of one of the four vertices of a textured lamp NaN; all strategies, and defaults.

    Expected: that triangle is dark, counted and named (`path` is NaN all over); Welch's test of tiles (1e-3)
    against `path` with a dark triangle there, which sees errors of 2 %.
    """
    texels = np.random.default_rng(1).random((4, 4, 3)).astype(np.float32)
    emits = {"emitter": area({"type": "bitmap", "bitmap": mi.Bitmap(texels), "raw": True})}
    place = {
        "bsdf": {"type": "diffuse"},
        "to_world": T().translate([-0.2, 0.6, -0.3]).rotate([1, 0, 0], 60).scale(0.3),
    }
    lamp, sound, spoilt = (
        as_ply(CORNERS, faces, None, COORDINATES) | place for faces in (FACES, FACES[:1], FACES[1:])
    )
    scene = spoil(room(lamp=None, other=lamp | emits), "other.vertex_texcoords", NAN)
    dark = room(lamp=None, other=sound | emits, more=spoilt)
    theirs = tiles(dark, {"type": "path", "max_depth": 4}, range(8), 4 * PILOTED)
    parameters, spp = RENDERS[way]
    agree(tiles(scene, parameters, range(8), max(spp, 256)), theirs, 0.02)
    _, statistics, warnings = rendered(scene, parameters, 16)
    assert statistics["non_finite"] > 0
    assert len(warnings) == 1
    assert "other.vertex_texcoords" in warnings[0]
