"""One render from its first sample to the film: pilots, passes, progress, statistics."""

from __future__ import annotations

import json
import math
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass, replace
from functools import partial

import drjit as dr
import mitsuba as mi
import numpy as np

from .._version import __version__
from ..errors import UsageError
from ..host.edits import State
from ..host.introspection import number
from ..host.jit import evaluated_mode, gc_paused
from ..host.notices import remembered
from ..image.accumulator import Accumulator
from ..image.features import FeatureLayers, feature_names
from ..image.layers import strategy_count
from ..image.sink import Image
from ..parameters import check_film, check_not_frozen, check_scene, check_variant, integer
from ..planning import choice, lost_light, pilot
from ..planning.explain import words
from ..planning.moments import ARRAYS, Moments
from ..planning.possible import plan, unreachable_paths
from ..sampling import points
from ..scene.prepared import PreparedScene
from ..settings import Settings
from ..transport import mis
from ..transport.counters import COUNTERS
from ..transport.kernel import Kernel, trace
from .schedule import REPLICATES, Step, batches, schedule
from .snapshot import FORMAT, Snapshot

# Kinds of rays in the statistics, of what the kernel counts.
RAYS = ("camera", "light", "shadow_s1", "shadow_t1", "shadow_inner")

# Pilots have the sequences that follow this number, see `sequence_seed`, and images, after changes of the
# decision, those that follow the other one.
PILOT_SEQUENCE, CHANGED_SEQUENCE = 1 << 16, 1 << 17

# Samples per pixel after which a pilot is asked again, then after four times as many, and so on.
FIRST_REPEAT = 32

# Share of a render after which none is asked any more: what is left has to pay for it.
LATEST_REPEAT = 1 / 4

# Why a pilot that was asked decides nothing.
SAW_NOTHING = "it saw nothing, or no finite value"

# What strategy images may take, in bytes, before the render is refused.
STRATEGY_MEMORY = 2 << 30


@dataclass(frozen=True)
class PassReport:
    """Progress after a pass: samples per pixel, seconds and rays so far; ``error`` the relMSE estimated
    when ``until_error`` was last looked at, else ``None``; ``snapshot()``, of the newest report, gives what a
    later render can start from."""

    spp_done: int
    spp_total: int
    seconds: float
    rays: int
    error: float | None
    snapshot: Callable[[], Snapshot]


def sequence_seed(seed, number: int):
    """Seed of a point sequence besides the image's own: numbers from 1 are the replicates of `variance`."""
    other = mi.sample_tea_32(seed, mi.UInt32(number))[1]
    dr.make_opaque(other)
    return other


class Render:
    """One render of ``spp`` samples per pixel: its scene, plan, accumulators and progress. Lives for one
    call."""

    # What pilots draw is the same in renders of all seeds, so that all decide alike. (Of 32 the one
    # whose choices have the least time times error in the scenes of docs/choices.json.)
    pilot_seed = 30

    def __init__(self, scene, sensor, settings: Settings, seed, spp: int):
        check_variant()
        check_not_frozen()
        check_scene(scene, sensor)
        colour = check_film(sensor, settings)
        self.started = time.perf_counter()
        self.sensor, self.settings, self.spp = sensor, settings, spp
        self.prepared = PreparedScene(scene, sensor)
        self._pixels = int(self.prepared.camera.region.size.prod())
        self._full = self.plan = choice.first_plan(plan(self.prepared, settings), settings, self._pixels)
        if not isinstance(seed, mi.UInt32):
            seed = integer(seed, "seed", 0)
        self.seed = mi.UInt32(seed)
        dr.make_opaque(self.seed)
        depth = settings.strategy_depth
        _check_strategy_memory(depth, sensor.film())
        features = FeatureLayers(scene, sensor, settings.aovs, spp) if feature_names(settings.aovs) else None
        border = self.prepared.camera.region.border
        self.accumulator = Accumulator(sensor.film(), colour, border, depth, settings.variance, features)
        self._samplers, self._running = {}, []
        self.decisions, self._moments, self._threshold = [], None, None
        self._pilots, self._changes, self._next_pilot = 0, 0, FIRST_REPEAT
        self._remembered = 0
        self._use(self.plan)
        self._counts = dict.fromkeys(COUNTERS, 0)
        self.compiled, self.cached, self.compile_seconds, self.pilot_seconds = 0, 0, 0.0, 0.0
        self._left_out, self._small_first, self._error, self._earlier = [], None, None, 0.0
        self._no_pilot = ""  # why none was asked, or decided nothing
        # Samples per pixel, and seconds of compiling and pilots, of the render that this one goes on from.
        self._resumed_at, self._resumed_idle = 0, 0.0

    def decide(self) -> list:
        """Adopt what the scene alone or a pilot says, if there is a choice and the render is long enough to
        pay for a pilot; returns all candidates of the pilot, the best first."""
        settled, decision = self._settled()
        if not self.accumulator.passes and self.settings.decisions is None:
            self._no_pilot = settled
        if decision and not self.accumulator.passes:
            self._adopt(decision, choice.BY_SCENE)
        if settled:
            return []
        samples = self._expected()
        count = choice.lanes(samples)
        self._wait()  # earlier passes are not the pilot's time
        started, compiled = time.perf_counter(), self.compile_seconds
        self._pilots += 1
        moments = self._pilot(count, samples / count)
        self._moments = moments if self._moments is None else self._moments.joined(moments)
        possible = choice.candidates(self.prepared, self._full, self.settings)
        table = choice.choose(self._moments, possible, self._has_stratified_points(), samples)
        if not self._moments.mean > 0:  # a pilot that sees nothing, or NaN, says nothing
            table = []
        if table:
            best, number = table[0], len(self.accumulator.passes)
            decision = best.candidate.decided(number, best.cost, best.variance, self._moments.mean)
            self._adopt(decision, choice.left_out(table))
        self._no_pilot = "" if self.decisions else SAW_NOTHING
        self.pilot_seconds += time.perf_counter() - started - (self.compile_seconds - compiled)
        return table

    def _pilot(self, count: int, stands_for: float) -> Moments:
        """What the next pilot of ``count`` samples finds, see `pilot.measure`. Where the same one was traced
        in an earlier render, and nothing was edited since, that is remembered: it would find the same."""
        key = self._scene_state(), self.settings, self.pilot_seed, self._pilots, count, stands_for

        def trace() -> Moments:
            seed = sequence_seed(mi.UInt32(self.pilot_seed), PILOT_SEQUENCE + self._pilots)
            flag = dr.scoped_set_flag(dr.JitFlag.KernelHistory, True)
            with gc_paused(), flag, evaluated_mode(self.prepared.emitters.evaluated):
                found = pilot.measure(self.prepared, self._full, self.settings, seed, count, stands_for)
            self._wait()  # for the kernel's entry in the history
            return found

        found, is_known = remembered(self.prepared.scene, self.sensor, "pilots", key, trace)
        self._remembered += is_known
        return found

    def _scene_state(self) -> tuple:
        """What tells scene and sensor from themselves after an edit."""
        return State.of([self.prepared.scene, self.sensor]), self.prepared.camera.region.border

    def certainty(self) -> float:
        """`choice.certainty` of what the pilots decided."""
        possible = choice.candidates(self.prepared, self._full, self.settings)
        return choice.certainty(self._moments, possible, self._has_stratified_points(), self._expected())

    def lost_by_pilot(self) -> int:
        """Values of the pilots that were not finite, and counted as zero."""
        return 0 if self._moments is None else round(self._moments.rays["non_finite"] * self._moments.lanes)

    def why_no_pilot(self) -> str:
        """Why there is no table of a pilot's, as a sentence."""
        return f"no pilot: {self._settled()[0] or SAW_NOTHING}"

    def _settled(self) -> tuple[str, choice.Decision | None]:
        """Why no pilot is asked about the rest of the render, empty if one is; and the decision, if there is
        one."""
        if not choice.is_open(self._full, self.settings):
            by_hand = choice.is_by_hand(self.settings)
            why = "chosen by hand" if by_hand else "light subpaths cannot add anything"
            return f"there is nothing to choose: {why}", None
        if self._pixels < choice.FEW_PIXELS:
            return f"it says nothing about films of fewer than {choice.FEW_PIXELS} pixels", None
        samples = self._expected()
        whole = sum(self.accumulator.passes) * self._pixels + samples
        if decision := choice.by_scene(self.prepared, self._full, self.settings, whole):
            return "the scene alone decides in a render as short as this", decision
        if samples < (least := choice.least_samples(self.prepared.traits)):
            return f"{samples} samples are too few, it takes {least}", None
        return "", None

    def _expected(self) -> int:
        """Samples still to come, as far as that is known."""
        done = sum(self.accumulator.passes)
        return choice.expected_samples(self.settings, (self.spp - done) * self._pixels, done * self._pixels)

    def _has_stratified_points(self) -> bool:
        if self.settings.points == "sampler":
            return self.sensor.sampler().class_name() != "IndependentSampler"
        return self.settings.points == "sobol"

    def _adopt(self, decision, left_out=()):
        """Render as decided from now on; if that differs from before, with points of their own: lanes serve
        other samples, and what was half done of the old sequence would not be finished."""
        adopted = replace(decision.plan(self._full), skipped=(*self._full.skipped, *left_out))
        if (self.decisions or decision.first_pass) and replace(adopted, skipped=()) != replace(
            self.plan, skipped=()
        ):
            self._changes += 1
        self.decisions.append(decision)
        self._left_out = list(left_out)
        self._threshold = decision.threshold
        self._use(adopted)

    def _use(self, chosen):
        self.plan = chosen
        self.kernel = Kernel(self.prepared, chosen, self.settings, mis.Heuristic(self.settings.heuristic))
        if self._threshold and chosen.roulette:
            self.kernel.set_threshold(dr.opaque(mi.Float64, self._threshold))

    def replay(self, number: int):
        """Adopt the decision that is given for the pass of this ``number``, if there is one."""
        for decision in self.settings.decisions:
            if decision.first_pass == number:
                self._adopt(decision, choice.replayed(decision))
                before = self._lost(self._full)
                for lost in self._lost(self.plan):
                    if lost not in before:
                        mi.Log(mi.LogLevel.Warn, f"bdpt: decisions leave out light: {words(lost)}")

    def _lost(self, p):
        return unreachable_paths(self.prepared, p, self.settings)

    def _decide_before(self, step: Step):
        """Replay the decision for this pass; or, early in a long render, ask another pilot."""
        number = len(self.accumulator.passes)
        if self.settings.decisions:
            self.replay(number)
        elif number and step.done >= self._next_pilot and not self.settings.variance:
            while self._next_pilot <= step.done:
                self._next_pilot *= 4
            # A scene's sampler cannot start again in the middle of its samples.
            if step.done <= LATEST_REPEAT * self.spp and self.settings.points != "sampler":
                self.decide()

    def run(self, on_pass, cancelled=lambda: False):
        """Trace the samples, fewer under ``timeout``, when ``cancelled()`` after a pass or when
        interrupted."""
        timeout = self.settings.timeout
        watched = on_pass is not None or timeout >= 0
        try:
            if not self.accumulator.passes:
                self.decide()
            for number, step in enumerate(self._steps()):
                if not number and self._is_exact_enough():  # the one that it goes on from was
                    break
                self._decide_before(step)
                self._pass(step)
                # The second pass is recorded while the first, a short one, runs.
                if watched or number > 0:
                    self._wait()
                if step.last and self.settings.variance:
                    self.accumulator.close_replicate()
                exact = self._is_exact_enough()
                if on_pass is not None:
                    on_pass(self.report())
                if exact or 0 <= timeout <= time.perf_counter() - self.started or cancelled():
                    break
        except RuntimeError as error:
            raise_interrupt(error)
            raise
        finally:
            try:
                self._wait()
            finally:
                self.accumulator.finish()

    def _steps(self):
        """The passes of `schedule`; under ``timeout`` cut, so that one takes about a tenth of it."""
        # The first pass gives roulette the scale of the image, if no pilot has.
        if self._small_first is None:
            first = self.settings.decisions and self.settings.decisions[0].first_pass == 0
            known = self._threshold is not None or first
            self._small_first = bool(self.plan.roulette and self.plan.light and not known)
        earlier = sum(self.accumulator.passes)
        for step in schedule(self.prepared.camera, self.spp, self.settings, self._small_first):
            done, end = step.done, step.done + step.size
            skipped = min(earlier, step.size)
            done, earlier = done + skipped, earlier - skipped
            while done < end:
                size = min(end - done, self._affordable(step.size))
                last = step.last and done + size == end
                yield replace(step, done=done, size=size, last=last)
                done += size

    def _is_exact_enough(self) -> bool:
        """Whether a group of replicates is whole and its error is what ``until_error`` asks for."""
        if not self.settings.until_error or not self.accumulator.ends_replicates():
            return False
        if self.accumulator.replicates.count % REPLICATES:
            return False
        self._error = self.accumulator.error()
        return self._error <= self.settings.until_error

    def _affordable(self, size: int) -> int:
        if not 0 <= self.settings.timeout < math.inf or self.settings.points == "sampler":
            return size
        spp, idle = sum(self.accumulator.passes), self.compile_seconds + self.pilot_seconds
        busy = time.perf_counter() - self.started - (idle - self._resumed_idle)
        rate = (spp - self._resumed_at) / max(busy, 1e-3)
        return max(1, int(min(rate * 0.1 * self.settings.timeout, size)))

    def _pass(self, step: Step):
        first = not self.accumulator.passes and self._threshold is None
        for launch, batch in enumerate(batches(self.prepared.camera, step.done, step.size, self.settings)):
            if launch:
                self._wait()
            drawn = self._points(step, batch)
            with gc_paused(), dr.scoped_set_flag(dr.JitFlag.KernelHistory, True):
                with evaluated_mode(self.prepared.emitters.evaluated):
                    counts = trace(self.kernel, Image(self.accumulator), batch, drawn, step.of)
                self.accumulator.evaluate(counts)
            self._running.append(counts)
        self.accumulator.close_pass(step.size)
        if first and self.plan.roulette:
            self.kernel.set_threshold(choice.MOST_ROULETTE * self.accumulator.mean())

    def _points(self, step, batch):
        seed = self.seed
        number = step.replicate + (CHANGED_SEQUENCE + self._changes if self._changes else 0)
        if number:
            seed = sequence_seed(self.seed, number)
        if self.settings.points != "sampler":
            return points.Points(self.settings.points, seed)
        # One sampler per band of rows goes on from pass to pass, as Mitsuba's own passes do.
        sampler = self._samplers.get(batch.first_pixel)
        if sampler is None or step.done == 0:
            sampler = self.sensor.sampler().clone()
            sampler.set_sample_count(step.of)
            sampler.set_samples_per_wavefront(batch.samples)
            band = mi.sample_tea_32(seed, mi.UInt32(batch.first_pixel))[0]
            sampler.seed(band, points.Points.sequences(batch.pixels) * batch.samples)
            self._samplers[batch.first_pixel] = sampler
        else:
            sampler.advance()
        drawn = points.Points("sampler", seed, sampler, batch.samples)
        sampler.schedule_state()
        dr.eval()
        return drawn

    def _wait(self):
        """Wait for what was launched, and note what it did and how it was compiled."""
        dr.sync_thread()
        while self._running:
            batch = self._running.pop().numpy().tolist()
            self._counts = {name: self._counts[name] + n for name, n in zip(self._counts, batch, strict=True)}
        for entry in dr.kernel_history():
            if entry["type"] == dr.KernelType.JIT:
                self.cached += bool(entry["cache_hit"])
                self.compiled += not entry["cache_hit"]
                # What is in the cache is still assembled, which is not compiling.
                new = not entry["cache_hit"]
                self.compile_seconds += new * (entry["codegen_time"] + entry["backend_time"]) / 1000

    def report(self) -> PassReport:
        """Progress so far, for ``on_pass``."""
        self._state = self._freeze()
        passes, rays = self.accumulator.passes, sum(self._rays().values())
        snapshot = partial(self._snapshot, len(passes))
        return PassReport(sum(passes), self.spp, self._seconds(), rays, self._error, snapshot)

    def _seconds(self) -> float:
        """So far, those of the render that this one goes on from included."""
        return self._earlier + time.perf_counter() - self.started

    def identity(self) -> dict:
        """What two renders have to have in common for one to go on from the other, besides the scene; as
        JSON holds it."""
        film, settings = self.sensor.film(), asdict(self.settings)
        del settings["timeout"]
        settings["until_error"] = bool(self.settings.until_error)  # the passes depend on whether there is one
        values = settings | {
            "version": __version__,
            "format": FORMAT,
            "variant": mi.variant(),
            "seed": int(self.seed[0]),
            "spp": self.spp,
            "film": [film.class_name(), *self.accumulator.size, *self.accumulator.offset],
            "filter": str(film.rfilter()),
            "colours": list(self.accumulator.colour.names),
        }
        return json.loads(json.dumps(values))

    def _freeze(self) -> tuple:
        """Passes, progress and arrays of a snapshot of now, also when the next pass has begun: an
        interruption may come between any two of its steps. Nothing is copied yet."""
        passes, arrays, replicates = self.accumulator.store()
        moments = None
        if self._moments is not None:
            moments = {name: getattr(self._moments, name) for name in ("mean", "rays", "lanes")}
            arrays |= {f"moments.{name}": getattr(self._moments, name) for name in ARRAYS}
        progress = {
            "whole": True,
            "decisions": [decision.record() for decision in self.decisions],
            "no_pilot": self._no_pilot,
            "left_out": list(self._left_out),
            "moments": moments,
            "pilots": [self._pilots, self._remembered, self._next_pilot],
            "small_first": self._small_first,
            "replicates": replicates,
            "counts": dict(self._counts),
            "compiled": self.compiled,
            "cached": self.cached,
            "seconds": self._seconds(),
            "compile_seconds": self.compile_seconds,
            "pilot_seconds": self.pilot_seconds,
        }
        return passes, progress, arrays | {"inverse_threshold": self.kernel.inverse_threshold}

    def _snapshot(self, reported: int) -> Snapshot:
        """The snapshot of the report after so many passes; raises ``ValueError`` if a later one was made
        (each would keep the sums of its time)."""
        passes, progress, arrays = self._state
        if len(passes) != reported:
            raise UsageError(
                f"snapshot() of the report after {reported} passes came too late; only the newest "
                "report has one"
            )
        return Snapshot(
            self.identity(), passes, progress, {n: np.array(a, dtype=np.float64) for n, a in arrays.items()}
        )

    def resume(self, snapshot: Snapshot, apart_from=()):
        """Go on after the passes of a snapshot, which raises ``ValueError`` if it is of another render (see
        `Snapshot.check`)."""
        snapshot.check(self.identity(), apart_from)
        progress, arrays = snapshot.progress, snapshot.arrays
        for decision in choice.read_decisions(json.dumps(progress["decisions"])):
            self._adopt(decision, progress["left_out"])
        self.accumulator.restore(snapshot.passes, arrays, progress["replicates"])
        if progress["moments"] and "moments.base" in arrays:
            parts = {name: arrays[f"moments.{name}"] for name in ARRAYS}
            self._moments = Moments(**parts, **progress["moments"])
        self._pilots, self._remembered, self._next_pilot = progress["pilots"]
        self._small_first, self._no_pilot = progress["small_first"], progress["no_pilot"]
        self.kernel.inverse_threshold = dr.opaque(mi.Float, np.float32(arrays["inverse_threshold"][0]))
        self._counts = dict(progress["counts"])
        self.compiled, self.cached = progress["compiled"], progress["cached"]
        self.compile_seconds, self.pilot_seconds = progress["compile_seconds"], progress["pilot_seconds"]
        self._earlier = progress["seconds"]
        self._resumed_at, self._resumed_idle = snapshot.spp, self.compile_seconds + self.pilot_seconds

    def lost_light(self) -> tuple[dict, str]:
        """Shares of the image's light that no strategy in use finds, by the index of the emitter, and in
        words, which are empty where it is little. Looked for once for a scene and choice, until an edit."""
        if not self.accumulator.passes or not lost_light.is_possible(self.prepared, self.plan, self.settings):
            return {}, ""
        key = self._scene_state(), self.plan.splat, self.plan.direct, self.settings.max_depth
        look = partial(lost_light.lost_radiance, self.prepared, self.plan, self.settings.max_depth)
        lost, _ = remembered(self.prepared.scene, self.sensor, "lost light", key, look)
        whole = number(self.accumulator.mean()) + sum(lost.values())
        shares = {i: radiance / whole for i, radiance in lost.items()}
        return shares, lost_light.in_words(self.prepared, self.plan, shares)

    def _rays(self):
        rays = {name: self._counts[name] for name in RAYS}
        if self.accumulator.features is not None:  # one per camera sample
            rays["features"] = sum(self.accumulator.passes) * self._pixels
        return rays

    def statistics(self) -> dict:
        """The render in numbers; plain values only."""
        connections = {name: self._counts[name] for name in ("evaluated", "zero", "rouletted")}
        connections["traced"] = self._counts["shadow_inner"]
        total = self._seconds()
        return {
            "seconds": {
                "compile": self.compile_seconds,
                "pilot": self.pilot_seconds,
                "render": total - self.compile_seconds - self.pilot_seconds,
                "total": total,
            },
            "rays": self._rays(),
            "connections": connections,
            "skipped": list(self.plan.skipped),
            "decisions": [d.record() for d in self.decisions],
            "no_pilot": self._no_pilot,
            "pilots": {"asked": self._pilots, "remembered": self._remembered},
            "passes": list(self.accumulator.passes),
            "non_finite": self._counts["non_finite"],
            "non_finite_in_pilot": self.lost_by_pilot(),
            "kernels": {"compiled": self.compiled, "cached": self.cached},
            **({"error": self.accumulator.error()} if self.settings.variance else {}),
            "peak_memory": int(dr.detail.malloc_watermark(dr.backend_v(mi.Float))),
        }


def raise_interrupt(error: BaseException):
    """Raise the ``KeyboardInterrupt`` that is behind ``error``, if one is: Dr.Jit makes a ``RuntimeError`` of
    all that comes while it records a loop or a call."""
    cause = error
    while cause is not None:
        if isinstance(cause, KeyboardInterrupt):
            raise cause from None
        cause = cause.__cause__ or cause.__context__


def _check_strategy_memory(depth: int, film):
    w, h = (int(x) for x in film.crop_size())
    # Six channels in double precision: those of a pass, of all passes and, while they are added, of both.
    needed = strategy_count(depth) * w * h * 6 * (8 + 16)
    if needed > STRATEGY_MEMORY:
        raise UsageError(
            f"strategy_images at {w}x{h} with max_depth={depth} needs about "
            f"{needed / 2**30:.1f} GiB, more than {STRATEGY_MEMORY / 2**30:.0f} GiB; use a smaller "
            "film or max_depth"
        )
