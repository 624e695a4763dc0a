"""The integrator plugin ``bdpt``: its documentation and its class."""

from __future__ import annotations

from abc import ABCMeta
from collections.abc import Callable
from dataclasses import replace
from functools import wraps
from importlib import import_module
from typing import cast

import drjit as dr
import mitsuba as mi

from .emitters.light_groups import parsed
from .errors import UnsupportedError, UsageTypeError, did_you_mean
from .image.layers import film_layers
from .planning.explain import explain
from .properties import check_variant, integer, read_settings
from .run import messages
from .run.arguments import check_made_for, check_resumable, resolve_sensor, samples_per_pixel
from .run.rendering import PassReport, Render
from .run.snapshot import Snapshot
from .run.statistics import Statistics, statistics
from .settings import PARAMETERS, UNLIMITED, Settings, manual

DOCUMENTATION = f"""Bidirectional path tracer (plugin ``bdpt``).

Combines all strategies (s, t), with s light and t camera vertices, by multiple importance sampling (E. Veach,
"Robust Monte Carlo Methods for Light Transport Simulation", 1997, chapter 10).

{manual()}

Non-finite contributions count as zero; ``statistics["non_finite"]`` is their number, and a warning names the
parameters that hold such values. Other warnings name BSDFs that reflect more light than they receive, and
light that no strategy samples. Entries of ``statistics``: see `mitsuba_bdpt.Statistics`.

Layers of the film, in this order: colours and alpha, Stokes vectors, features, denoised colours, variance,
light groups, path layers, strategies.

Scalar and Metal variants, derivatives, renders under ``dr.freeze``, and ``layers`` but ``variance`` on a
``specfilm`` raise an error. With participating media edges count as in ``volpath``, and the medium that an
emitter declares is ignored, as by ``volpath``: it follows from the boundaries around the emitter. Threads
need a scene each, since Mitsuba's film belongs to it. ``explain`` lists the strategies that an emitter or
sensor lacks.
"""


def _without_gradients(method):
    """Suspend gradients within ``method``.

    Virtual calls also visit objects of other scenes, whose parameters may have gradients, and Dr.Jit cannot
    differentiate local memory.
    """

    @wraps(method)
    def undisturbed(*args, **kwargs):
        with dr.suspend_grad():
            return method(*args, **kwargs)

    return undisturbed


class BDPTIntegrator(metaclass=ABCMeta):
    """The integrator of ``mi.load_dict({"type": "bdpt", ...})``, in every variant.

    Lists the members beside those of ``mi.SamplingIntegrator``. Mitsuba's base class differs between
    variants, so each variant has its own class; ``isinstance`` accepts the objects of all of them.
    """

    settings: Settings
    """The parameters, a `mitsuba_bdpt.settings.Settings`."""
    statistics: Statistics
    """Of the last render; empty before the first."""
    on_pass: Callable[[PassReport], object] | None
    """``None``, or a function that is called after each pass."""
    part: int
    """Number of renders of other seeds that come before this one in an average of renders (0). The radius of
    merging goes on from theirs, so that the average converges."""

    def __init__(self, props: mi.Properties):
        check_variant()
        settings = read_settings(props)
        mi.SamplingIntegrator.__init__(self, props)
        self.settings = settings
        self.statistics = cast(Statistics, {})
        self.on_pass, self.part = None, 0
        self._cancelled = False
        # Of the last scene.
        self._light_groups, self._colours = tuple(parsed(settings.light_groups)), tuple("RGB")

    def __setattr__(self, name: str, value):
        """Set an attribute; raises ``AttributeError`` for parameters, and for names that do not exist."""
        exists = name.startswith("_") or name in {*vars(BDPTIntegrator), *BDPTIntegrator.__annotations__}
        if name in PARAMETERS or not (exists or type(self) not in _classes.values()):
            remedy = f"mi.load_dict({{'type': 'bdpt', {name!r}: {value!r}}})"
            if name not in PARAMETERS:
                remedy = f"{did_you_mean(name, PARAMETERS)}Parameters: {', '.join(PARAMETERS)}"
            raise AttributeError(
                f"bdpt: {name} cannot be set, and the render would not change: parameters are given when the "
                f"integrator is made; {remedy}"
            )
        mi.SamplingIntegrator.__setattr__(self, name, value)

    @property
    def max_depth(self) -> int:
        """The parameter ``max_depth``, -1 for unlimited."""
        depth = self.settings.max_depth
        return -1 if depth == UNLIMITED else depth

    @_without_gradients
    def render(
        self,
        scene: mi.Scene,
        sensor: int | mi.Sensor = 0,
        seed: int = 0,
        spp: int = 0,
        develop: bool = True,
        evaluate: bool = True,
        start: Snapshot | None = None,
    ) -> mi.TensorXf:
        """Render an image; arguments as ``mi.Integrator.render``, and ``start``.

        ``start``: a snapshot of the same scene from which the render continues. The image is that of the
        uninterrupted render up to rounding. Raises ``UsageError`` and ``UnsupportedError``.
        """
        if self.on_pass is not None and not callable(self.on_pass):
            raise UsageTypeError(f"on_pass={self.on_pass!r} must be None or a function of a PassReport")
        if start is not None:
            check_resumable(start)
        render = self._new_render(scene, sensor, seed, spp, start)
        if start is not None:
            render.resume(start)
        messages.warn_of_scene(render.prepared, render.findings, self.settings)
        try:
            self._cancelled = False
            if not render.passes:
                render = render.decided()
            render.run(self.on_pass, lambda: self._cancelled)
        finally:
            self.statistics = statistics(render)
            messages.warn_of_non_finite(self.statistics, scene)
        messages.log(self.statistics)
        self.statistics["unsampled_light"] = render.unsampled_light()
        return _result(render.sensor.film(), develop, evaluate)

    def _new_render(
        self, scene: mi.Scene, sensor: int | mi.Sensor, seed: int, spp: int, start: Snapshot | None = None
    ) -> Render:
        """Check the arguments and prepare a render, with the ``merging`` of the snapshot ``start``."""
        check_made_for(self, scene)
        sensor = resolve_sensor(scene, sensor)
        spp = samples_per_pixel(sensor, spp, self.settings)
        render = self._made(Render(scene, sensor, self._settings_of(start), seed, spp))
        render.part = integer(self.part, "part", 0)
        return render

    def _settings_of(self, start: Snapshot | None) -> Settings:
        """The parameters, with the ``merging`` of the snapshot ``start`` where it is ``auto``."""
        if start is None or self.settings.merging != "auto":
            return self.settings
        return replace(self.settings, merging=start.identity.get("merging") is True)

    def _made(self, render: Render) -> Render:
        self._colours = render.accumulator.colour.names
        if render.light_groups is not None:
            self._light_groups = render.light_groups.names
        return render

    def cancel(self):
        """Stop the render after its current pass; called by ``on_pass`` or another thread."""
        self._cancelled = True

    @_without_gradients
    def explain(self, scene: mi.Scene, sensor: int | mi.Sensor = 0, spp: int | None = None) -> str:
        """Describe which strategies a render of ``scene`` uses and skips, and why.

        With ``spp``, the pilot of such a render runs and the text includes its result.
        """
        check_made_for(self, scene)
        sensor = resolve_sensor(scene, sensor)
        if spp is not None:
            spp = samples_per_pixel(sensor, integer(spp, "spp", 0), self.settings)
        render = Render(scene, sensor, self.settings, 0, spp or 1)
        if spp:
            render = render.decided()
        planner, missing = render.planner, render.missing() if spp else None
        about = f"{missing.cause}; {missing.remedy}" if missing else ""
        text = explain(planner, f"merging: {render.why_merged}" if render.plan.merging else about)
        if render.light_groups is not None:
            text = "\n".join([text, *render.light_groups.explained()])
        if spp is None:
            return (
                f"{text}\nno spp given: this is the plan before the pilot; with spp=..., it may become "
                "another, with guided emission or merging, and unsampled light is estimated"
            )
        no_pilot = planner.decided.no_pilot or planner.settled()[0]
        return text if planner.table else f"{text}\nno pilot: {no_pilot}"

    @_without_gradients
    def decide(self, scene: mi.Scene, sensor: int | mi.Sensor = 0, seed: int = 0, spp: int = 0) -> list[dict]:
        """Run the pilot alone and return its decisions, as in ``statistics["decisions"]``.

        Empty where neither a pilot nor the scene decides; ``statistics["no_pilot"]`` has the reason.
        Decisions do not depend on ``seed``.
        """
        render = self._new_render(scene, sensor, seed, spp).decided()
        self.statistics = statistics(render)
        messages.warn_of_non_finite(self.statistics, scene)
        return [decision.record() for decision in render.planner.decided.decisions]

    @_without_gradients
    def assemble(
        self,
        snapshot: Snapshot,
        scene: mi.Scene,
        sensor: int | mi.Sensor = 0,
        develop: bool = True,
        evaluate: bool = True,
    ) -> mi.TensorXf:
        """Return the image of a snapshot, as `render` would.

        The snapshot may be merged from several (`Snapshot.joined`) of integrators with equal parameters.
        """
        check_made_for(self, scene)
        if not isinstance(snapshot, Snapshot):
            raise UsageTypeError(f"snapshot={type(snapshot).__name__} must be one from a PassReport")
        sensor = resolve_sensor(scene, sensor)
        render = self._made(Render(scene, sensor, self._settings_of(snapshot), 0, 1))
        render.resume(snapshot, apart_from=("seed", "spp", "part"))
        render.accumulator.finish()
        self.statistics = statistics(render)
        messages.warn_of_non_finite(self.statistics, scene)
        self.statistics["unsampled_light"] = render.unsampled_light()
        return _result(render.sensor.film(), develop, evaluate)

    def aov_names(self) -> list[str]:
        """Return the names of the film's layers beside colours and alpha.

        Groups of ``light_groups=auto``, the group ``rest`` and the bands of a ``specfilm`` are known from the
        first render on.
        """
        return film_layers(self.settings, self._colours, self._light_groups)

    def sample(self, *args, **kwargs):
        """Not supported; raises ``UnsupportedError``."""
        raise UnsupportedError(
            "cannot be nested in another integrator (aov, moment, stokes): light subpaths contribute to "
            "pixels other than their own; render with bdpt itself and its parameters aovs and layers "
            "(variance for moment, stokes); --integrator bdpt of the command takes aov and stokes over"
        )

    def render_forward(self, *args, **kwargs):
        """Not supported; raises ``UnsupportedError``."""
        raise UnsupportedError(
            "derivatives are not supported; use integrator type 'prb' or 'path' for render_forward and "
            "render_backward"
        )

    render_backward = render_forward

    def to_string(self) -> str:
        """Return the parameters, one per line."""
        values = {name: getattr(self.settings, name) for name in PARAMETERS}
        values |= {"max_depth": self.max_depth, "layers": ",".join(self.settings.layers)}
        lines = "".join(f"  {k} = {v},\n" for k, v in values.items())
        return f"BDPTIntegrator[\n{lines}]"


def _result(film, develop: bool, evaluate: bool) -> mi.TensorXf:
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


_classes = {}


def _class_of_variant():
    """Return the plugin's class for the current variant, whose base class allows no second one."""
    apart = ("__dict__", "__weakref__", "__abstractmethods__", "_abc_impl")
    own = {k: v for k, v in vars(BDPTIntegrator).items() if k not in apart} | {"__doc__": DOCUMENTATION}
    made = type(mi.SamplingIntegrator)("BDPTIntegrator", (mi.SamplingIntegrator,), own)
    return BDPTIntegrator.register(made)


def register():
    """Register ``bdpt`` for this and later variants, and scalar_rgb, where the parser queries types."""

    def register_variant(old=None, new=None):
        variant = mi.variant()
        if variant is None or variant in _classes:
            return
        _classes[variant] = _class_of_variant()
        mi.register_integrator("bdpt", lambda props, v=variant: check_variant(v) or _classes[v](props))

    scalar = import_module("mitsuba.scalar_rgb")
    scalar.register_integrator("bdpt", lambda props: check_variant("scalar_rgb"))
    mi.detail.add_variant_callback(register_variant)
    register_variant()
