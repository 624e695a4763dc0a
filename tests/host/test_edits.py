"""What is remembered of a scene between renders: pilots, until something is edited."""

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from mitsuba_bdpt.host import notices
from mitsuba_bdpt.host.notices import State, _checksum
from mitsuba_bdpt.planning import budget, pilot, unsampled_light

SPP = budget.LEAST_SAMPLES // 32**2


def cornell(**changes):
    scene = mi.cornell_box()
    scene["sensor"]["film"] |= {"width": 32, "height": 32, "rfilter": {"type": "box"}}
    return mi.load_dict(scene | changes)


def bdpt(**parameters):
    # Each render asks one pilot: none about tables of emission.
    return mi.load_dict({"type": "bdpt", "max_depth": 6, "guiding": "photons", **parameters})


def bumpy(offset=0.0):
    """A mesh of 400 vertices, too many to be kept."""
    mesh = mi.Mesh("bumpy", 400, 200)
    parameters = mi.traverse(mesh)
    points = np.random.default_rng(1).uniform(-0.3, 0.3, (400, 3)) + offset
    parameters["vertex_positions"] = mi.Float(points.astype(np.float32).ravel())
    parameters["faces"] = mi.UInt32(np.arange(600) % 400)
    parameters.update()
    return mesh


@pytest.fixture
def traced(monkeypatch):
    """Seeds of the pilots that were traced."""
    seeds, measure = [], pilot.measure

    def counted(world, plan, settings, seed, *args):
        seeds.append(int(seed[0]))
        return measure(world, plan, settings, seed, *args)

    monkeypatch.setattr(pilot, "measure", counted)
    return seeds


def test_pilots_are_remembered(traced):
    """Renders with the seeds 0 to 3 have one pilot, one decision, and the image of a scene loaded anew, up to
    the order of sums."""
    scene, integrator = cornell(), bdpt()
    images, decided = [], []
    for seed in range(4):
        images.append(np.array(integrator.render(scene, seed=seed, spp=SPP)))
        decided += integrator.statistics["decisions"]
        assert integrator.statistics["pilots"] == {"rendered": int(seed == 0), "cached": int(seed > 0)}
    assert len(traced) == 1 and decided == 4 * decided[:1]
    again = np.array(integrator.render(cornell(), seed=3, spp=SPP))
    assert len(traced) == 2 and traced[0] == traced[1]
    np.testing.assert_allclose(again, images[3], rtol=1e-4, atol=1e-5)


def test_another_render_asks_another_pilot(traced):
    """For other samples, parameters and sensors; then all of them are known."""
    scene = cornell()
    film = {"type": "hdrfilm", "width": 48, "height": 48}
    other = mi.load_dict(mi.cornell_box()["sensor"] | {"film": film})
    renders = [
        (bdpt(), {"spp": SPP}),
        (bdpt(), {"spp": 2 * SPP}),
        (bdpt(hide_emitters=True), {"spp": SPP}),
        (bdpt(), {"spp": SPP, "sensor": other}),
        (bdpt(spp_per_pass=32), {"spp": 256}),
    ]
    for _ in range(2):
        for integrator, arguments in renders:
            integrator.render(scene, **arguments)
        assert len(traced) == len(renders)


def painted():
    texture = {"type": "bitmap", "data": dr.full(mi.TensorXf, 0.5, (16, 16, 3)), "raw": True}
    return {"type": "rectangle", "bsdf": {"type": "diffuse", "reflectance": texture}}


EDITS = {
    "light.emitter.radiance.value": lambda v: 2 * v,
    "green.reflectance.value": lambda v: 0.5 * v,
    "sensor.to_world": lambda v: v @ mi.ScalarTransform4f().translate([0, 0, 0.1]),
    "sensor.x_fov": lambda v: v + 1,
    "sensor.near_clip": lambda v: 2 * v,
    "bumpy.vertex_positions": lambda v: v + 0.01,
    "painted.bsdf.reflectance.data": lambda v: 0.5 * v,
}


@pytest.mark.parametrize("name", EDITS)
def test_edits_are_seen(name, traced):
    """An update without an edit makes no other pilot."""
    scene, integrator = cornell(bumpy=bumpy(), painted=painted()), bdpt()
    integrator.render(scene, spp=SPP)
    parameters = mi.traverse(scene)
    (key,) = (key for key in parameters.keys() if key.endswith(name))
    parameters.update()
    integrator.render(scene, spp=SPP)
    assert len(traced) == 1
    parameters[key] = EDITS[name](parameters[key])
    parameters.update()
    integrator.render(scene, spp=SPP)
    assert len(traced) == 2


def test_two_edits_in_between_are_seen():
    """Dr.Jit gives the numbers of freed arrays to others; of large arrays the contents count."""
    for entries in (3, 30_000):
        mesh = mi.Mesh("mesh", entries, 1)
        parameters = mi.traverse(mesh)
        parameters["faces"] = mi.UInt32([0, 1, 2])
        seen = set()
        for step in range(20):
            for value in (step, step + 0.5):
                parameters["vertex_positions"] = mi.Float(np.full(3 * entries, value, dtype=np.float32))
                parameters.update()
            seen.add(State.of([mesh]))
        assert len(seen) == 20


@pytest.mark.parametrize("entries", [65, 100_001])
@pytest.mark.parametrize("kind", ["Float", "Float16", "Bool"])
def test_each_entry_counts(kind, entries):
    made = getattr(dr.llvm, kind)
    values = (np.arange(entries) % 2).astype(made(0).numpy().dtype)
    found = {_checksum(made(values))}
    for place in (0, 1, entries // 2, entries - 1):
        edited = values.copy()
        edited[place] = not edited[place]
        found.add(_checksum(made(edited)))
    assert len(found) == 5 and _checksum(made(values)) in found


def test_exchanged_bsdfs_are_seen():
    """Rationale: a shape that is given a BSDF which another has too changes no parameter."""
    ball = {"type": "sphere", "bsdf": {"type": "ref", "id": "first"}}
    bsdfs = {"first": {"type": "diffuse", "id": "first"}, "second": {"type": "conductor", "id": "second"}}
    other = ball | {"bsdf": {"type": "ref", "id": "second"}}
    scene = mi.load_dict({"type": "scene", **bsdfs, "a": ball, "b": other, "c": ball, "d": other})
    states = {State.of([scene])}
    held = [shape.bsdf() for shape in scene.shapes()]
    for shape, bsdf in zip(scene.shapes(), held, strict=True):
        shape.set_bsdf(next(one for one in held if one is not bsdf))
        states.add(State.of([scene]))
        shape.set_bsdf(bsdf)
    assert len(states) == 5 and State.of([scene]) in states


def test_edits_in_place_are_seen():
    mesh = bumpy()
    parameters, before = mi.traverse(mesh), State.of([mesh])
    dr.scatter(parameters["vertex_positions"], mi.Float(7), mi.UInt32(601))
    assert State.of([mesh]) != before


def test_nothing_large_is_kept():
    """It would outlive a scene that takes gigabytes."""
    mesh = mi.Mesh("mesh", 30_000, 10_000)
    parameters = mi.traverse(mesh)
    parameters["vertex_positions"] = mi.Float(np.zeros(90_000, dtype=np.float32))
    parameters.update()
    state = State.of([mesh])
    assert state == State.of([mesh]) and hash(state) == hash(State.of([mesh]))
    assert max(dr.width(value) for value in state.kept) <= 64


def test_scenes_that_are_gone_are_forgotten():
    """What is remembered of them holds variables of Dr.Jit; a scene that lives is not forgotten."""
    scene, integrator = cornell(), bdpt()
    integrator.render(scene, spp=SPP)
    before, others = len(notices._scenes), [cornell() for _ in range(3)]
    for other in others:
        integrator.render(other, spp=SPP)
    assert len(notices._scenes) >= before + 3
    del other, others
    integrator.render(scene, spp=SPP)
    assert len(notices._scenes) <= before
    assert integrator.statistics["pilots"] == {"rendered": 0, "cached": 1}


def behind_glass(**shapes):
    """A lamp over a pane of glass, seen through it: light that no strategy finds."""
    pane = {"type": "cube", "bsdf": {"type": "dielectric"}}
    pane["to_world"] = mi.ScalarTransform4f().translate([0, 0.2, 0]).scale([0.9, 0.05, 0.9])
    return cornell(lamp={"type": "point", "position": [0, 0.8, 0], "intensity": 1.0}, pane=pane, **shapes)


def test_parameters_are_read_once(monkeypatch):
    """Once in a render, for pilot and unsampled light; twice where ``on_pass`` was called, which may edit
    them; beside those of shapes alone."""
    read, original = [], State.of

    def of(owners, deep=True):
        read.extend([owners] * deep)
        return original(owners, deep)

    monkeypatch.setattr(State, "of", of)
    integrator = bdpt()
    integrator.render(behind_glass(), spp=SPP)
    assert integrator.statistics["pilots"]["rendered"] == 1 == len(read)
    integrator.on_pass = lambda report: None
    integrator.render(behind_glass(), spp=SPP)
    assert len(read) == 3


def test_edits_during_a_render_are_seen(monkeypatch):
    """What is found of a scene that ``on_pass`` has edited is not of the one that the pilot saw."""
    looks = []

    def look(prepared, plan, *others):
        looks.append(plan)
        return unsampled_light.UnsampledLight({})

    monkeypatch.setattr(unsampled_light, "estimate", look)
    scene, integrator = behind_glass(painted=painted()), bdpt()
    parameters = mi.traverse(scene)
    (key,) = (key for key in parameters.keys() if key.endswith("painted.bsdf.reflectance.data"))

    def paint(value):
        parameters[key] = dr.full(mi.TensorXf, value, (16, 16, 3))
        parameters.update()

    paint(0.5)
    integrator.on_pass = lambda report: paint(0.1)
    integrator.render(scene, spp=SPP)
    integrator.on_pass = None
    paint(0.5)
    integrator.render(scene, spp=SPP)
    integrator.render(scene, spp=SPP)
    assert len(looks) == 2
