"""Decides how a render proceeds: by parameters, by the scene alone, or by pilots."""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, NamedTuple

import drjit as dr
import mitsuba as mi

from .. import components
from ..host.jit import evaluated_mode, gc_paused
from ..sampling.sequences import PILOT, sequence_seed
from ..scene.prepared import PreparedScene
from ..settings import Settings
from ..transport.plan import JOINED, EmissionTables
from . import budget, choice, pilot
from .candidates import LEFT_OUT, candidates, without_pilot
from .configuration import Decision, not_worth, replayed
from .findings import SceneCache
from .moments import Moments
from .possible import may_join, plan

if TYPE_CHECKING:
    from ..guided_emission import Learnt

# Least samples and pixels of a render whose camera subpaths may connect with several light subpaths, drawn by
# an approximation (`connections`). Not with transmissive BSDFs, which the approximation does not cover, and
# only with LLVM: lanes need four times the local memory. See experiments, "Several light subpaths per lane".
JOINED_SAMPLES, JOINED_PIXELS = 1 << 16, 1 << 10

# Why s = 0 is not guided where its gain was not predicted, as in ``statistics["skipped"]``.
UNMEASURED = not_worth(
    "guided s=0", "with so many BSDFs the render is too short for the kernels that would predict its gain"
)

# Why a pilot decides nothing. Directly seen emission is the same for all candidates.
SAW_NOTHING = "the pilot found no light but that of emitters which the sensor sees directly"
NOT_FINITE = "the pilot found only invalid samples (NaN or infinite)"


class Pilots(NamedTuple):
    """Number of pilots that were requested; ``cached``: those with cached results."""

    requested: int = 0
    cached: int = 0


@dataclass(frozen=True)
class PlannerState:
    """Decisions of a render so far; part of its progress.

    ``left_out``: what the last of ``decisions`` leaves out, as in ``statistics["skipped"]``; ``no_pilot``:
    why no pilot ran or decided; ``moments`` of the pilot.
    """

    decisions: tuple[Decision, ...] = ()
    left_out: tuple[dict[str, str], ...] = ()
    no_pilot: str = ""
    moments: Moments | None = None
    pilots: Pilots = Pilots()


@dataclass(frozen=True)
class _Result:
    """Result of a pilot.

    ``table`` of predictions, the best first, and what the best leaves out; ``moments`` that they follow from,
    and those of the pilot ``with_tables`` of emission, if one ran; number of pilots ``requested``.
    """

    table: tuple[choice.Prediction, ...]
    left_out: tuple[dict[str, str], ...]
    moments: Moments
    with_tables: Moments | None
    requested: int


class Planner:
    """The ``plan`` of one render of ``spp`` samples per pixel, and its decisions.

    ``full``: the plan before any decision; ``threshold`` of roulette in units of the image, None before a
    decision; ``decided``: saved with the render.
    ``passes``: samples per pixel of each finished pass.
    """

    # The same for all seeds of a render, so that all decide alike. The most efficient of 32.
    pilot_seed = 30

    def __init__(self, prepared: PreparedScene, settings: Settings, spp: int, findings: SceneCache):
        self._prepared, self._settings, self._spp, self._findings = prepared, settings, spp, findings
        self._pixels = int(prepared.camera.region.size.prod())
        self.full = plan(prepared, settings)
        joined = JOINED[-1] if self._is_worth_joining(self._expected(())) else 1
        self.full = self.plan = budget.first_plan(self.full, prepared, settings, self._pixels, joined)
        self.threshold, self.decided = None, PlannerState()
        # Moments of the newest pilot with tables of emission.
        self._with_tables: Moments | None = None

    def begin(self, passes: tuple[int, ...]) -> bool:
        """Adopt what is given or the scene alone decides, before the first pass.

        Returns whether a pilot is to run.
        """
        for given in self._settings.internals.decisions or ():
            self.adopt(given, replayed(given))
        settled, decision = self._settled(passes)
        if not passes and self._settings.internals.decisions is None:
            self.decided = replace(self.decided, no_pilot=settled)
        if decision and not passes:
            self.adopt(decision, LEFT_OUT)
        return not settled

    def run_pilot(self, passes: tuple[int, ...]) -> list[choice.Prediction]:
        """Run a pilot and adopt its decision; returns its predictions, the best first."""
        samples = self._expected(passes)
        key = self._settings, self.pilot_seed, samples, self._pixels, JOINED
        result, is_known = self._findings.find("results", key, lambda: self._result(samples))
        if is_known:
            pilots = Pilots(result.requested, cached=result.requested)
            self.decided = replace(self.decided, pilots=pilots, moments=result.moments)
            self._with_tables = result.with_tables
        if result.table:
            self.adopt(result.table[0].decided(result.moments.mean), result.left_out)
        self.decided = replace(self.decided, no_pilot="" if self.decided.decisions else self._why_undecided())
        return list(result.table)

    def _result(self, samples: int) -> _Result:
        """Result of a pilot."""
        moments = self._measured(samples)
        self.decided = replace(self.decided, moments=moments)
        alternatives, left_out = self._alternatives(samples), ()
        table = choice.choose(moments, alternatives)
        if not moments.mean > 0:  # the pilot saw no light, or NaN
            table = []
        if table:
            table, learnt = self._with_guided_emission(table, moments, samples)
            gain = choice.guided_gain(moments, alternatives, table)
            name = "merging" if self.full.merging else "guided s=0"
            unguided = table[0].candidate.emission is None
            left_out = (
                *choice.left_out(table, gain, alternatives.guide_gain, name),
                *[UNMEASURED] * (self.full.guidable and not moments.sds.size),
                *(components.guided_emission.left_out(learnt) if learnt and unguided else ()),
            )
        return _Result(tuple(table), left_out, moments, self._with_tables, self.decided.pilots.requested)

    def _with_guided_emission(
        self, table: list[choice.Prediction], moments: Moments, samples: int
    ) -> tuple[list[choice.Prediction], Learnt | None]:
        """Add guided emission to ``table`` where it pays; also returns what was learnt."""
        self._with_tables = None
        if not moments.emission.size:
            return table, None
        learnt = self._fitted_emission(moments)
        lit = min((row.score for row in table if row.candidate.light_paths), default=math.inf)
        has_light_paths = table[0].candidate.light_paths > 0
        if learnt.tables is None or (not has_light_paths and lit * learnt.whole > table[0].score):
            return table, learnt
        if not has_light_paths:
            found = self._measured(samples, learnt.tables)
            guided = choice.choose(found, self._alternatives(samples))
            if not found.mean > 0 or not guided or not guided[0].candidate.light_paths:
                return table, learnt
            self._with_tables, table = found, guided
        return [row.with_emission(learnt.tables, has_light_paths) for row in table], learnt

    def _is_worth_joining(self, samples: int) -> bool:
        """Whether several light subpaths per lane pay in a render of ``samples`` samples, if they are few."""
        dispatch = self._prepared.traits.dispatch  # the approximation calls every BSDF five times more
        return (
            samples >= JOINED_SAMPLES + (budget.SAMPLES_PER_BSDF * dispatch.count if dispatch.many else 0)
            and self._pixels >= JOINED_PIXELS
            and not self._prepared.traits.transmits
            and dr.backend_v(mi.Float) == dr.JitBackend.LLVM
            and may_join(self._prepared, self.full.merging)
        )

    def _fitted_emission(self, moments: Moments) -> Learnt:
        """Fit tables of emission."""
        counts, component = self._prepared.emitters.tables, components.guided_emission
        return component.learn(moments.emission, component.side_of(sum(counts)), counts)

    def _measured(self, samples: int, tables: EmissionTables | None = None) -> Moments:
        """Moments of a pilot (`pilot.measure`) for ``samples`` samples with these tables."""
        count, number = budget.lanes(samples), self.decided.pilots.requested + 1
        self.decided = replace(self.decided, pilots=Pilots(number))
        plan = replace(self.full, emission=tables)
        guiding = self.full.merging or budget.predicts_guiding(self._prepared, samples)
        seed = sequence_seed(mi.UInt32(self.pilot_seed), PILOT + number)
        flag = dr.scoped_set_flag(dr.JitFlag.KernelHistory, True)
        with gc_paused(), flag, evaluated_mode(self._prepared.emitters.evaluated):
            return pilot.measure(self._prepared, plan, self._settings, seed, count, samples / count, guiding)

    def adopt(self, decision: Decision, left_out: Iterable[dict[str, str]]):
        """Plan as decided from now on."""
        adopted = replace(decision.plan(self.full), skipped=(*self.full.skipped, *left_out))
        decisions = (*self.decided.decisions, decision)
        self.decided = replace(self.decided, decisions=decisions, left_out=tuple(left_out))
        self.threshold, self.plan = decision.threshold, adopted

    def restore(self, decided: PlannerState):
        """Resume from the decisions of an earlier part of the render."""
        for decision in decided.decisions:
            self.adopt(decision, decided.left_out)
        self.decided = decided

    def confidence(self, passes: tuple[int, ...]) -> float:
        """`choice.confidence` of the pilots' decision."""
        moments = self._with_tables or self.decided.moments
        return choice.confidence(moments, self._alternatives(self._expected(passes)))

    def lost_by_pilots(self) -> int:
        """Number of non-finite values of the pilots, counted as zero."""
        moments = self.decided.moments
        return 0 if moments is None else round(moments.rays["non_finite"] * moments.lanes)

    def why_no_pilot(self, passes: tuple[int, ...] = ()) -> str:
        """Sentence: why there are no predictions of a pilot."""
        return f"no pilot: {self._settled(passes)[0] or self._why_undecided()}"

    def _why_undecided(self) -> str:
        """Why the pilots that ran decided nothing."""
        return NOT_FINITE if self.lost_by_pilots() else SAW_NOTHING

    def _settled(self, passes: tuple[int, ...]) -> tuple[str, Decision | None]:
        """Why no pilot runs for the rest of the render, and the decision without one.

        An empty reason means that one runs.
        """
        if not budget.is_open(self.full, self._settings):
            fixed = " and ".join(budget.fixed_by(self._settings))
            return f"nothing to choose with {fixed}" if fixed else "no light subpaths are possible", None
        if self._pixels < budget.FEW_PIXELS:
            return f"the film has fewer than {budget.FEW_PIXELS} pixels", None
        samples = self._expected(passes)
        whole = sum(passes) * self._pixels + samples
        least = budget.least_samples(self._prepared)
        of_kernel = budget.samples_of_kernel(self._prepared.traits)
        if decision := without_pilot(self._prepared, self.full, self._settings, whole, of_kernel):
            return "the scene alone decides in a render as short as this", decision
        if samples < least:
            return f"the render has {samples} samples, a pilot needs {least}", None
        return "", None

    def _alternatives(self, samples: int) -> choice.Alternatives:
        """The alternatives for ``samples`` samples still to come."""
        joins = self._is_worth_joining(samples)
        possible = candidates(self._prepared, self.full, self._settings)
        possible = [candidate for candidate in possible if candidate.joined == 1 or joins]
        near_specular = bool(self._prepared.near_specular)
        stratified = self._settings.points == "sobol"
        return choice.Alternatives(possible, stratified, samples, self.full.guidable, near_specular)

    def _expected(self, passes: tuple[int, ...]) -> int:
        """Expected number of samples still to come."""
        done = sum(passes)
        left = (self._spp - done) * self._pixels
        return budget.expected_samples(self._settings, left, done * self._pixels)
