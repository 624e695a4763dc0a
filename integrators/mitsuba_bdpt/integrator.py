"""The integrator plugin ``bdpt``: parameters, passes, statistics."""

from __future__ import annotations

import json
import math
import time
from dataclasses import asdict, dataclass, replace

import drjit as dr
import mitsuba as mi

from . import choice, mis, pilot, points
from .colour import Bands, film_colours
from .explain import explain
from .features import FeatureLayers, feature_names
from .film import Accumulator
from .kernel import COUNTERS, Batch, Kernel, trace
from .objects import step_by_step
from .parameters import integer, is_index, read_settings
from .plan import UNLIMITED, Settings, plan
from .sensor_records import Sensor
from .sinks import Image
from .strategies import layer_names, strategy_count
from .world import World

# Samples in one kernel launch. Nothing per sample is kept in memory, so this only bounds how long
# a launch runs (seconds on a few cores) and with it the delay of Ctrl-C, timeout and progress.
PASS_SAMPLES = 1 << 21

# Samples that one pixel's sum takes in single precision: the rounding grows with them, is the same in
# every pass and does not average out (constant radiance, 2^12: 4e-6; 2^16: 5e-5; 2^20: 1e-3).
MOST_SPP = 1 << 12

# With points=sampler the scene sampler's numbers are kept per sample: 80 bytes each.
PASS_SAMPLES_SAMPLER = 1 << 20

# Kinds of rays in the statistics, of what the kernel counts.
RAYS = ("camera", "light", "shadow_s1", "shadow_t1", "shadow_inner")

# Independent images whose spread gives the variance: as few as the contract allows, since each has a
# point sequence of its own and short sequences are worse.
REPLICATES = 8

# Pilots have the sequences that follow this number, see `sequence_seed`, and images, after changes of the
# decision, those that follow the other one.
PILOT_SEQUENCE, CHANGED_SEQUENCE = 1 << 16, 1 << 17

# Samples per pixel after which a pilot is asked again, then after four times as many, and so on.
FIRST_REPEAT = 32

# What strategy images may take, in bytes, before the render is refused.
STRATEGY_MEMORY = 2 << 30


@dataclass(frozen=True)
class PassReport:
    """Progress after a pass: samples per pixel, seconds and rays so far."""

    spp_done: int
    spp_total: int
    seconds: float
    rays: int


DOCUMENTATION = """Bidirectional path tracer (plugin ``bdpt``).

Every path of k edges can be made in k + 2 ways (s, t) with s light vertices and t camera vertices,
s + t = k + 1 (E. Veach, "Robust Monte Carlo Methods for Light Transport Simulation", 1997, chapter 10).
All of them are combined by multiple importance sampling.

.. pluginparameters::

 * - max_depth
   - |int|
   - Longest path in edges, as in ``path``: 1 is directly visible emitters, -1 (default) unlimited.
 * - rr_depth
   - |int|
   - Russian roulette starts at this depth, as in ``path``. (Default: 5)
 * - hide_emitters
   - |bool|
   - Hide directly visible emitters, as in ``path``. (Default: false)
 * - heuristic
   - |string|
   - ``balance`` (default), ``power``, ``maximum`` or ``uniform``.
 * - skip
   - |string|
   - ``impossible`` leaves out what the scene cannot use, draws one connection per camera vertex and drops
     small contributions by unbiased roulette; ``auto`` (default) does so too and, in renders of 2^19
     samples or more, asks a pilot what pays (see `choice`); ``none`` does everything.
 * - light_paths
   - |string| or |float|
   - Light subpaths per camera subpath: ``auto`` (default: what the pilot chooses, else 1/4, or 1 with
     ``skip=none``), 0, 1, 1/2, 1/4, 1/8 or 1/16. One light subpath serves camera subpaths of different
     pixels. Given by hand, there is no pilot.
 * - connections
   - |string|
   - Inner connections per camera vertex: ``all``, ``one`` (drawn by its unshadowed contribution),
     ``none``, or ``auto`` (default: what the pilot chooses, else ``one``, or ``all`` with ``skip=none``).
     Given by hand, there is no pilot.
 * - points
   - |string|
   - ``sobol`` (default): Owen-scrambled Sobol' points for light and BSDF samples; ``sampler``: the
     scene's sampler for the first of them; ``independent``.
 * - decisions
   - |string|
   - JSON of ``statistics["decisions"]`` of an earlier render, done again instead of asking a pilot.
     (Default: none)
 * - stored_vertices
   - |int|
   - Longest path in edges that uses all strategies; longer ones use s = 0 and s = 1. (Default: 64)
 * - strategy_images
   - |bool|
   - Adds the layers ``weighted.s{S}t{T}`` and ``unweighted.s{S}t{T}`` for each strategy; needs a
     finite ``max_depth``. (Default: false)
 * - variance
   - |bool|
   - Adds the layers ``variance.R``, ``.G``, ``.B``: the variance of each pixel, splats included,
     estimated from 8 independent parts of the render; ``statistics["error"]`` is the relMSE that
     follows. Needs at least 8 samples per pixel. On a ``specfilm`` these layers are called after its
     bands. (Default: false)
 * - aovs
   - |string|
   - Adds feature layers, named by pairs ``name:kind`` as in Mitsuba's ``aov`` and equal to its layers:
     ``albedo``, ``depth``, ``position``, ``uv``, ``geo_normal``, ``sh_normal``, ``dp_du``, ``dp_dv``,
     ``duv_dx``, ``duv_dy``, ``prim_index``, ``shape_index``. (Default: none)
 * - spp_per_pass
   - |int|
   - Samples per pixel in one pass; 0 (default) chooses.
 * - timeout
   - |float|
   - Stop after the pass in which so many seconds were exceeded; -1 (default): never.

Layers of the film come in this order: colours and alpha, features, variance, strategies.

Attributes: ``statistics``, a dictionary about the last render; ``on_pass``, ``None`` or a function
that is called with a `PassReport` after each pass.

Not supported, and refused in words: scalar and polarized variants, participating media,
derivatives, ``strategy_images`` on a ``specfilm``. Emitters and sensors of every kind take part; where
one cannot have a strategy (a sensor of a class that is not Mitsuba's has no t = 1), it is skipped, and
``explain`` says so.
"""


def check_variant():
    """Raise ``NotImplementedError`` for variants that the method cannot serve."""
    variant = mi.variant()
    if not variant.startswith(("llvm", "cuda")):
        raise NotImplementedError(
            f"bdpt: the variant {variant} is scalar; use a vectorised one, for example "
            "mi.set_variant('llvm_ad_rgb')"
        )
    if mi.is_polarized:
        raise NotImplementedError(
            f"bdpt: the variant {variant} is polarized, which is not supported; use "
            f"{variant.replace('_polarized', '')}"
        )


def check_made_for(integrator, scene):
    """Raise ``TypeError`` if ``integrator`` or ``scene`` belongs to another variant than the present."""
    for name, thing, kind in (("integrator", integrator, mi.Integrator), ("scene", scene, mi.Scene)):
        if not isinstance(thing, kind):
            raise TypeError(
                f"bdpt: {name}={type(thing).__name__} was not loaded under the present variant "
                f"{mi.variant()}; load it again after mi.set_variant"
            )


def check_scene(scene, sensor):
    """Raise ``NotImplementedError`` for what the method cannot render."""
    if sensor.get_medium() is not None:
        raise NotImplementedError(
            f"bdpt: sensor '{sensor.id()}' lies in a participating medium, which is not supported; "
            "use integrator type 'volpath'"
        )
    for shape in scene.shapes():
        if shape.is_medium_transition():
            raise NotImplementedError(
                f"bdpt: shape '{shape.id()}' bounds a participating medium, which is not supported; "
                "use integrator type 'volpath'"
            )


def check_film(sensor, settings: Settings):
    """Raise ``NotImplementedError`` for layers that the film cannot have; returns its colours."""
    colour = film_colours(sensor)
    if settings.strategy_images and isinstance(colour, Bands):
        raise NotImplementedError(
            f"bdpt: strategy_images=True is not possible with film '{sensor.film().id()}' of class SpecFilm: "
            "these layers are RGB, and the film samples the wavelengths of its bands only; use hdrfilm"
        )
    return colour


def _most_samples(settings: Settings) -> int:
    """Samples in one launch."""
    return PASS_SAMPLES_SAMPLER if settings.points == "sampler" else PASS_SAMPLES


def pass_sizes(camera: Sensor, spp: int, settings: Settings, small_first: bool) -> list[int]:
    """Samples per pixel of each pass, in order, ``spp`` in all; the first is 1 if ``small_first``."""
    limit = _most_samples(settings)
    width, height = (int(x) for x in camera.region.size)
    # One row of pixels fits into four launches' worth, see `batches`.
    most = min(MOST_SPP, max(4 * limit // width, 1))
    size = min(settings.spp_per_pass or max(limit // (width * height), 1), most)
    sizes = []
    if settings.points == "sampler":
        # Stratified samplers number the samples of a pixel; passes must cut them evenly.
        size = next(n for n in range(min(size, spp), 0, -1) if spp % n == 0)
    elif small_first and spp > 1:
        sizes, spp = [1], spp - 1
    return sizes + [size] * (spp // size) + ([spp % size] if spp % size else [])


@dataclass(frozen=True)
class Step:
    """A pass: ``size`` samples per pixel after ``done`` of the ``of`` of its replicate, whose last it
    may be; ``replicate`` counts the independent images that `variance` needs, else 0."""

    replicate: int
    done: int
    size: int
    of: int
    last: bool


def schedule(camera: Sensor, spp: int, settings: Settings, small_first: bool) -> list[Step]:
    """All passes of a render of ``spp`` samples per pixel; ``small_first`` see `pass_sizes`."""
    parts = [spp]
    if settings.variance:
        parts = [spp // REPLICATES + (i < spp % REPLICATES) for i in range(REPLICATES)]
    steps = []
    for replicate, part in enumerate(parts):
        done = 0
        for size in pass_sizes(camera, part, settings, small_first and replicate == 0):
            steps.append(Step(replicate, done, size, part, done + size == part))
            done += size
    return steps


def batches(camera: Sensor, first_sample: int, samples: int, settings: Settings):
    """Cut a pass into bands of rows that one kernel launch can take."""
    limit = _most_samples(settings)
    width, height = (int(x) for x in camera.region.size)
    rows = (
        height
        if settings.spp_per_pass == 0 and width * height * samples <= limit
        else max(1, min(height, 4 * limit // max(width * samples, 1)))
    )
    return [
        Batch(y * width, min(rows, height - y) * width, first_sample, samples) for y in range(0, height, rows)
    ]


def sequence_seed(seed, number: int):
    """Seed of a point sequence besides the image's own: numbers 1 to 7 are the replicates of `variance`."""
    other = mi.sample_tea_32(seed, mi.UInt32(number))[1]
    dr.make_opaque(other)
    return other


class Render:
    """One render of ``spp`` samples per pixel: its scene, plan, accumulators and progress. Lives for one
    call."""

    def __init__(self, scene, sensor, settings: Settings, seed, spp: int):
        check_variant()
        check_scene(scene, sensor)
        colour = check_film(sensor, settings)
        self.started = time.perf_counter()
        self.scene, self.sensor, self.settings, self.spp = scene, sensor, settings, spp
        self.film = sensor.film()
        self.world = World(scene, sensor)
        self.emitters, self.camera = self.world.emitters, self.world.camera
        self._full = self.plan = plan(self.world, settings)
        if not isinstance(seed, mi.UInt32):
            seed = integer(seed, "seed", 0)
        self.seed = mi.UInt32(seed)
        dr.make_opaque(self.seed)
        depth = settings.strategy_depth
        _check_strategy_memory(depth, self.film)
        features = FeatureLayers(scene, sensor, settings.aovs, spp) if feature_names(settings.aovs) else None
        self.accumulator = Accumulator(
            self.film, colour, self.camera.region.border, depth, settings.variance, features
        )
        self._samplers, self._running = {}, []
        self.decisions, self._moments, self._small = [], None, None
        self._pilots, self._changes, self._next_pilot = 0, 0, FIRST_REPEAT
        self._use(self.plan)
        self._counts = dict.fromkeys(COUNTERS, 0)
        self.compiled, self.cached, self.compile_seconds, self.pilot_seconds = 0, 0, 0.0, 0.0

    def decide(self) -> list:
        """Run a pilot and adopt what it chooses, if there is a choice and the render is long enough to pay
        for it; returns all candidates, the best first."""
        left = self.spp - sum(self.accumulator.passes)
        count = choice.lanes(left * int(self.camera.region.size.prod()))
        if not (count and choice.is_open(self._full, self.settings)):
            return []
        self._wait()  # earlier passes are not the pilot's time
        started, compiled = time.perf_counter(), self.compile_seconds
        self._pilots += 1
        seed = sequence_seed(self.seed, PILOT_SEQUENCE + self._pilots)
        with dr.scoped_set_flag(dr.JitFlag.KernelHistory, True), step_by_step(self.emitters.evaluated):
            moments = pilot.measure(self.world, self._full, self.settings, seed, count)
        self._wait()  # for the kernel's entry in the history
        self._moments = moments if self._moments is None else self._moments.joined(moments)
        possible = choice.candidates(self.world, self._full, self.settings)
        table = choice.choose(self._moments, possible, self._has_stratified_points())
        if table and self._moments.mean > 0:  # a pilot that sees nothing says nothing
            best, number = table[0], len(self.accumulator.passes)
            decision = best.candidate.decided(number, best.cost, best.variance, self._moments.mean)
            self._adopt(decision, choice.left_out(table))
        self.pilot_seconds += time.perf_counter() - started - (self.compile_seconds - compiled)
        return table

    def _has_stratified_points(self) -> bool:
        if self.settings.points == "sampler":
            return self.sensor.sampler().class_name() != "IndependentSampler"
        return self.settings.points == "sobol"

    def _adopt(self, decision, left_out=()):
        """Render as decided from now on; if that differs from before, with points of their own: lanes serve
        other samples, and what was half done of the old sequence would not be finished."""
        adopted = replace(decision.plan(self._full), skipped=(*self._full.skipped, *left_out))
        if self.decisions and replace(adopted, skipped=()) != replace(self.plan, skipped=()):
            self._changes += 1
        self.decisions.append(decision)
        self._small = decision.small
        self._use(adopted)

    def _use(self, chosen):
        self.plan = chosen
        self.kernel = Kernel(self.world, chosen, self.settings, mis.Heuristic(self.settings.heuristic))
        if self._small and chosen.roulette:
            self.kernel.set_threshold(dr.opaque(mi.Float64, self._small))

    def replay(self, number: int):
        """Adopt the decision that is given for the pass of this ``number``, if there is one."""
        for decision in self.settings.decisions:
            if decision.first_pass == number:
                self._adopt(decision, choice.replayed(decision))

    def _decide_before(self, step: Step):
        """Replay the decision for this pass; or, early in a long render, ask another pilot."""
        number = len(self.accumulator.passes)
        if self.settings.decisions:
            self.replay(number)
        elif number and step.done >= self._next_pilot and not step.replicate:
            while self._next_pilot <= step.done:
                self._next_pilot *= 4
            # A scene's sampler cannot start again in the middle of its samples.
            if 2 * step.done <= self.spp and self.settings.points != "sampler":
                self.decide()

    def run(self, on_pass, cancelled=lambda: False):
        """Trace the samples, fewer under ``timeout``, when ``cancelled()`` after a pass or when
        interrupted."""
        timeout = self.settings.timeout
        watched = on_pass is not None or timeout >= 0
        try:
            self.decide()
            for number, step in enumerate(self._steps()):
                self._decide_before(step)
                self._pass(step)
                # The second pass is recorded while the first, a short one, runs.
                if watched or number > 0:
                    self._wait()
                if step.last and self.settings.variance:
                    self.accumulator.close_replicate()
                if on_pass is not None:
                    on_pass(self.report())
                if 0 <= timeout <= time.perf_counter() - self.started or cancelled():
                    break
        finally:
            try:
                self._wait()
            finally:
                self.accumulator.finish()

    def _steps(self):
        """The passes of `schedule`; under ``timeout`` cut, so that one takes about a tenth of it."""
        # The first pass gives roulette the scale of the image, if no pilot has.
        known = self._small is not None or self.settings.decisions
        small_first = self.plan.roulette and self.plan.light and not known
        for step in schedule(self.camera, self.spp, self.settings, small_first):
            done, end = step.done, step.done + step.size
            while done < end:
                size = min(end - done, self._affordable(step.size))
                yield replace(step, done=done, size=size, last=step.last and done + size == end)
                done += size

    def _affordable(self, size: int) -> int:
        if self.settings.timeout < 0 or self.settings.points == "sampler":
            return size
        busy = time.perf_counter() - self.started - self.compile_seconds - self.pilot_seconds
        rate = sum(self.accumulator.passes) / max(busy, 1e-3)
        return max(1, int(min(rate * 0.1 * self.settings.timeout, size)))

    def _pass(self, step: Step):
        first = not self.accumulator.passes and self._small is None
        for launch, batch in enumerate(batches(self.camera, step.done, step.size, self.settings)):
            if launch:
                self._wait()
            drawn = self._points(step, batch)
            with step_by_step(self.emitters.evaluated):
                counts = trace(self.kernel, Image(self.accumulator), batch, drawn, step.of)
            with dr.scoped_set_flag(dr.JitFlag.KernelHistory, True):
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
                self.compile_seconds += (entry["codegen_time"] + entry["backend_time"]) / 1000

    def report(self) -> PassReport:
        """Progress so far, for ``on_pass``."""
        seconds = time.perf_counter() - self.started
        return PassReport(sum(self.accumulator.passes), self.spp, seconds, sum(self._rays().values()))

    def _rays(self):
        rays = {name: self._counts[name] for name in RAYS}
        if self.accumulator.features is not None:  # one per camera sample
            rays["features"] = sum(self.accumulator.passes) * int(self.camera.region.size.prod())
        return rays

    def statistics(self) -> dict:
        """The render in numbers; plain values only."""
        connections = {name: self._counts[name] for name in ("evaluated", "zero", "rouletted")}
        connections["traced"] = self._counts["shadow_inner"]
        total = time.perf_counter() - self.started
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
            "passes": list(self.accumulator.passes),
            "non_finite": self._counts["non_finite"],
            "kernels": {"compiled": self.compiled, "cached": self.cached},
            **({"error": self.accumulator.error()} if self.settings.variance else {}),
            "peak_memory": int(dr.detail.malloc_watermark(dr.backend_v(mi.Float))),
        }


def _check_strategy_memory(depth: int, film):
    w, h = (int(x) for x in film.crop_size())
    # Six channels in double precision: those of a pass, of all passes and, while they are added, of both.
    needed = strategy_count(depth) * w * h * 6 * (8 + 16)
    if needed > STRATEGY_MEMORY:
        raise ValueError(
            f"bdpt: strategy_images at {w}x{h} with max_depth={depth} needs about "
            f"{needed / 2**30:.1f} GiB, more than {STRATEGY_MEMORY / 2**30:.0f} GiB; use a smaller "
            "film or max_depth"
        )


def _make_class():
    class BDPTIntegrator(mi.SamplingIntegrator):
        __doc__ = DOCUMENTATION

        def __init__(self, props):
            check_variant()
            settings = read_settings(props)
            super().__init__(props)
            self.settings = settings
            self.statistics = {}
            self.on_pass = None
            self._cancelled = False

        def cancel(self):
            """End the render that is running after its next pass, from ``on_pass`` or another thread."""
            self._cancelled = True

        @property
        def max_depth(self):
            depth = self.settings.max_depth
            return -1 if depth == UNLIMITED else depth

        @property
        def rr_depth(self):
            return self.settings.rr_depth

        def aov_names(self):
            settings = self.settings
            return layer_names(settings.strategy_depth, settings.variance, feature_names(settings.aovs))

        def render(self, scene, sensor=0, seed=0, spp=0, develop=True, evaluate=True):
            """Render ``scene``; see ``mi.Integrator.render`` for the arguments."""
            check_made_for(self, scene)
            sensor = _resolve(scene, sensor)
            spp = _samples(sensor, spp, self.settings)
            render = Render(scene, sensor, self.settings, seed, spp)
            try:
                self._cancelled = False
                render.run(self.on_pass, lambda: self._cancelled)
            finally:
                self.statistics = render.statistics()
            _log(self.statistics)
            film = sensor.film()
            if not develop:
                film.schedule_storage()
                result = mi.TensorXf()
            else:
                result = film.develop()
                dr.schedule(result)
            if evaluate:
                dr.eval()
                dr.sync_thread()
            return result

        def sample(self, *args, **kwargs):
            raise NotImplementedError(
                "bdpt: cannot be nested in another integrator (aov, moment, stokes): light subpaths "
                "reach pixels other than their own; render with bdpt itself, which has a parameter aovs"
            )

        def render_forward(self, *args, **kwargs):
            raise NotImplementedError(NO_DERIVATIVES)

        def render_backward(self, *args, **kwargs):
            raise NotImplementedError(NO_DERIVATIVES)

        def explain(self, scene, sensor=0, spp=None):
            """What will be done for ``scene`` and what is skipped, and why, as text; with ``spp`` also
            what the pilot of such a render finds."""
            check_made_for(self, scene)
            sensor = _resolve(scene, sensor)
            if spp is not None:
                spp = _samples(sensor, integer(spp, "spp", 0), self.settings)
            render = Render(scene, sensor, self.settings, 0, spp or 1)
            table = render.decide() if spp else []
            if self.settings.decisions:
                render.replay(0)
            return explain(render.world, render.plan, self.settings, table)

        def to_string(self):
            values = asdict(self.settings) | {"max_depth": self.max_depth}
            lines = "".join(f"  {k} = {v},\n" for k, v in values.items())
            return f"BDPTIntegrator[\n{lines}]"

    return BDPTIntegrator


NO_DERIVATIVES = (
    "bdpt: derivatives are not supported; use integrator type 'prb' or 'path' for render_forward "
    "and render_backward"
)


def _resolve(scene, sensor):
    if isinstance(sensor, mi.Sensor):
        return sensor
    if not is_index(sensor):
        raise TypeError(f"bdpt: sensor={sensor!r} must be an index or one of scene.sensors()")
    sensors = scene.sensors()
    if not sensors:
        raise ValueError("bdpt: the scene has no sensor; add one, for example of type perspective")
    if not 0 <= sensor < len(sensors):
        raise ValueError(f"bdpt: sensor={sensor} does not exist; the scene has {len(sensors)} sensor(s)")
    return sensors[int(sensor)]


def _samples(sensor, spp, settings) -> int:
    """Samples per pixel of a render that was asked for ``spp``."""
    spp = integer(spp, "spp", 0) or int(sensor.sampler().sample_count())
    if settings.variance and spp < REPLICATES:
        raise ValueError(
            f"bdpt: variance=True with spp={spp} is not possible; the variance needs at least {REPLICATES} "
            "samples per pixel, one for each independent part of the render"
        )
    if settings.points == "sampler":
        return _whole_sets(sensor.sampler().clone(), spp, REPLICATES if settings.variance else 1)
    return spp


def _whole_sets(sampler, spp: int, parts: int) -> int:
    """``spp``, rounded up so that each of ``parts`` (see `schedule`) is a number of samples that the
    sampler makes: stratified ones do not make any."""

    def made(count):
        sampler.set_sample_count(count)
        return int(sampler.sample_count())

    most = -(-spp // parts)
    if all(made(count) == count for count in {spp // parts, most}):
        return spp
    return parts * made(most)


def _log(statistics: dict):
    seconds = statistics["seconds"]
    mi.Log(
        mi.LogLevel.Info,
        f"bdpt: {sum(statistics['passes'])} spp in {seconds['total']:.2f} s "
        f"(compile {seconds['compile']:.2f} s); {json.dumps(statistics['rays'])}",
    )
    for made in statistics["decisions"]:
        mi.Log(mi.LogLevel.Info, f"bdpt: decided by a pilot: {json.dumps(made)}")
    if statistics.get("error") == math.inf:
        mi.Log(
            mi.LogLevel.Warn,
            "bdpt: the render ended before two of the parts that the variance follows from were whole; ask "
            "for no more samples per pixel than timeout allows",
        )
    if statistics["non_finite"]:
        mi.Log(
            mi.LogLevel.Warn,
            f"bdpt: {statistics['non_finite']} samples had no finite value and count as zero; look for "
            "infinities or NaN in textures, radiances and custom plugins",
        )


_classes = {}


def register():
    """Register the plugin ``bdpt`` for the current variant and for all that are set later."""

    def register_variant(old=None, new=None):
        variant = mi.variant()
        if variant is None or variant in _classes:
            return
        # Class bodies differ per variant: the base class object does.
        _classes[variant] = _make_class()
        mi.register_integrator("bdpt", lambda props, v=variant: _classes[v](props))

    mi.detail.add_variant_callback(register_variant)
    register_variant()
