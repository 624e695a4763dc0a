"""What is compiled before the first image is seen: counted, since seconds depend on the machine."""

import gc
import re

import drjit as dr
import internals
import mitsuba as mi
import numpy as np
import pytest
import short_pilots
from mitsuba_bdpt.host import llvm
from mitsuba_bdpt.planning import budget
from mitsuba_bdpt.run.rendering import Render
from mitsuba_bdpt.scene.prepared import PreparedScene
from mitsuba_bdpt.transport import bsdf
from room import KINDS, LIGHTS, lit_room

ALL = [{"light_paths": 1.0, "connections": "one", "cost": 1.0, "variance": 1.0, "mean": 0.5}]
ALL[0]["coefficients"] = {"t<=1": 1.0, "s=1": 1.0}


def room(materials, size):
    return lit_room("ceiling", materials, size, size)


@pytest.fixture
def kernels(monkeypatch):
    """IR of the kernels that renders have run so far."""
    gc.collect()  # scenes of earlier tests that go between two renders change their tables of calls
    found, history = [], dr.kernel_history

    def watched(*args):
        entries = history(*args)
        found.extend(e["ir"].getvalue() for e in entries if e["type"] == dr.KernelType.JIT)
        return entries

    monkeypatch.setattr(dr, "kernel_history", watched)
    return found


def render(scene, **parameters):
    """An image of ``scene`` with all strategies, by one kernel."""
    integrator = internals.bdpt(**{"max_depth": 6, "decisions": ALL, **parameters})
    return np.array(integrator.render(scene, seed=3, spp=4), dtype=np.float64)[..., :3]


def functions(kernel: str) -> int:
    """Number of functions of BSDFs in a kernel."""
    return len(
        re.findall(r"^define [^\n]*\n(?:[^\n]*\n)?[^\n]*; Call: (?:BSDF::|drjit)", kernel, re.MULTILINE)
    )


def test_functions_of_materials(kernels):
    """Compiling the functions of BSDFs is most of a room's first image. Expected: one for samples and one for
    evaluations of each BSDF that rays may meet, the lamp's included, at most, also beside another scene; some
    differ in numbers only and share theirs."""
    other = mi.load_dict(room(len(KINDS), 16))
    scene = mi.load_dict(room(len(KINDS), 16))
    render(scene)
    kernel = max(kernels, key=len)
    materials = len(KINDS) + 1
    assert len(KINDS) < functions(kernel) <= 2 * materials
    assert other.shapes()


def test_calls_of_few_questions_and_of_all(monkeypatch):
    """Few BSDFs are asked everything in one call, many in several, see `bsdf.MANY`. Expected: the same image,
    up to rounding: where it decides otherwise about a path, a pixel differs; two in a hundred may."""
    scene = mi.load_dict(room(len(KINDS), 24))
    images = []
    for many in (1, 1000):
        monkeypatch.setattr(bsdf, "MANY", many)
        images.append(render(scene))
    several, one = images
    assert several.mean() > 0.05
    assert np.mean(np.abs(several - one).max(-1) > 1e-3 * (one.mean(-1) + one.mean())) <= 0.02


def test_pilots_of_rooms():
    """Rationale: in scenes of many BSDFs the pilot's kernel takes up to seconds to compile, longer than a
    preview. Expected: none is asked where 2^17 samples are more than enough with fewer BSDFs, and it is said
    why; from `budget.least_samples` on one is, also there, and predicts no guided s = 0, which would take two
    more kernels; in renders `budget.GUIDING_TIMES` as long it does."""
    integrator = mi.load_dict({"type": "bdpt", "max_depth": 3})
    few, many = (
        mi.load_dict(room(bsdf.MANY - n, 128)) for n in (7, 4)
    )  # walls and lamp have six; one is glass
    least = budget.least_samples(PreparedScene(many, many.sensors()[0]))
    assert (1 << 17) < least < (1 << 20)
    assert len(integrator.decide(few, spp=8)) == 1
    assert integrator.decide(many, spp=least // 128**2) == []
    assert str(least) in integrator.statistics["no_pilot"]
    for times, guided in ((1, False), (budget.GUIDING_TIMES, True)):
        assert len(integrator.decide(many, spp=times * least // 128**2 + 1)) == 1
        text = str(integrator.statistics["skipped"])
        assert ("too short to predict its gain" in text) == (not guided)


@pytest.mark.parametrize("light", LIGHTS)
def test_lit_rooms_are_decided(light):
    """Rationale: rooms of 10 to 60 BSDFs were rendered by a guess, some at half the efficiency of ``path``.
    Expected: with 256 x 144 pixels and 64 samples each a pilot is asked in a room of 54 materials and its
    walls, however it is lit, and under a sky alone, where it would tell nothing else, path tracing alone is
    decided without one. (The pilot itself is not traced.)"""
    scene = mi.load_dict(lit_room(light, 54))
    integrator = mi.load_dict({"type": "bdpt", "max_depth": 8})
    render = Render(scene, scene.sensors()[0], integrator.settings, 0, 64)
    assert render.prepared.traits.dispatch.count > 54
    assert render.planner.begin() == (light != "window")
    if light == "window":
        assert not render.plan.light


@pytest.mark.parametrize(
    ("size", "spp", "expected"),
    [(64, 1, [1]), (64, 16, [16]), (64, 64, [1, 63]), (1, 1 << 18, [1 << 18])],
    ids=["one sample", "an edit", "longer", "one pixel"],
)
def test_a_short_render_has_one_pass(size, spp, expected):
    """Expected: one pass in a render of 64^2 pixels and 16 samples each, as after an edit, without a pilot;
    two where the render is longer, but of one pixel, whose first sample gives no mean."""
    scene = mi.cornell_box()
    scene["sensor"]["film"] |= {"width": size, "height": size}
    scene, integrator = mi.load_dict(scene), mi.load_dict({"type": "bdpt", "skip": "impossible"})
    render = Render(scene, scene.sensors()[0], integrator.settings, 0, spp)
    assert [step.size for step in render._steps()] == expected


GLASS = {"type": "sphere", "radius": 0.1, "bsdf": {"type": "dielectric"}}
FROSTED = GLASS | {"bsdf": {"type": "roughdielectric", "alpha": 0.05}}


@pytest.mark.parametrize(
    ("more", "least"),
    [({}, 64), ({"ball": GLASS}, 16), ({"ball": FROSTED}, 16)],
    ids=["diffuse", "glass", "frosted glass"],
)
def test_an_edit_of_a_small_render_asks_no_pilot(monkeypatch, more, least):
    """After each edit a render of 65,536 samples ran a pilot that took twice as long as itself. Expected:
    64^2 pixels of 16 samples run none in a diffuse room, of 64 samples they do; of 16 with a glass ball, also
    a frosted one (near-specular scenes have 0.15 to 0.6 times the time times trimmed error with it)."""
    for name in ("FOCUSED_SAMPLES", "LEAST_SAMPLES"):
        monkeypatch.setattr(budget, name, getattr(short_pilots, name))
    scene = mi.cornell_box() | more
    scene["sensor"]["film"] |= {"width": 64, "height": 64}
    scene, integrator = mi.load_dict(scene), mi.load_dict({"type": "bdpt"})
    for spp, asked in ((least - 1, False), (least, True)):
        render = Render(scene, scene.sensors()[0], integrator.settings, 0, spp)
        assert render.planner.begin() == asked


def test_registers_of_the_image(monkeypatch):
    """The first image of unsampled light's mean is rendered by the image's kernel, which Dr.Jit keeps.
    Expected: registers are allocated quickly for the estimate of that light, as usual for both images."""
    options, seen, traced = [], [], Render._pass
    monkeypatch.setattr(llvm, "_set_options", lambda *given: options.append(given))
    monkeypatch.setattr(Render, "_pass", lambda *given: (seen.append(options[-1]), traced(*given)))
    ball = GLASS | {"radius": 0.4}
    scene = mi.cornell_box() | {"ball": ball, "lamp": {"type": "point", "position": [0, 0.7, 0]}}
    scene["sensor"]["film"] |= {"width": 16, "height": 16}
    mi.load_dict({"type": "bdpt"}).render(mi.load_dict(scene), spp=1)
    assert len(seen) == 2 and b"-optimize-regalloc=false" in options[0]
    assert all(b"-optimize-regalloc=true" in given for given in seen)


LAMPS = {f"lamp{i}": {"type": "point", "position": [0.1 * i, 0, 0]} for i in range(budget.MANY_EMITTERS)}


@pytest.mark.parametrize(
    ("more", "size", "served", "joined"),
    [
        ({}, 16, budget.UNFOCUSED, 1),
        ({}, 64, budget.UNFOCUSED, 4),
        ({"ball": GLASS | {"bsdf": {"type": "plastic"}}}, 64, budget.UNFOCUSED, 4),
        ({"ball": GLASS}, 64, 4, 1),
        ({"ball": FROSTED}, 64, 4, 1),
        (LAMPS, 64, 4, 1),
        ({}, 4, 1, 1),
    ],
    ids=["few samples", "diffuse", "plastic", "glass", "frosted glass", "many lamps", "few pixels"],
)
def test_light_subpaths_without_a_decision(more, size, served, joined):
    """Expected: few light subpaths in a diffuse room, also beside a coat, more where glass focuses light or
    where next-event estimation chooses among many lamps, and as many as camera subpaths on a film of few
    pixels; where they are few, camera subpaths connect with several from 2^16 samples on. The same where a
    render of no decisions is replayed."""
    scene = mi.cornell_box()
    scene["sensor"]["film"] |= {"width": size, "height": size}
    scene = mi.load_dict(scene | more)
    for replayed in ({}, {"decisions": []}):
        integrator = internals.bdpt(**replayed)
        plan = Render(scene, scene.sensors()[0], integrator.settings, 0, 16).plan
        assert (plan.camera_paths_per_light_path, plan.joined) == (served, joined)


def test_lanes_take_turns_by_kinds_of_bsdfs():
    """Lanes whose BSDFs have different functions take turns, those of one kind do not. Expected: with 16
    further diffuse BSDFs `cornell_box` is rendered as without them, and the pilot's costs are the same to 5 %
    (the spheres take room)."""
    tables = []
    for count in (0, 16):
        scene = mi.cornell_box()
        for i in range(count):
            bsdf_of = {"type": "diffuse", "reflectance": {"type": "rgb", "value": 0.3 + 0.02 * i}}
            place = [-0.9 + 0.12 * i, -0.97, 0.9]
            scene[f"ball{i}"] = {"type": "sphere", "center": place, "radius": 0.03, "bsdf": bsdf_of}
        loaded = mi.load_dict(scene)
        integrator = mi.load_dict({"type": "bdpt", "max_depth": 4})
        tables.append(Render(loaded, loaded.sensors()[0], integrator.settings, 0, 64).decide())
    plain, crowded = (table[0] for table in tables)
    assert (plain.candidate.light_paths, plain.candidate.connections) == (1 / 16, "one")
    assert crowded.candidate.connections == "one"
    assert crowded.cost == pytest.approx(plain.cost, rel=0.05)


def test_kinds_of_bsdfs_share_functions(kernels):
    """Expected: a room of twice as many BSDFs of the same kinds is as many kinds, and has at most a tenth
    more functions."""
    counts = []
    for materials in (len(KINDS), 2 * len(KINDS)):
        scene = mi.load_dict(room(materials, 16))
        render(scene)
        traits = bsdf.Traits.of([shape.bsdf() for shape in scene.shapes()])
        counts.append((traits.dispatch.kinds, functions(max(kernels, key=len))))
        kernels.clear()
    (kinds, few), (same, many) = counts
    assert kinds == same and few <= many <= 1.1 * few


def test_bitmaps_do_not_cut_kernels(kernels):
    """Expected: of a scene that was just loaded all passes run the same kernel."""
    scene = mi.load_dict(room(2, 16))
    integrator = internals.bdpt(max_depth=3, decisions=[], spp_per_pass=2)
    integrator.render(scene, spp=4)
    assert len(integrator.statistics["passes"]) == 2
    large = [kernel for kernel in kernels if "Symbolic loop" in kernel]
    assert len(large) == 2 and large[0] == large[1]


def test_an_edited_bitmap_is_evaluated_once():
    """An edit multiplies a bitmap by a number, which is part of each kernel that reads the result. Expected:
    once a render is prepared, the result is an evaluated array."""
    scene = mi.cornell_box()
    picture = mi.Bitmap(np.full((8, 8, 3), 0.5, dtype=np.float32))
    scene["floor"]["bsdf"] = {"type": "diffuse", "reflectance": {"type": "bitmap", "bitmap": picture}}
    scene, integrator = mi.load_dict(scene), mi.load_dict({"type": "bdpt"})
    params = mi.traverse(scene)
    (key,) = (key for key in params.keys() if key.endswith("reflectance.data"))
    params[key] = params[key] * 0.9
    params.update()
    Render(scene, scene.sensors()[0], integrator.settings, 0, 1)
    data = mi.traverse(scene)[key].array
    assert data.state == dr.VarState.Evaluated and np.allclose(np.array(data), 0.45)


def test_decisions_share_kernels(kernels):
    """Expected: one kernel for all of them, and one for each kind of connections."""
    scene = mi.load_dict(room(2, 16))
    ways = [
        (1, 1 / 64, "none"),
        (1 / 16, 1, "none"),
        (1, 1 / 16, "one"),
        (1 / 4, 1, "one"),
        (1 / 4, 1, "all"),
    ]
    for light_paths, splat, connections in ways:
        coefficients = {"t<=1": splat, "s=1": 1.0}
        made = ALL[0] | {"light_paths": light_paths, "connections": connections, "coefficients": coefficients}
        render(scene, decisions=[made])
    large = [kernel for kernel in kernels if "Symbolic loop" in kernel]
    assert [large.index(kernel) for kernel in large] == [0, 0, 2, 2, 4]
