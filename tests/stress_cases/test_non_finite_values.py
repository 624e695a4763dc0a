"""NaN and infinity from BSDFs, lamps, textures and vertices of meshes, mostly compared with their twins."""

import mitsuba as mi
import numpy as np
import pytest
from mitsuba_bdpt.settings import HEURISTICS
from scene_parts import T
from warned import Warned

from scenes import square

from .compare import agree, tiles
from .poisons import BAD_TEXELS, BSDFS, INF, NAN, brightness, painted, reflecting, sky_of, texture
from .rooms import SIZE, area, down, filled, plate, room
from .twins import DEFAULTS, EVERYTHING, PILOTED, RENDERS, SPP, compare_with_twin, decided, rendered

# -- BSDFs ----------------------------------------------------------------------------------------


@pytest.mark.parametrize("way", RENDERS)
@pytest.mark.parametrize("bad", [NAN, INF])
@pytest.mark.parametrize("name", BSDFS)
def test_bsdfs(name, bad, way):
    """A user's BSDF: on half a plate the weight of sampled directions, these, the index of refraction beside
    glass, the value or the density is NaN or infinite; all strategies, and by default with so many samples
    that a pilot decides.

    Expected: the image of its twin, in which that is 0, to 1e-5 of its maximum (same random numbers; only the
    order of sums differs); counted; one warning; the pilot finds the same mean, and the twin renders by its
    decision.
    """
    compare_with_twin(BSDFS[name], bad, *RENDERS[way])


# -- lamps ----------------------------------------------------------------------------------------


def glowing(value):
    # Mitsuba orders shapes by their addresses: random numbers would choose another of two lamps on shapes.
    lamp = {"type": "point", "position": [0.3, 0.7, 0], "intensity": 0.5}
    return room(other=square((-0.4, 0.5, -0.3), ([1, 0, 0], 60), 0.2, emitter=area(value)), lamp=lamp)


def spot(value):
    lamp = {"type": "spot", "intensity": 5.0, "cutoff_angle": 40, "to_world": down()}
    return room(other=lamp | {"texture": texture(value)})


LAMPS = {
    "radiance NaN": (sky_of("eval"), NAN),
    "radiance infinite": (sky_of("eval"), INF),
    "densities NaN": (sky_of("pdf"), NAN),
    # With an infinite density beside a finite weight, next-event estimation would be believed alone.
    "densities infinite": (sky_of("pdf"), INF),
    "point NaN": (lambda x: room(other={"type": "point", "intensity": brightness(x)}), NAN),
    "point infinite": (lambda x: room(other={"type": "point", "intensity": brightness(x)}), INF),
    "area NaN": (glowing, NAN),
    "sky NaN": (lambda x: room(wall=None, sky={"type": "constant", "radiance": brightness(x)}), NAN),
    "sun NaN": (
        lambda x: room(wall=None, sun={"type": "directional", "direction": [0, -1, -1], "irradiance": x}),
        NAN,
    ),
    "spot NaN": (spot, NAN),
}
HIDDEN = {"hide_emitters": True}  # a sky seen directly is asked for no density


@pytest.mark.parametrize("way", RENDERS)
@pytest.mark.parametrize("name", LAMPS)
def test_lamps(name, way):
    """Half of the radiance or the densities of a user's environment, Mitsuba's lamps and a spot's texture NaN
    or infinite; all strategies, and by default with a pilot. A plate keeps a lamp that is sound.

    Expected: as of BSDFs.
    """
    parameters, spp = RENDERS[way]
    # A lamp of 0 has no table of emission.
    compare_with_twin(*LAMPS[name], parameters | HIDDEN | {"guiding": "photons"}, spp)


@pytest.mark.parametrize("heuristic", HEURISTICS)
@pytest.mark.parametrize("what", ["plate NaN", "plate infinite", "densities NaN", "densities infinite"])
def test_heuristics(what, heuristic):
    """Densities NaN or infinite, of half a plate or of half a user's environment, under both heuristics.

    Expected: as of BSDFs.
    """
    plates = {"plate NaN": (BSDFS["pdf"], NAN), "plate infinite": (BSDFS["pdf"], INF)}
    compare_with_twin(*(plates | LAMPS)[what], EVERYTHING | HIDDEN | {"heuristic": heuristic})


# -- exact numbers --------------------------------------------------------------------------------


def glowing_plate(value):
    return filled(None, plate={"type": "rectangle", "emitter": area(texture(value))}, lamp=None)


BY_CAMERA = {"light_paths": 0, "max_depth": 2}

# The scene by a value, parameters, and how many values of each camera sample of the bad texels count: of s =
# 1 and of the subpath that would go on; of what is seen directly.
COUNTED = {
    "reflectance": (reflecting, BY_CAMERA, 2),
    "red": (lambda x: filled(painted([x, 0, 0])), BY_CAMERA, 2),  # in part NaN is not black
    "passes": (reflecting, BY_CAMERA | {"spp_per_pass": 3}, 2),
    "variance": (reflecting, BY_CAMERA | {"layers": "variance"}, 2),
    "radiance": (glowing_plate, {"light_paths": 0, "max_depth": 1}, 1),
    "feature": (reflecting, {"aovs": "a:albedo", "max_depth": 0}, 1),
}
PIXELS = int(SIZE**2 * BAD_TEXELS)


@pytest.mark.parametrize("name", COUNTED)
def test_counted(name):
    """Texels NaN: of a reflectance in all colours, or in one of black; in passes of 3 samples; with the
    variance; of a lamp seen directly; of an albedo shown by `aovs`.

    Expected: the number that follows from the scene, exactly; otherwise as of BSDFs.
    """
    make, parameters, each = COUNTED[name]
    compare_with_twin(make, NAN, parameters, count=each * PIXELS * SPP)


def test_strategy_images():
    """Half a plate's BSDF has the value NaN: all layers of `layers=strategies`.

    Expected: as of BSDFs.
    """
    compare_with_twin(BSDFS["eval"], NAN, EVERYTHING | {"layers": "strategies"})


@pytest.mark.parametrize("variant", ["llvm_ad_rgb", "llvm_ad_spectral"])
def test_only_light(variant):
    """The only light, a point in a closed white sphere, of intensity NaN; all strategies.

    Expected: black; three values of each sample are counted (its light subpath, s = 1 at two vertices), and
    the intensity is named once.
    """
    mi.set_variant(variant)
    wall = {"type": "sphere", "bsdf": {"type": "twosided", "bsdf": {"type": "diffuse"}}}
    lamp = {"type": "point", "position": [0.2, 0, 0.1], "intensity": brightness(NAN)}
    scene = room(wall=wall, plate=None, lamp=lamp)
    image, statistics, warnings = rendered(scene, {"skip": "none", "max_depth": 3}, SPP)
    assert not image.any()
    assert statistics["non_finite"] == 3 * SIZE**2 * SPP
    assert len(warnings) == 1
    assert "intensity" in warnings[0]


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


@pytest.mark.parametrize(
    "what", ["radiance NaN", "densities infinite", "point NaN", "sky NaN", "eval", "texels"]
)
def test_spectral(what):
    """`llvm_ad_spectral`, where a poisoned value has as many wavelengths as a path: lamps, a texture and a
    BSDF that are NaN, an infinite density; all strategies.

    Expected: as in colours.
    """
    mi.set_variant("llvm_ad_spectral")
    if what == "texels":
        compare_with_twin(spectrally_painted, NAN, BY_CAMERA, count=2 * PIXELS * SPP)
    elif what == "eval":
        compare_with_twin(BSDFS["eval"], NAN, EVERYTHING)
    else:
        compare_with_twin(*LAMPS[what], EVERYTHING | HIDDEN)


# -- decisions, interruptions ---------------------------------------------------------------------


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


# -- Mitsuba's distributions ----------------------------------------------------------------------


def envmap(value):
    data = np.full((8, 16, 3), 1.0, dtype=np.float32)
    data[0, 0] = value
    return {"type": "envmap", "bitmap": mi.Bitmap(data)}


def projector(value):
    return {"type": "projector", "irradiance": texture(value), "fov": 50, "to_world": down()}


@pytest.mark.parametrize("way", RENDERS)
@pytest.mark.parametrize("lamp, parameter", [(envmap, "other.data"), (projector, "irradiance.data")])
def test_distributions(lamp, parameter, way):
    """Texels of an `envmap`, or of a `projector`, NaN, of which Mitsuba makes a distribution.

    Expected: all light is lost, with a warning: black, counted, named; with a number in their place there is
    light, and nothing to say.
    """
    scene, sound = (room(wall=None, lamp=None, other=lamp(value)) for value in (NAN, 1.0))
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

CORNERS = np.array([[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]], dtype=np.float32)


def mesh(place, faces=((0, 1, 2), (0, 2, 3)), normals=True, spoilt=None, bad=NAN, **props):
    """A square in its ``place``, with the ``spoilt`` data of its last corner ``bad``."""
    found = mi.Properties()
    for name, part in props.items():
        found[name] = mi.load_dict(part)
    normal = np.array(place @ mi.ScalarNormal3f(0, 0, 1))
    data = {
        "vertex_positions": np.array([list(place @ mi.ScalarPoint3f(*c)) for c in CORNERS]),
        "vertex_texcoords": (CORNERS[:, :2] + 1) / 2,
    } | ({"vertex_normals": np.tile(normal / np.linalg.norm(normal), (4, 1))} if normals else {})
    if spoilt:
        data[spoilt][3] = bad
    made = mi.Mesh("mesh", 4, len(faces), has_vertex_normals=normals, has_vertex_texcoords=True, props=found)
    parameters = mi.traverse(made)
    for name, values in data.items():
        parameters[name] = np.asarray(values, dtype=np.float32).ravel()
    parameters["faces"] = np.array(faces, dtype=np.uint32).ravel()
    parameters.update()
    return made


@pytest.mark.parametrize("bad", [NAN, INF])
@pytest.mark.parametrize("data", ["vertex_positions", "vertex_normals", "vertex_texcoords"])
def test_vertices(data, bad):
    """A position, a normal or texture coordinates of one of four vertices NaN or infinite, set after loading.

    Expected: as `path`: triangles of such positions meet no ray, of such normals reflect nothing (subpaths
    that end there count, and are warned of); Welch's test of tiles (1e-3), which sees errors of 2 %.
    """
    scene = room(
        plate=mesh(plate()["to_world"], spoilt=data, bad=bad, bsdf={"type": "twosided", "bsdf": painted(0.1)})
    )
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
    place = T().translate([-0.2, 0.6, -0.3]).rotate([1, 0, 0], 60).scale(0.3)
    bsdf = {"type": "diffuse", "reflectance": 0.5}
    sound, spoilt = [0, 1, 2], [0, 2, 3]
    lamp = mesh(place, [sound, spoilt], False, "vertex_texcoords", bsdf=bsdf, **emits)
    scene = room(lamp=None, other=lamp)
    halves = mesh(place, [sound], False, bsdf=bsdf, **emits), mesh(place, [spoilt], False, bsdf=bsdf)
    dark = room(lamp=None, other=halves[0], more=halves[1])
    theirs = tiles(dark, {"type": "path", "max_depth": 4}, range(8), 4 * PILOTED)
    parameters, spp = RENDERS[way]
    agree(tiles(scene, parameters, range(8), max(spp, 256)), theirs, 0.02)
    _, statistics, warnings = rendered(scene, parameters, 16)
    assert statistics["non_finite"] > 0
    assert len(warnings) == 1
    assert "other.vertex_texcoords" in warnings[0]
