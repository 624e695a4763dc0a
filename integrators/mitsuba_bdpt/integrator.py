"""The integrator plugin ``bdpt``: its manual, its class, what it logs."""

from __future__ import annotations

import json
import math
from dataclasses import asdict
from functools import wraps

import drjit as dr
import mitsuba as mi

from .emitters.kinds import third_party_elsewhere
from .errors import UnsupportedError, UsageError, UsageTypeError
from .host.introspection import all_shapes, is_instance, named
from .host.notices import warn_once
from .image.features import feature_names
from .image.layers import layer_names
from .parameters import check_made_for, check_variant, integer, is_index, read_settings
from .planning.budget import is_open
from .planning.explain import explain
from .run.rendering import Render
from .run.schedule import REPLICATES
from .run.snapshot import Snapshot
from .run.statistics import statistics
from .scene.diagnostics import narrow_spots, non_conserving_bsdfs, not_finite
from .settings import UNLIMITED

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
     small contributions by unbiased roulette; ``auto`` (default) does so too and, in renders of 2^14
     samples or more (2^22 in scenes of ten BSDFs or more), asks a pilot what pays, or the scene alone where
     that tells (see `choice`); ``none`` does everything. What a pilot finds is remembered for later renders
     of the scene, until its parameters are edited.
 * - light_paths
   - |string| or |float|
   - Light subpaths per camera subpath: ``auto`` (default: what the pilot chooses; without one 1/4, but 1 on
     films of fewer than 64 pixels and 0 under an even sky; with ``skip=none`` 1), 0, 1, 1/2, 1/4, 1/8 or
     1/16. One light subpath serves camera subpaths of different pixels. Given by hand, there is no pilot.
 * - connections
   - |string|
   - Inner connections per camera vertex: ``all``, ``one`` (drawn by its unshadowed contribution),
     ``none``, or ``auto`` (default: what the pilot chooses; without one ``one``, but ``none`` under an even
     sky; with ``skip=none`` ``all``). Given by hand, there is no pilot.
 * - points
   - |string|
   - ``sobol`` (default): Owen-scrambled Sobol' points for all draws that gain by them, at every vertex;
     ``sampler``: the scene's sampler for a path's first draws; ``independent``.
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
 * - until_error
   - |float|
   - Stop when the estimate of the relMSE is this or less; needs ``variance``. It is looked at after 32
     samples per pixel, 64, 128, …; ``spp`` is the most that is spent. An estimate that is too small by
     chance ends a render too early: see docs/long_renders.md for by how much. (Default: 0, never)
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

Values that are not finite, of textures or of plugins of yours, do not enter the image: a contribution that
is NaN or infinite, or whose weight does not follow from densities that are, counts as zero in a sample that
counts like any other, so that the rest of the image is as if it were zero in truth.
``statistics["non_finite"]`` counts them, ``statistics["non_finite_in_pilot"]`` those of the pilots, which
decide from the rest, and one message of Mitsuba's log (``Warn``) after the render names the parameters that
hold such numbers. One before the first render of a scene names BSDFs that reflect more light than they
receive; one after it the lamps without area of whose light more than a hundredth of the image's is missing,
because they shine through glass on what is seen through glass. ``statistics["lost_light"]`` has the estimated
shares by the number of the emitter; what is lost is estimated at the first render, and again after edits.

Layers of the film come in this order: colours and alpha, features, variance, strategies.

``statistics["decisions"]`` is what the pilot chose, ``statistics["no_pilot"]`` why none was asked, or none
decided: an empty text where one did, and where ``decisions`` were given. ``statistics["pilots"]``: how many
were asked, and of how many it was remembered what they found. They draw the same numbers for all seeds, so
that all renders of a scene decide alike.

Attributes: ``statistics``, a dictionary about the last render; ``on_pass``, ``None`` or a function
that is called with a `rendering.PassReport` after each pass.

Not supported, and refused in words: scalar, polarized and Metal variants, participating media (also in shape
groups; a medium that an emitter lies in is ignored, as by ``volpath``), derivatives
(all other methods of ``integrator`` ignore gradients), renders under ``dr.freeze``, ``strategy_images`` on a
``specfilm``. Threads need a
scene each: Mitsuba's film belongs to it. Emitters and sensors of every kind take part; where one cannot
have a strategy (a sensor of a class that is not Mitsuba's has no t = 1), it is skipped, and ``explain``
says so.
"""


def _without_gradients(method):
    """``method``, undisturbed by parameters with gradients, be they of other scenes: virtual calls visit
    these too, and Dr.Jit cannot differentiate local memory."""

    @wraps(method)
    def undisturbed(*args, **kwargs):
        with dr.suspend_grad():
            try:
                return method(*args, **kwargs)
            except RuntimeError as error:
                if not isinstance(error, NotImplementedError):  # refusals, which say all
                    _hint_at_others(error, (*args, *kwargs.values()))
                raise

    return undisturbed


def _hint_at_others(error: RuntimeError, arguments):
    """Say with an ``error`` that it may come from the emitter of a scene that is not among ``arguments``."""
    scene = next((value for value in arguments if isinstance(value, mi.Scene)), None)
    count = third_party_elsewhere(scene) if scene is not None else 0
    if count:
        error.add_note(
            f"bdpt: other scenes in this process have {count} foreign emitters, of plugins not "
            "Mitsuba's, which its calls visit too: if the error is theirs, delete those scenes first"
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

        @_without_gradients
        def render(self, scene, sensor=0, seed=0, spp=0, develop=True, evaluate=True, start=None):
            """Render ``scene``; see ``mi.Integrator.render`` for the arguments. ``start``: a
            `snapshot.Snapshot` of ``PassReport.snapshot`` to go on from, of the same scene; the image is
            that of the uninterrupted render up to rounding."""
            check_made_for(self, scene)
            sensor = _resolve(scene, sensor)
            spp = _samples(sensor, spp, self.settings)
            render = Render(scene, sensor, self.settings, seed, spp)
            if start is not None:
                _check_resumable(start, self.settings)
                render.resume(start)
            _warn_of_suspects(scene, sensor)
            try:
                self._cancelled = False
                render.run(self.on_pass, lambda: self._cancelled)
            finally:
                self.statistics = statistics(render)
                _warn_of_what_was_lost(self.statistics, scene)
            _log(self.statistics)
            self._look_for_lost_light(render)
            _warn_of_decisions_not_begun(self.settings.decisions, len(self.statistics["passes"]))
            return _result(sensor.film(), develop, evaluate)

        @_without_gradients
        def decide(self, scene, sensor=0, seed=0, spp=0):
            """What the pilot of such a render chooses, as in ``statistics["decisions"]``: an empty list
            without a pilot, about which ``statistics["no_pilot"]`` says why. The parameter ``decisions`` of
            other renders of the scene takes it as JSON. All ``seed``s decide alike."""
            check_made_for(self, scene)
            sensor = _resolve(scene, sensor)
            render = Render(scene, sensor, self.settings, seed, _samples(sensor, spp, self.settings))
            render.decide()
            self.statistics = statistics(render)
            _warn_of_what_was_lost(self.statistics, scene)
            return [decision.record() for decision in render.planner.decided.decisions]

        @_without_gradients
        def assemble(self, snapshot, scene, sensor=0, develop=True, evaluate=True):
            """The image of a snapshot, also of several that were joined (`Snapshot.joined`), traced by
            this integrator or one with the same parameters; what `render` would have returned."""
            check_made_for(self, scene)
            sensor = _resolve(scene, sensor)
            render = Render(scene, sensor, self.settings, 0, 1)
            render.resume(snapshot, apart_from=("seed", "spp", "decisions"))
            render.accumulator.finish()
            self.statistics = statistics(render)
            _warn_of_what_was_lost(self.statistics, scene)
            self._look_for_lost_light(render)
            return _result(sensor.film(), develop, evaluate)

        def _look_for_lost_light(self, render):
            """Say once, and put into the statistics, what light no strategy in use finds."""
            shares, text = render.lost_light()
            self.statistics["lost_light"] = shares
            if text:
                about = "lost light", render.plan.splat, render.plan.direct
                warn_once(render.prepared.scene, render.sensor, text, about)

        def sample(self, *args, **kwargs):
            raise UnsupportedError(
                "cannot be nested in another integrator (aov, moment, stokes): light subpaths "
                "reach pixels other than their own; render with bdpt itself, which has a parameter aovs "
                "(the command's --integrator bdpt takes layers of aov over)"
            )

        def render_forward(self, *args, **kwargs):
            raise UnsupportedError(NO_DERIVATIVES)

        def render_backward(self, *args, **kwargs):
            raise UnsupportedError(NO_DERIVATIVES)

        @_without_gradients
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
                render.replay()
            planner = render.planner
            certainty = planner.certainty(render.passes) if table else 0.0
            text = explain(
                render.prepared, render.plan, self.settings, table, certainty, planner.lost_by_pilots()
            )
            if spp is None and is_open(render.plan, self.settings):
                return f"{text}\nspp not given: a render may leave out more, by the scene or a pilot"
            return text if table or spp is None else f"{text}\n{planner.why_no_pilot()}"

        def to_string(self):
            values = asdict(self.settings) | {"max_depth": self.max_depth}
            lines = "".join(f"  {k} = {v},\n" for k, v in values.items())
            return f"BDPTIntegrator[\n{lines}]"

    return BDPTIntegrator


def _check_resumable(start, settings):
    if not isinstance(start, Snapshot):
        raise UsageTypeError(f"start={type(start).__name__} must be a snapshot from a PassReport")
    if not start.progress.whole:
        raise UsageError("start=... was joined or reduced for joining; only assemble() can use it")
    if settings.points == "sampler":
        raise UsageError(
            "start with points=sampler is not possible: a scene's sampler cannot start in the middle "
            "of its samples; use points=sobol"
        )


# Culprits that a message names, at most.
NAMED = 5

NO_DERIVATIVES = (
    "derivatives are not supported; use integrator type 'prb' or 'path' for render_forward "
    "and render_backward"
)


def _result(film, develop: bool, evaluate: bool):
    """What ``mi.Integrator.render`` returns."""
    if develop:
        result = film.develop()
        dr.schedule(result)
    else:
        film.schedule_storage()
        result = mi.TensorXf()
    if evaluate:
        dr.eval()
        dr.sync_thread()
    return result


def _resolve(scene, sensor):
    if isinstance(sensor, mi.Sensor):
        return sensor
    if not is_index(sensor):
        raise UsageTypeError(f"sensor={sensor!r} must be an index or one of scene.sensors()")
    sensors = scene.sensors()
    if not sensors:
        raise UsageError("the scene has no sensor; add one, for example of type perspective")
    if not 0 <= sensor < len(sensors):
        raise UsageError(f"sensor={sensor} does not exist; the scene has {len(sensors)} sensor(s)")
    return sensors[int(sensor)]


def _samples(sensor, spp, settings) -> int:
    """Samples per pixel of a render that was asked for ``spp``."""
    spp = integer(spp, "spp", 0) or int(sensor.sampler().sample_count())
    if not spp:
        raise UsageError(
            f"spp=0 stands for the sample_count of the sampler of sensor {named(sensor)}, which is 0 "
            "too; set one of them to 1 or more"
        )
    if settings.variance and spp < REPLICATES:
        raise UsageError(
            f"variance=True with spp={spp} is not possible; the variance needs at least {REPLICATES} "
            "samples per pixel, one for each independent part of the render"
        )
    if settings.points == "sampler":
        return _whole_sets(sensor.sampler().clone(), spp, REPLICATES if settings.variance else 1)
    return spp


def _whole_sets(sampler, spp: int, parts: int) -> int:
    """``spp``, rounded up so that each of ``parts`` (see `schedule.schedule`) is a number of samples that the
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
    if statistics["no_pilot"]:
        mi.Log(mi.LogLevel.Info, f"bdpt: no pilot: {statistics['no_pilot']}")
    for made in statistics["decisions"]:
        mi.Log(mi.LogLevel.Info, f"bdpt: decided: {json.dumps(made)}")
    for left_out in statistics["skipped"]:
        mi.Log(mi.LogLevel.Info, f"bdpt: skipped: {json.dumps(left_out)}")
    if statistics.get("error") == math.inf:
        mi.Log(
            mi.LogLevel.Warn,
            "bdpt: the render ended before four of the parts that the error follows from were whole; ask "
            "for no more samples per pixel than timeout allows",
        )


def _warn_of_suspects(scene, sensor):
    """Say once what in the ``scene`` spoils images."""
    bright = non_conserving_bsdfs([shape for shape in all_shapes(scene) if not is_instance(shape)])
    narrow = narrow_spots(scene)
    if bright:
        warn_once(
            scene,
            sensor,
            f"bdpt: {_some(bright)}: more light returns than arrives, and where it cannot "
            "leave the image has no limit as max_depth grows; keep such parameters at 1 or below",
        )
    if narrow:
        warn_once(
            scene,
            sensor,
            f"bdpt: {_some(narrow)}: Mitsuba rounds how the light falls off across so narrow a cone, with "
            "every integrator, and strategies do not agree about it; make it 0.2 degrees or more",
        )


def _some(found: list[str]) -> str:
    """The first `NAMED` of them, and how many more there are."""
    more = f" and {len(found) - NAMED} more" if len(found) > NAMED else ""
    return ", ".join(found[:NAMED]) + more


def _warn_of_decisions_not_begun(decisions, passes: int):
    """Say which of the ``decisions`` that were given are for a pass that the render of so many did not
    have."""
    late = [decision.first_pass for decision in decisions or () if decision.first_pass >= passes]
    if late:
        mi.Log(
            mi.LogLevel.Warn,
            f"bdpt: decisions from pass {', '.join(map(str, late))} on never began: the render had passes "
            f"0 to {passes - 1}",
        )


def _warn_of_what_was_lost(statistics: dict, scene):
    """Say how many values were not finite, and in what parameters of the scene to look for the cause; of each
    render, since it is about its image."""
    lost, in_pilot = statistics["non_finite"], statistics["non_finite_in_pilot"]
    if not (lost or in_pilot):
        return
    parts = [f"{lost} values were not finite and count as zero"]
    if in_pilot:
        parts.append(f"so did {in_pilot} of the pilot, which decided from the rest")
    named = not_finite(scene)
    parts.append(
        f"NaN or infinity is in {_some(named)}"
        if named
        else "no parameter of the scene holds NaN or infinity: look into its plugins, your own first"
    )
    mi.Log(mi.LogLevel.Warn, f"bdpt: {'; '.join(parts)}")


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
