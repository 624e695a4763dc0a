"""One render, from its first sample to the film."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import partial
from typing import TYPE_CHECKING

import drjit as dr
import mitsuba as mi
import numpy as np

from .. import components
from ..emitters.light_groups import LightGroups
from ..errors import UnsupportedError, UsageError, behind
from ..host.introspection import number
from ..host.jit import evaluated_mode, gc_paused
from ..host.llvm import quick_compilation
from ..host.notices import warn_once
from ..image.accumulator import Accumulator, Parts
from ..image.features import FeatureLayers, feature_names
from ..image.sink import Image
from ..planning import unsampled_light
from ..planning.budget import FEW_PIXELS, expected_samples
from ..planning.choice import Prediction
from ..planning.configuration import MOST_ROULETTE, NOT_WORTH
from ..planning.findings import SceneCache
from ..planning.planner import Planner
from ..planning.unsampled_light import WARN_SHARE, Missing, UnsampledLight
from ..progress import Report
from ..properties import check_film, check_not_frozen, check_variant, integer
from ..scene.prepared import PreparedScene
from ..settings import Settings
from ..transport import mis
from ..transport.batch import strip_count
from ..transport.inputs import TraceContext
from ..transport.kernel import trace
from ..transport.photons import photon_pass
from ..transport.photons.aim import Aim
from ..transport.photons.guided_hits import Guiding
from ..transport.photons.photon_guide import Guide
from ..transport.plan import Plan
from ..transport.sds import PhotonStrategy
from . import messages
from .schedule import REPLICATES, PassPoints, Step, batches, longest_pass, passes_since, schedule
from .snapshot import Progress, Snapshot, identity
from .statistics import Meter, rays

if TYPE_CHECKING:
    from ..merging import Passes

# Least samples of a render whose first pass has one sample per pixel; its mean serves roulette. In shorter
# ones recording a second pass takes longer than what roulette saves; fewer than `FEW_PIXELS` give no mean.
TWO_PASSES = 1 << 18

LEAST_OF_MEAN = 1 << 10  # samples that estimate the image's mean, at least


@dataclass(frozen=True)
class PassReport(Report):
    """Progress after a pass; ``snapshot`` and ``image`` are valid until the report of the next one."""

    snapshot: Callable[[], Snapshot]
    """Returns the snapshot from which another render can continue."""
    image: Callable[[], mi.TensorXf]
    """Returns the image so far, as `render` does, and stores it in the film."""


class Render:
    """One render of ``spp`` samples per pixel, used for a single call.

    ``prepared``: the scene; ``planner``: decides the ``plan`` of the ``kernel``; ``points``: random numbers
    of the passes; ``accumulator``: sums of the image; ``meter``: counts of work and times; ``why_merged``:
    why it merges, or empty. Renders with ``merging=auto`` do
    not merge, see `decided`. ``part``: see `BDPTIntegrator.part`; ``like``: see `_like`.
    """

    def __init__(
        self,
        scene: mi.Scene,
        sensor: mi.Sensor,
        settings: Settings,
        seed,
        spp: int,
        like: Render | None = None,
    ):
        check_variant()
        check_not_frozen()
        self.light_groups = LightGroups.of(scene, settings.light_groups)
        names = () if self.light_groups is None else self.light_groups.names
        colour, channels = check_film(sensor, settings, names)
        self.meter, self.part = Meter(), 0
        self._is_open = settings.merging == "auto"
        settings = replace(settings, merging=settings.merging is True)
        self.why_merged = "merging=true" if settings.merging else ""
        self.sensor, self.settings, self.spp = sensor, settings, spp
        self.prepared = like.prepared if like else PreparedScene(scene, sensor)
        for text in self.light_groups.warnings if self.light_groups else ():
            warn_once(scene, sensor, text)
        if settings.merging and (why := components.merging.why_not(sensor)):
            raise UnsupportedError(f"{why}; leave out merging")
        self.findings = like.findings if like else SceneCache(self.prepared, sensor)
        self.planner = Planner(self.prepared, settings, spp, self.findings, self._is_open)
        seed = mi.UInt32(seed if isinstance(seed, mi.UInt32) else integer(seed, "seed", 0))
        dr.make_opaque(seed)
        self.points = PassPoints(settings, seed)
        aims = self.plan.merging or self.plan.guidable
        near_specular = self.prepared.near_specular
        self.aim = Aim.of(scene, self.prepared.emitters, near_specular) if aims else None
        self.merging, self._pixels = None, int(self.prepared.camera.region.size.prod())
        if self.plan.merging:
            given = settings, self.aim, self._pixels, bool(near_specular)
            self.merging = components.merging.Passes(scene, sensor, *given)
        features = None
        if settings.denoise or feature_names(settings.aovs):
            features = FeatureLayers(scene, sensor, settings.aovs, spp, settings.denoise)
        border = self.prepared.camera.region.border
        best = self.merging.best_pass if self.merging else 0
        self._longest = longest = longest_pass(self.prepared.camera, settings, best)
        parts = Parts(channels, strip_count(longest), min(longest, spp), names)
        self.accumulator = Accumulator(sensor.film(), colour, border, settings, features, parts)
        self.kernel = self._kernel()
        # Result of `_guide`.
        self._guides: tuple[Guide | None] | None = None
        # Whether the first pass has one sample per pixel. It gives the mean of the image, for roulette.
        self._small_first: bool | None = None
        self._error: float | None = None
        # State of the newest report, see `_freeze`.
        self._state: tuple[tuple[int, ...], Progress, dict] | None = None

    @property
    def passes(self) -> tuple[int, ...]:
        """Samples per pixel of each finished pass."""
        return self.accumulator.passes

    @property
    def plan(self) -> Plan:
        """The strategies in use, as decided so far."""
        return self.planner.plan

    def run(
        self, on_pass: Callable[[PassReport], object] | None, cancelled: Callable[[], bool] = lambda: False
    ):
        """Trace the samples, and store the image in the film; `decided` comes first.

        Ends early at ``timeout``, ``target_error``, when ``cancelled()`` after a pass, or by an interruption.
        ``on_pass`` is called with a `PassReport` after each pass.
        """
        timeout = self.settings.timeout
        watched = on_pass is not None or timeout >= 0
        with self._finished():
            for number, step in enumerate(self._steps()):
                if not number:
                    if self._is_exact_enough():  # the snapshot is exact enough already
                        break
                    messages.warn_of_unsampled_light(self.prepared, self.plan, self.missing())
                    messages.warn_of_missing_direct(self.prepared, self.plan, self.settings)
                self._pass(step)
                # Records the second pass while the first, a short one, runs.
                if watched or number > 0:
                    self.meter.wait()
                if step.last and self.settings.variance:
                    self.accumulator.close_replicate()
                exact = self._is_exact_enough()
                if on_pass is not None:
                    on_pass(self.report())
                    self.findings.expire()
                if exact or 0 <= timeout <= self.meter.elapsed() or cancelled():
                    break

    def decided(self) -> Render:
        """Decide how to render; returns this render, or where ``merging=auto`` demands it one that merges."""
        with interruptible():
            self.decide()
            if not self._is_open or not (why := self._why_to_merge()):
                return self
            merged = self._like(replace(self.settings, merging=True), self.points.seed, self.spp)
            merged.meter, merged.why_merged, merged.part = self.meter, why, self.part
            merged.decide()
            return merged

    def _like(self, settings: Settings, seed, spp: int) -> Render:
        """Another render of the same scene, whose preparation and cache it shares."""
        return Render(self.prepared.scene, self.sensor, settings, seed, spp, self)

    def _why_to_merge(self) -> str:
        """Why this render has to merge; empty, and noted as left out, if it does not."""
        missing = self.missing()
        if missing is None or missing.share < WARN_SHARE:
            lacks = f"{missing.share:.2%} of the image's light" if missing else "no light"
            level, why = NOT_WORTH, f"the other strategies lack {lacks}"
        else:
            level, why = "impossible", components.merging.why_not(self.sensor)
            if not why and self.settings.strategy_images:
                why = "layers=strategies shows merges with merging=true only"
        if missing is None or why:
            decided = self.planner.decided
            left_out = (*decided.left_out, {"class": "merging", "level": level, "why": why})
            self.planner.decided = replace(decided, left_out=left_out)
            return ""
        return f"without it {missing.cause}"

    @contextmanager
    def _finished(self):
        """At exit, also by an exception, store the finished passes in the film."""
        try:
            with interruptible():
                yield
        finally:
            try:
                self.meter.wait()
            finally:
                self.accumulator.finish()

    def decide(self) -> list[Prediction]:
        """Apply the decision of the scene or of a pilot to the rest of the render.

        Does nothing without alternatives, or if the render is too short for a pilot. Returns all predictions
        of the pilot, the best first.
        """
        if self.planner.begin():
            with self.meter.pilot():
                self.planner.run_pilot()
        self._use_plan()
        return self.planner.table

    def _use_plan(self):
        if self.kernel.plan is not self.plan:
            self.kernel = self._kernel()

    def _kernel(self) -> TraceContext:
        kernel = TraceContext(self.prepared, self.plan, self.settings, mis.Heuristic(self.settings.heuristic))
        if self.planner.threshold and self.plan.roulette:
            kernel = kernel.with_threshold(dr.opaque(mi.Float64, self.planner.threshold))
        if self.light_groups is not None:
            kernel = kernel.with_light_groups(self.light_groups)
        if self.settings.path_layers:
            kernel = kernel.with_path_layers()
        return kernel

    def _steps(self) -> Iterator[Step]:
        """Yield the remaining passes; under ``timeout`` one takes at most about a tenth of it."""
        if self._small_first is None:
            long = self._pixels >= FEW_PIXELS and self.spp * self._pixels >= TWO_PASSES
            self._small_first = long and self.planner.threshold is None and self._plays_roulette()
        earlier = sum(self.passes)
        for step in schedule(self.spp, self._longest, self.settings, self._small_first):
            skipped = min(earlier, step.size)
            done, end, earlier = step.done + skipped, step.done + step.size, earlier - skipped
            while done < end:
                size = min(end - done, self._affordable(step.size))
                yield replace(step, done=done, size=size)
                done += size

    def _affordable(self, size: int) -> int:
        """Return the samples per pixel of a pass of ``size`` that fit into ``timeout``."""
        if not 0 <= self.settings.timeout < math.inf:
            return size
        return max(1, int(min(self.meter.rate(sum(self.passes)) * 0.1 * self.settings.timeout, size)))

    def _pass(self, step: Step):
        """Trace one pass, with a launch for each batch."""
        if len(self.passes) == 1 and self.planner.threshold is None and self._plays_roulette():
            self.kernel = self.kernel.with_threshold(MOST_ROULETTE * self.accumulator.mean())
        if self.plan.guided and (guide := self._guide()):
            self.kernel = self.kernel.replaced(sds=Guiding(guide, self.kernel.near_specular))
        if self.plan.merging and self.merging is not None:
            self.kernel = self.kernel.replaced(sds=self._photons(step, self.merging))
        for launch, batch in enumerate(batches(self.prepared.camera, step.done, step.size, self.settings)):
            if launch:
                self.meter.wait()
            drawn = self.points.of(step)
            with gc_paused(), dr.scoped_set_flag(dr.JitFlag.KernelHistory, True):
                with evaluated_mode(self.prepared.emitters.evaluated):
                    counts = trace(self.kernel, Image(self.accumulator), batch, drawn, step.of)
                self.accumulator.evaluate(counts)
            self.meter.launched(counts)
        self.accumulator.close_pass(step.size)

    def _plays_roulette(self) -> bool:
        """Return whether contributions of strategies in use may play roulette."""
        return self.plan.roulette and self.plan.light

    def _photons(self, step: Step, merging: Passes) -> PhotonStrategy:
        """Trace the photons of a pass; returns their merging."""
        start = self.points.wavelengths(step) if mi.is_spectral else None
        points = self.points.of_photons(step, passes_since(self.passes, step.done))
        earlier = self.part * self.spp + sum(self.passes)
        with gc_paused(), evaluated_mode(self.prepared.emitters.evaluated):
            photons, counts = merging.trace(self.kernel, points, step.size, earlier, start)
        self.meter.launched(counts)
        return photons

    @quick_compilation()
    def _guide(self) -> Guide | None:
        """Return the photon guide, traced before the first pass; None without photons."""
        if self._guides is None:
            count = photon_pass.photons_of(self.spp * self._pixels)
            with gc_paused(), evaluated_mode(self.prepared.emitters.evaluated):
                guide, counts = photon_pass.trace_guide(self.kernel, self.aim, self.points.of_guide(), count)
            self.meter.launched(counts)
            self._guides = (guide,)
        return self._guides[0]

    def _is_exact_enough(self) -> bool:
        """Return whether a full group of replicates reaches ``target_error``."""
        replicates = self.accumulator.replicates
        whole = replicates.spp == sum(self.passes) > 0 and not replicates.count % REPLICATES
        if not self.settings.target_error or not whole:
            return False
        self._error = self.accumulator.error()
        return self._error <= self.settings.target_error

    def report(self) -> PassReport:
        """Return the progress so far, for ``on_pass``."""
        self._state = self._freeze()
        done, counts = len(self.passes), sum(rays(self).values())
        made = partial(self._snapshot, done), partial(self._image, done)
        return PassReport(sum(self.passes), self.spp, self.meter.work.seconds, counts, self._error, *made)

    def _freeze(self) -> tuple[tuple[int, ...], Progress, dict]:
        """Return passes, progress and arrays of a snapshot, consistent even if an interruption comes."""
        passes, arrays = self.accumulator.store()
        progress = Progress(self.planner.decided, self.meter.work, self._small_first, self.why_merged)
        return passes, progress, arrays | {"inverse_threshold": self.kernel.inverse_threshold}

    def _snapshot(self, reported: int) -> Snapshot:
        """Return the snapshot of the report after ``reported`` passes, the newest; else `UsageError`."""
        state = self._state
        if state is None or len(state[0]) != reported:
            raise _too_late("snapshot", reported)
        passes, progress, arrays = state
        arrays = {name: np.array(a, dtype=np.float64) for name, a in arrays.items()}
        return Snapshot(self._identity(), passes, progress, arrays)

    def _image(self, reported: int):
        """Return the image of the report after ``reported`` passes; see `_snapshot`."""
        if len(self.passes) != reported:
            raise _too_late("image", reported)
        self.accumulator.finish()
        image = self.sensor.film().develop()
        dr.eval(image)
        return image

    def _identity(self) -> dict:
        return identity(self.settings, self.accumulator, int(self.points.seed[0]), self.spp, self.part)

    def resume(self, snapshot: Snapshot, apart_from=()):
        """Continue after the passes of a snapshot; raises `UsageError` if it is of another render."""
        snapshot.check(self._identity(), apart_from)
        progress, arrays = snapshot.progress, snapshot.arrays
        self.planner.restore(progress.decided)
        self._use_plan()
        self.kernel.inverse_threshold = dr.opaque(mi.Float, np.float32(arrays["inverse_threshold"][0]))
        self.accumulator.restore(snapshot.passes, arrays)
        self.meter.resume(progress.work, snapshot.spp)
        self._small_first, self.why_merged = progress.small_first, progress.why_merged

    def unsampled_light(self) -> dict[int, float]:
        """Return and warn of shares of light not sampled, by index in ``scene.emitters()``."""
        missing = self.missing() if self.passes else None
        messages.warn_of_unsampled_light(self.prepared, self.plan, missing)
        emitters, of_scene = self.prepared.emitters.objects, self.prepared.scene.emitters()
        return {of_scene.index(emitters[i]): x for i, x in (missing.shares if missing else {}).items()}

    def _unsampled(self) -> UnsampledLight | None:
        """Unsampled light transport, estimated once per scene and plan until an edit; None if none."""
        prepared, plan, settings = self.prepared, self.plan, self.settings
        if not unsampled_light.is_possible(prepared, plan, settings):
            return None
        samples = self._samples()
        look = partial(unsampled_light.estimate, prepared, plan, settings, samples)
        key = replace(plan, skipped=()), settings, samples
        unsampled, _ = self.findings.find("unsampled light", key, look)
        return unsampled if unsampled.colours else None

    def missing(self) -> Missing | None:
        """Return what the strategies in use do not sample, or hardly ever; None if nothing.

        Shares are of the image so far; before the first pass, of its mean as a decision has estimated it,
        else as one sample per pixel does.
        """
        unsampled = self._unsampled()
        if unsampled is None:
            return None
        made = self.planner.decided.decisions
        if self.passes:
            shares = unsampled.shares(number(self.accumulator.mean()))
        elif made and made[-1].mean > 0:
            shares = unsampled.shares(made[-1].mean, of_pilot=True)
        else:
            shares = unsampled.shares(self.findings.find("mean", self.settings, self._first_mean)[0])
        return unsampled_light.missing(self.prepared, self.plan, unsampled, shares, self._samples())

    @quick_compilation(once=False)
    def _first_mean(self) -> float:
        """Mean of an image of one sample per pixel, or of `LEAST_OF_MEAN` samples."""
        other = self._like(self.settings, 0, -(-LEAST_OF_MEAN // self._pixels))
        other._pass(Step(0, 0, other.spp, other.spp))
        return number(other.accumulator.mean())

    def _samples(self) -> int:
        """Samples per pixel of the whole render; under ``timeout`` those that the passes so far predict."""
        done, timeout = sum(self.passes), self.settings.timeout
        if not done:
            return expected_samples(self.settings, self.spp * self._pixels) // self._pixels
        if not 0 <= timeout < math.inf:
            return max(self.spp, done)
        predicted = max(self.meter.rate(done) * timeout, done, 1)
        return min(self.spp, 2 ** round(math.log2(predicted)))


def _too_late(call: str, reported: int) -> UsageError:
    about = f"{call}() of the report after {reported} passes came too late"
    return UsageError(f"{about}; only the newest report has one")


@contextmanager
def interruptible():
    """Raise the ``KeyboardInterrupt`` that an error of the body wraps, see `raise_interrupt`."""
    try:
        yield
    except RuntimeError as error:
        raise_interrupt(error)
        raise


def raise_interrupt(error: BaseException):
    """Raise the ``KeyboardInterrupt`` that Dr.Jit has converted to the ``RuntimeError`` ``error``."""
    cause = behind(error, KeyboardInterrupt)
    if cause is not None:
        raise cause from None
