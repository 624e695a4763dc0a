"""Every kind of emitter with every kind of sensor: the image, the strategies, and what is left out.

The reference is Mitsuba's `path`, or a closed form where it is blind. Scenes and the table of who takes part
in what: `scene_parts`. In its open scene the geometry term is bounded, so that single strategies can be
compared as well. The sample is the mean of a quarter of the image (and of all of it) in one render; renders
of 12 seeds. Against `path` Welch's t-test, against a known value and between the strategies of the same
renders (which share subpaths) Student's of the differences; Šidák over all comparisons of a test, at 1e-4.
Roulette is off (paths of up to 3 edges).
"""

import re
from pathlib import Path

import mitsuba as mi
import numpy as np
import pytest
import scene_parts as parts
import welch as st
from mitsuba_bdpt.host.jit import evaluated_mode
from test_known_answers import LAMPS_ABOVE, UPWARDS_METER, irradiance_above

import scenes

LEVEL = 1e-4
DEPTH = 3
SEEDS = 12
CHANNELS = np.array([0.5, 1.0, 1.5])  # one number per pixel that sees every channel
SAMPLES = 1 << 15  # of ours in a render; twice as many of `path`
SAMPLES_OF_A_PIXEL = 1 << 14  # where there is one alone
LEAST_SHARE = 0.9  # of the renders in which a tile must be lit to be compared

ROOT = Path(__file__).resolve().parents[2]
T = parts.T


def renders(scene, method, samples, first_seed, seeds=SEEDS):
    """Images of renders with ``samples`` camera samples in all; of one pixel, in proportion."""
    width, height = scene.sensors()[0].film().crop_size()
    pixels = width * height
    spp = samples // pixels if pixels > 1 else samples * SAMPLES_OF_A_PIXEL // SAMPLES
    return scenes.renders(scene, method, spp, seeds, first_seed)


def bdpt(**parameters):
    return scenes.integrator(**{"max_depth": DEPTH, "skip": "none"} | parameters)


def path():
    return scenes.integrator("path", max_depth=DEPTH)


def layer(images, method, kind, s, t):
    """Tiles of the technique image (s, t); None if there is none."""
    name = f"{kind}.s{s}t{t}"
    return tiles(scenes.layer(images, method, name)) if f"{name}.R" in method.aov_names() else None


def tiles(images):
    """One number for each quarter of the images: (seeds, 4), or (seeds, 1) of a single pixel."""
    count = 2 if images.shape[1] > 1 else 1
    return np.stack([st.tile_means(image, count) @ CHANNELS for image in images[..., :3]])


def paired(a, b, label):
    """Student's test of the differences of two estimates from the same renders, tile by tile and for the
    whole image, as far as both are lit: a few lumps are not normal."""
    a, b = (np.concatenate([x, x.mean(1, keepdims=True)], axis=1) for x in (a, b))
    lit = np.minimum((a != 0).mean(0), (b != 0).mean(0)) >= LEAST_SHARE
    found = st.one_sample((a - b)[:, lit], 0.0, label)
    found.continuous[:] = False  # not independent of each other: no test of uniformity
    return found


def assert_agree(comparisons):
    st.assert_agree(st.Comparisons.join(comparisons), LEVEL, at_least=0)


def precise(images, relative, label):
    """The mean of all renders must be known well enough for the comparison to mean something."""
    whole = images.mean(1)
    error = whole.std(ddof=1) / np.sqrt(len(whole))
    assert whole.mean() > 0, f"{label}: nothing to compare"
    assert error < relative * whole.mean(), f"{label}: too noisy, {error / whole.mean():.2%}"


# -- pairs ------------------------------------------------------------------------------------

# `path` loses the emitter's light, or there is no equal for it.
NO_REFERENCE = {
    # The emitter's own shape stands between the scene and the sensor; see the known answers below.
    ("directionalarea", "distant"),
    # These see its dark outside only.
    ("inside of a sphere", "distant"),
    ("inside of a sphere", "distant, point"),
    ("inside of a sphere", "distant, shape"),
    # A beam, one surface, the sensor: t = 1 alone makes such paths, and these sensors have none. `explain`
    # says that they are lost (test_explain_says_what_is_lost).
    *(("directionalarea", s) for s in ("distant, point", "distant, shape", "radiancemeter")),
    *(("directionalarea", s) for s in ("mixed batch", "own fisheye")),
}
PAIRS = [(e, s) for e in parts.EMITTERS for s in parts.SENSORS if (e, s) not in NO_REFERENCE]

# In every run: each emitter with a camera, each sensor with an emitter near and one at infinity, of which
# one can be hit and one cannot, in turns.
WITH_SENSORS = (("sphere", "directional"), ("spot", "envmap"))
QUICK = {(e, s) for i, s in enumerate(parts.SENSORS) for e in WITH_SENSORS[i % 2]}


# One emitter of each plugin; of those that take part in the same strategies the first.
PLUGINS = {parts.plugin_of(make()): name for name, make in reversed(parts.EMITTERS.items())}
DISTINCT = {part: PLUGINS[plugin] for plugin, part in parts.EMITTER_PARTS.items()}.values()


def pairs(quick, slow):
    """Parameters of a test: the ``quick`` pairs, and those for which ``slow`` holds, marked so."""
    chosen = [(p, quick(*p)) for p in PAIRS if quick(*p) or slow(*p)]
    return [pytest.param(*p, marks=[pytest.mark.slow] * (not now), id=" + ".join(p)) for p, now in chosen]


def is_quick(emitter, sensor):
    return sensor == "perspective" or (emitter, sensor) in QUICK


def in_turns(emitter, sensor):
    return (list(parts.EMITTERS).index(emitter) + list(parts.SENSORS).index(sensor)) % 5 == 0


@pytest.mark.parametrize(("emitter", "sensor"), pairs(is_quick, lambda e, s: e in DISTINCT))
def test_pair(emitter, sensor):
    """The image is `path`'s, known to 1 %; the weighted layers add up to it (1e-4 of its mean: other orders
    of sums); for k = 1, 2, 3 every strategy that takes part by `scene_parts` has the mean of the first, all
    others are dark."""
    scene = parts.pair(emitter, sensor)
    method = bdpt(layers="strategies")
    images = renders(scene, method, SAMPLES, 0)
    other = parts.pair(emitter, sensor, reference=True)
    with evaluated_mode(emitter == "timed_sunsky"):
        reference = tiles(renders(other, path(), 2 * SAMPLES, 1000))
    label = f"{emitter} + {sensor}"
    precise(tiles(images), 0.01, label)
    found = [st.compare_images(reference, tiles(images), label)]
    found += strategies(images, method, emitter, sensor)
    assert_agree(found)

    total = sum(
        layer(images, method, "weighted", s, k + 1 - s)
        for k in range(1, DEPTH + 1)
        for s in range(k + 2)
        if layer(images, method, "weighted", s, k + 1 - s) is not None
    )
    np.testing.assert_allclose(total, tiles(images), atol=1e-4 * tiles(images).mean())


def strategies(images, method, emitter, sensor):
    """Comparisons of the unweighted layers with each other; asserts that there is nothing where the
    pair has no strategy."""
    found = []
    for k in range(1, DEPTH + 1):
        first = None
        for s in range(k + 2):
            t = k + 1 - s
            estimate = layer(images, method, "unweighted", s, t)
            label = f"{emitter} + {sensor}, ({s},{t})"
            if not parts.takes_part(emitter, sensor, s, t):
                assert estimate is None or (estimate == 0).all(), label
                continue
            assert estimate is not None, f"{label}: no layer"
            if first is None:
                first, its = estimate, f"({s},{t})"
            else:
                found.append(paired(estimate, first, f"{label} against {its}"))
    return found


@pytest.mark.parametrize(("emitter", "sensor"), pairs(lambda e, s: False, in_turns))
def test_pair_with_defaults(emitter, sensor):
    """The default choice of what to skip, one connection, roulette; every fifth pair."""
    ours = tiles(renders(parts.pair(emitter, sensor), bdpt(skip="auto"), 2 * SAMPLES, 0))
    other = parts.pair(emitter, sensor, reference=True)
    with evaluated_mode(emitter == "timed_sunsky"):
        reference = tiles(renders(other, path(), 2 * SAMPLES, 1000))
    assert_agree([st.compare_images(reference, ours, f"{emitter} + {sensor}")])


# -- what is left out -------------------------------------------------------------------------

CLASSES = {"s=0": (0, 3), "s=1": (1, 2), "t=1": (2, 1), "t=0": (3, 0), "inner": (2, 2), "(1,1)": (1, 1)}


@pytest.mark.parametrize("sensor", parts.SENSORS)
@pytest.mark.parametrize(
    "emitter",
    [pytest.param(e, marks=[pytest.mark.slow] * (e not in DISTINCT)) for e in PLUGINS.values()],
)
def test_explain_names_what_is_impossible(emitter, sensor):
    """By the table of `scene_parts`, for emission that no table can guide, and for emitters without light
    subpaths or next-event estimation; for no other."""
    text = bdpt().explain(parts.pair(emitter, sensor))
    skipped = dict(re.findall(r"skipped \(impossible\): ([^:]+): (.+)", text))
    expected = {c for c, (s, t) in CLASSES.items() if not parts.takes_part(emitter, sensor, s, t)}
    part = parts.emitter_part(emitter)
    if part.traced and parts.plugin_of(parts.EMITTERS[emitter]()) in ("projector", "directionalarea"):
        expected.add("guided emission")
    assert {c for c in skipped if "of emitter" not in c} == expected, text
    assert any("light subpaths of emitter" in c for c in skipped) == (not part.traced), text
    assert any("s=1 of emitter" in c for c in skipped) == (not part.direct), text
    assert all(len(why) > 10 for why in skipped.values())


def test_kinds_that_take_part_partly_beside_others():
    """A point light, a plugin of unknown class, a `directionalarea` and an area light together make the sum
    of their images: none keeps others from what they can do, nor is chosen where it cannot be used."""
    parts.register_plugins()
    coloured_beam = {"type": "directionalarea", "radiance": scenes.rgb(2, 3, 4)}
    lamps = {
        "a": parts.EMITTERS["sphere"](),
        "b": parts.EMITTERS["own lamp"](),
        "c": scenes.square((0.3, 2.6, 0.6), scenes.DOWNWARDS, 0.3, parts.grey(0.0), emitter=coloured_beam),
        "d": parts.EMITTERS["textured projector"](),
    }
    alone = 0
    for i, (name, lamp) in enumerate(lamps.items()):
        dark = {k: unlit(v) for k, v in lamps.items() if k != name and "bsdf" in v}
        scene = mi.load_dict(parts.open_scene(**{name: lamp}, **dark))
        alone = alone + tiles(renders(scene, bdpt(), 4 * SAMPLES, 1000 * (i + 1)))
    together = mi.load_dict(parts.open_scene(**lamps))
    ours = tiles(renders(together, bdpt(), 4 * SAMPLES, 0))
    precise(ours, 0.01, "together")
    assert_agree([st.compare_images(alone, ours, "together")])


def unlit(part):
    """The entry of a shape without its emitter."""
    return {key: value for key, value in part.items() if key != "emitter"}


# -- known answers ----------------------------------------------------------------------------


def meters_under_a_point(width):
    """A batch of two meters that look up at a point light, one of them twice as large as the other."""

    def plate(x, scale):
        to_world = T().translate([x, 0, 0]) @ T().scale(scale) @ T().rotate([1, 0, 0], -90)
        return parts.meter({"type": "rectangle", "to_world": to_world})

    film = parts.film(size=1) | {"width": width, "height": 1}
    batch = {"type": "batch", "left": plate(-0.5, 0.2), "right": plate(0.3, 0.4), "film": film}
    scene = {"type": "scene", "sensor": batch, "lamp": LAMPS_ABOVE["point"][0]()}
    return mi.load_dict(scene, optimize=False)  # else Mitsuba makes one meter of equal ones


@pytest.mark.parametrize("width", [2, 4])
def test_batch_of_meters_reads_the_known_irradiance(width):
    """Light of a point light that falls on the meters of a batch directly has (1,1) alone; without it each
    reads 0. In each pixel the irradiance of its part of its plate, 3 h / r^3 integrated by midpoints."""
    scene = meters_under_a_point(width)
    values = renders(scene, bdpt(max_depth=1), SAMPLES, 0)[:, 0, :, :3] @ CHANNELS
    middle = (np.arange(40) + 0.5) / 20 - 1
    x, z = np.meshgrid(middle, middle)
    known = []
    for place, scale in ((-0.5, 0.2), (0.3, 0.4)):
        irradiance = 3 / ((place + scale * x - 0.2) ** 2 + (scale * z) ** 2 + 1) ** 1.5
        known += [part.mean() * CHANNELS.sum() for part in np.split(irradiance, width // 2, axis=1)]
    assert_agree([st.one_sample(values, known, f"{width} pixels")])
    assert (values.std(0) < 0.05 * values.mean(0)).all()  # known well enough to mean something


def test_meter_of_another_scene():
    """No light subpath arrives at the shape of a meter from elsewhere; weights that count with t = 0 lose its
    part."""
    scene = mi.load_dict({"type": "scene", "lamp": LAMPS_ABOVE["rectangle"][0]()})
    elsewhere = mi.load_dict({"type": "scene", "sensor": parts.meter(UPWARDS_METER)})
    method, sensor = bdpt(max_depth=1), elsewhere.sensors()[0]
    images = [np.array(method.render(scene, sensor, seed=i, spp=SAMPLES_OF_A_PIXEL)) for i in range(SEEDS)]
    values = tiles(np.stack(images).astype(np.float64))
    precise(values, 0.01, "meter")
    assert_agree([st.compare_known(values, irradiance_above("rectangle") * CHANNELS.sum(), "meter")])


# -- the page ---------------------------------------------------------------------------------


PAGE = ROOT / "docs" / "user" / "coverage.md"


def test_the_page_names_tests_that_exist():
    links = re.findall(r"\]\(\.\./\.\./tests/([\w/]+\.py) \"(\w+)\"\)", PAGE.read_text())
    assert len(links) > 20
    for file, name in sorted(set(links)):
        assert f"\ndef {name}(" in (ROOT / "tests" / file).read_text(), f"{file} has no {name}"


def test_the_page_says_who_takes_part():
    """A dash exactly where the table of `scene_parts` says that it has no part."""
    rows = re.findall(r"^\| `([\w ]+)` \| (.+) \|.*\|$", PAGE.read_text(), re.MULTILINE)
    found = {name: [cell.startswith("–") for cell in cells.split(" | ")] for name, cells in rows}
    kinds = {name: part for name, part in parts.EMITTER_PARTS.items() if not name.startswith("own")}
    assert kinds.keys() <= found.keys()
    for name, part in kinds.items():
        hit, direct, _, traced = found.pop(name)
        assert (hit, direct, traced) == (not part.hit, not part.direct, not part.traced), name
    sensors = {parts.plugin_of(make()): name for name, make in reversed(parts.SENSORS.items())}
    del sensors["own_fisheye"]
    for plugin, name in sensors.items():
        camera, connectible, _, area = found.pop(plugin)
        part = parts.SENSOR_PARTS[name]
        assert (camera, connectible, area) == (False, not part.connectible, not part.area), plugin
    assert set(found) == {"plugin of yours"}
