"""Kernel time over its floor: the very rays of a pass, replayed by themselves. The loops of a pass are run
step by step, every call that traces rays is kept with its masks, and replayed as a kernel of its own: closest
hits with ``compute_surface_interaction``. The pass is measured as it is, one kernel, with the same plan and
seed. Both sides alternate."""

from __future__ import annotations

import contextlib
import gc
from unittest import mock

import drjit as dr
import mitsuba as mi
from mitsuba_bdpt.host.jit import evaluated_mode
from mitsuba_bdpt.image import sink
from mitsuba_bdpt.measure.options import RESOLUTION
from mitsuba_bdpt.measure.scenes import SceneFile, integrator_of
from mitsuba_bdpt.run import rendering, schedule
from mitsuba_bdpt.sampling import points
from mitsuba_bdpt.transport.kernel import trace

SPP = 16


@contextlib.contextmanager
def recorded(calls: list):
    """Scenes note in ``calls`` what they trace: (ray, active, coherent), the last None for shadow rays."""
    closest, shadow = mi.Scene.ray_intersect_preliminary, mi.Scene.ray_test

    def note(ray, active, coherent):
        ray, active = mi.Ray3f(ray), mi.Bool(active)
        dr.eval(ray, active)
        calls.append((ray, active, coherent))

    def ray_intersect_preliminary(scene, ray, coherent=False, active=True):
        note(ray, active, coherent)
        return closest(scene, ray, coherent=coherent, active=active)

    def ray_test(scene, ray, active=True):
        note(ray, active, None)
        return shadow(scene, ray, active=active)

    preliminary = mock.patch.object(mi.Scene, "ray_intersect_preliminary", ray_intersect_preliminary)
    with preliminary, mock.patch.object(mi.Scene, "ray_test", ray_test):
        yield


def kernel_seconds(work) -> float:
    with dr.scoped_set_flag(dr.JitFlag.KernelHistory, True):
        dr.kernel_history_clear()
        work()
        dr.sync_thread()
        history = dr.kernel_history()
    return sum(e["execution_time"] for e in history if e["type"] == dr.KernelType.JIT) / 1000


class Pass:
    """One pass of a scene at 128^2, as a render of 64 samples per pixel decides it."""

    def __init__(self, file: SceneFile, parameters: dict):
        self._scene = file.load(RESOLUTION)
        integrator = integrator_of({"type": "bdpt"} | parameters, file.max_depth)
        self._render = rendering.Render(self._scene, self._scene.sensors()[0], integrator.settings, 1, 64)
        self._render.decide()
        self._batch = schedule.batches(self._render.prepared.camera, 0, SPP, integrator.settings)[0]
        self._path = mi.load_dict({"type": "path", "max_depth": file.max_depth})

    def trace(self):
        render = self._render
        seed = dr.opaque(mi.UInt32, 1)
        drawn = points.Points(render.settings.points, seed)
        counts = trace(render.kernel, sink.Image(render.accumulator), self._batch, drawn, SPP)
        render.accumulator.evaluate(counts)

    def trace_path(self):
        dr.eval(mi.render(self._scene, integrator=self._path, spp=SPP))

    def rays(self) -> list:
        """All calls that trace rays, with their rays."""
        calls = []
        with recorded(calls), evaluated_mode():
            self.trace()
        return calls

    def replay(self, calls):
        """A kernel for each call."""
        for ray, active, coherent in calls:
            if coherent is None:
                dr.eval(self._scene.ray_test(ray, active=active))
                continue
            pi = self._scene.ray_intersect_preliminary(ray, coherent=coherent, active=active)
            si = pi.compute_surface_interaction(ray, mi.RayFlags.All, active)
            # A sum of what a path needs, so that nothing is left out and little is written.
            dr.eval(si.p.x + si.p.y + si.p.z + si.n.x + si.sh_frame.n.x + si.uv.x + si.wi.x + si.t)


def measure(file: SceneFile, rounds: int, parameters=None, of_path: bool = False) -> list[float]:
    """Kernel time over the floor, a value per round; ``of_path``: that of Mitsuba's `path`, over the same
    floor."""
    # Kernels cannot be recorded as a whole any more where loops were run step by step.
    calls = Pass(file, parameters or {}).rays()
    gc.collect()
    subject = Pass(file, parameters or {})
    trace = subject.trace_path if of_path else subject.trace
    trace()
    subject.replay(calls)
    ratios = []
    for _ in range(rounds):
        whole = kernel_seconds(trace)
        floor = kernel_seconds(lambda: subject.replay(calls))
        ratios.append(whole / floor)
    return ratios
