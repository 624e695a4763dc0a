"""The same image whatever runs it: numbers of threads, ways in which Dr.Jit records loops and calls."""

from contextlib import ExitStack

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
import repository
from rendered import same

# What Dr.Jit can do otherwise than by default. (There is no variant in double precision in Mitsuba's wheels.)
FLAGS = {
    "evaluated loops": {"SymbolicLoops": False},
    "evaluated calls": {"SymbolicCalls": False},
    "evaluated conditionals": {"SymbolicConditionals": False},
    "nothing symbolic": {"SymbolicLoops": False, "SymbolicCalls": False, "SymbolicConditionals": False},
    "calls not optimised": {"OptimizeCalls": False, "MergeFunctions": False},
    "loops not optimised": {"OptimizeLoops": False, "CompressLoops": False},
    "compressed loops": {"CompressLoops": True},
    "no value numbering": {"ValueNumbering": False, "ConstantPropagation": False},
    "local atomics": {"ScatterReduceLocal": False},
}

# Scenes with specular glass and drawn connections, with a sky, and with fog.
SCENES = ("glass_caustics", "open_sky", "fog_lamp")


@pytest.fixture(scope="module")
def rendered():
    """By name of the scene: a function that renders it, and the image of Dr.Jit's defaults."""
    made = {}
    for name in SCENES:
        scene = repository.load_scene(name, resolution=24)
        integrator = mi.load_dict({"type": "bdpt", "max_depth": 6, "light_paths": 1, "connections": "one"})

        def render(scene=scene, integrator=integrator):
            return np.array(integrator.render(scene, spp=4, seed=3))

        made[name] = render, render()
    return made


@pytest.mark.parametrize("threads", [1, 2, 16])
def test_numbers_of_threads(rendered, threads):
    before = dr.thread_count()
    try:
        dr.set_thread_count(threads)
        for render, expected in rendered.values():
            assert same(render(), expected)
    finally:
        dr.set_thread_count(before)


@pytest.mark.parametrize("name", FLAGS)
def test_sets_of_flags(rendered, name):
    with ExitStack() as stack:
        for flag, value in FLAGS[name].items():
            stack.enter_context(dr.scoped_set_flag(getattr(dr.JitFlag, flag), value))
        for scene, (render, expected) in rendered.items():
            if scene == "fog_lamp" and not FLAGS[name].get("SymbolicLoops", True):
                continue  # step by step a loop in a loop takes minutes
            assert same(render(), expected)
