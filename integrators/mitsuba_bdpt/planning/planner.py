"""Decides how a render proceeds: by parameters, by the scene alone, or by a pilot."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace
from typing import Any

import drjit as dr
import mitsuba as mi

from .. import components
from ..host.jit import evaluated_mode, gc_paused
from ..host.llvm import quick_compilation
from ..sampling.sequences import PILOT, sequence_seed
from ..scene.prepared import PreparedScene
from ..settings import Settings
from ..transport.plan import JOINED
from . import budget, choice, pilot, unsampled_light
from .configuration import LEFT_OUT, Decision, candidates, not_worth, without_pilot
from .findings import SceneCache
from .moments import GuidableLight
from .possible import plan

# Least samples and pixels of a render whose camera subpaths may connect with several light subpaths, drawn by
# an approximation (`connections`). Not with transmissive BSDFs, which the approximation does not cover, nor
# where rays test small shapes; with LLVM only, as lanes need four times the local memory. See experiments,
# "Several light subpaths per lane".
JOINED_SAMPLES, JOINED_PIXELS = 1 << 16, 1 << 10

# Variance of guidable light over that of all other light from which on it may change the choice.
MATTERS = 0.1


@dataclass(frozen=True)
class PlannerState:
    """Decisions of a render so far; part of its progress.

    ``left_out``: what the last of ``decisions`` leaves out, as in ``statistics["skipped"]``; ``no_pilot``:
    why no pilot ran or decided; ``pilot``: ``rendered``, ``cached`` or empty; ``non_finite``: see `Moments`.
    """

    decisions: tuple[Decision, ...] = ()
    left_out: tuple[dict[str, str], ...] = ()
    no_pilot: str = ""
    pilot: str = ""
    non_finite: int = 0


# Result of a pilot: predictions, the best first, what the best leaves out, arguments of `choice.confidence`.
_Result = tuple[list[choice.Prediction], list[dict[str, str]], tuple[Any, ...]]


class Planner:
    """The ``plan`` of one render of ``spp`` samples per pixel, and its decisions.

    ``is_open``: light that it lacks may make it merge; ``full``: the plan before any decision; ``threshold``
    of roulette in units of the image, None before a decision; ``decided``: saved with the render; ``table``:
    predictions of the pilot, the best first; ``measured``: arguments of `choice.confidence`.
    """

    # The same for all seeds of a render, so that all decide alike.
    pilot_seed = 30

    def __init__(
        self, prepared: PreparedScene, settings: Settings, spp: int, findings: SceneCache, is_open: bool
    ):
        self.prepared, self.settings, self._findings, self._is_open = prepared, settings, findings, is_open
        self._pixels = int(prepared.camera.region.size.prod())
        self._samples = budget.expected_samples(settings, spp * self._pixels)
        self.full = plan(prepared, settings)
        joined = JOINED[-1] if self._is_worth_joining() else 1
        self.full = self.plan = budget.first_plan(self.full, prepared, settings, self._pixels, joined)
        self.threshold, self.decided = None, PlannerState()
        self.table: list[choice.Prediction] = []
        self.measured: tuple[Any, ...] = ()

    def begin(self) -> bool:
        """Adopt what is given or the scene alone decides; returns whether a pilot is to run."""
        for given in self.settings.internals.decisions or ():
            self.adopt(given, ())
        settled, decision = self.settled()
        if self.settings.internals.decisions is None:
            self.decided = replace(self.decided, no_pilot=settled)
        if decision:
            self.adopt(decision, LEFT_OUT)
        return not settled

    def run_pilot(self) -> list[choice.Prediction]:
        """Run a pilot and adopt its decision; returns its ``table``."""
        key = self.settings, self._is_open, self.pilot_seed, self._samples, self._pixels, JOINED
        result, is_known = self._findings.find("results", key, self._piloted)
        self.table, left_out, self.measured = result
        moments = self.measured[0]
        # Directly seen emission is the same for all candidates.
        why = "the pilot found no light but that of emitters which the sensor sees directly"
        if moments.non_finite:
            why = "the pilot found only invalid samples (NaN or infinite)"
        ran, why = "cached" if is_known else "rendered", "" if self.table else why
        self.decided = replace(self.decided, pilot=ran, non_finite=moments.non_finite, no_pilot=why)
        for best in self.table[:1]:
            values = {"cost": best.cost, "variance": best.variance, "mean": moments.mean}
            self.adopt(Decision.of(best.candidate, **values), left_out)
        return self.table

    @quick_compilation()
    def _piloted(self) -> _Result:
        """Result of a pilot whose samples leave out the light that photons can guide.

        Other strategies sample near-specular paths too: where guiding is not chosen and this light matters, a
        second pilot includes it.
        """
        prepared, full, guidable = self.prepared, self.full, None
        # Its gain is predicted where that takes little of the render.
        is_short = self._samples < budget.GUIDING_TIMES * budget.least_samples(prepared)
        predicts = full.merging or not (prepared.traits.dispatch.many and is_short)
        if full.guidable and predicts and not components.why_absent("merging"):
            merges = self._is_open and not components.merging.why_not(prepared.camera.sensor)
            fewest = unsampled_light.FEWEST_HITS if merges else 0
            spp = self._samples // self._pixels
            guidable = unsampled_light.guidable(prepared, full, self.settings, spp, fewest)
        table, left_out, measured = found = self._of_pilot(guidable)
        if guidable is None or not prepared.near_specular or not table:
            return found
        if table[0].candidate.guided or measured[0].guidable[0] < MATTERS * table[0].variance:
            return found
        table, _, measured = self._of_pilot(None)
        return table, left_out, measured

    def _of_pilot(self, guidable: GuidableLight | None) -> _Result:
        prepared, full, samples = self.prepared, self.full, self._samples
        count = min(max(int(samples * budget.PILOT_SHARE), budget.LEAST_LANES), budget.MOST_LANES)
        seed = sequence_seed(mi.UInt32(self.pilot_seed), PILOT)
        flag = dr.scoped_set_flag(dr.JitFlag.KernelHistory, True)
        with gc_paused(), flag, evaluated_mode(prepared.emitters.evaluated):
            moments = pilot.measure(prepared, full, self.settings, seed, count, samples / count, guidable)
        least = unsampled_light.WARN_SHARE * moments.mean
        rare = guidable is not None and not full.guided and guidable.rare.sum() >= least
        if rare:  # hits by guided directions are fireflies: `merging=auto` decides
            moments = replace(moments, guidable=(0.0, 0.0))
        learnt = None
        if moments.emission is not None:
            component, counts = components.guided_emission, prepared.emitters.tables
            learnt = component.learn(moments.emission, component.side_of(sum(counts)), counts)
        joins = self._is_worth_joining()
        possible = [c for c in candidates(prepared, full, self.settings) if c.joined == 1 or joins]
        # No table where the pilot saw no light, or NaN.
        table = choice.choose(moments, possible, samples, learnt) if moments.mean > 0 else []
        if full.guided:  # whatever it costs
            table = [row for row in table if row.candidate.guided] or table
        left_out = choice.left_out(table, "merging" if full.merging else "guided s=0")
        if full.guidable and not full.guided and (rare or guidable is None):
            short = "with so many BSDFs the render is too short to predict its gain"
            why = "rays hardly ever hit the emitters of a part of the light" if rare else short
            left_out.append(not_worth("guided s=0", why))
        if learnt and table and table[0].candidate.emission is None:
            left_out += components.guided_emission.left_out(learnt)
        return table, left_out, (moments, possible, samples, learnt)

    def _is_worth_joining(self) -> bool:
        """Whether several light subpaths per lane pay, if they are few."""
        dispatch = self.prepared.traits.dispatch  # the approximation calls every BSDF five times more
        least = JOINED_SAMPLES + (budget.SAMPLES_PER_BSDF * dispatch.count if dispatch.many else 0)
        return (
            self._samples >= least
            and self._pixels >= JOINED_PIXELS
            and not self.prepared.traits.transmits
            and dr.backend_v(mi.Float) == dr.JitBackend.LLVM
            and self.prepared.space is None
            and not (self.full.merging or self.prepared.emitters.shape_errors.small)
        )

    def adopt(self, decision: Decision, left_out: Iterable[dict[str, str]]):
        """Plan as decided from now on."""
        decisions = (*self.decided.decisions, decision)
        self.decided = replace(self.decided, decisions=decisions, left_out=tuple(left_out))
        self.threshold, self.plan = decision.threshold, decision.plan(self.full)

    def restore(self, decided: PlannerState):
        """Resume from the decisions of an earlier part of the render."""
        for decision in decided.decisions:
            self.adopt(decision, decided.left_out)
        self.decided = decided

    def settled(self) -> tuple[str, Decision | None]:
        """Why no pilot runs (empty if one does), and the decision without one."""
        if fixed := budget.fixed_by(self.settings):
            return f"nothing to choose with {' and '.join(fixed)}", None
        if not self.full.light:
            return "no light subpaths are possible", None
        if self._pixels < budget.FEW_PIXELS:
            return f"the film has fewer than {budget.FEW_PIXELS} pixels", None
        if decision := without_pilot(self.prepared, self.full, self.settings, self._samples):
            return "the scene alone decides in a render as short as this", decision
        least = budget.least_samples(self.prepared)
        if self._samples < least:
            return f"the render has {self._samples} samples, a pilot needs {least}", None
        return "", None
