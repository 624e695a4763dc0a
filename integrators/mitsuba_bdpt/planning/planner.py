"""Decides how a render proceeds: by parameters, by the scene alone, or by a pilot."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import drjit as dr
import mitsuba as mi

from .. import components
from ..host.jit import evaluated_mode, gc_paused
from ..sampling.sequences import PILOT, sequence_seed
from ..scene.prepared import PreparedScene
from ..settings import Settings
from ..transport.plan import JOINED
from . import budget, choice, pilot, unsampled_light
from .configuration import LEFT_OUT, Decision, candidates, not_worth, without_pilot
from .findings import SceneCache
from .moments import GuidableLight, Moments
from .possible import plan

if TYPE_CHECKING:
    from ..guided_emission import Learnt

# Least samples and pixels of a render whose camera subpaths may connect with several light subpaths, drawn by
# an approximation (`connections`). Not with transmissive BSDFs, which the approximation does not cover, nor
# where rays test small shapes; with LLVM only, as lanes need four times the local memory. See experiments,
# "Several light subpaths per lane".
JOINED_SAMPLES, JOINED_PIXELS = 1 << 16, 1 << 10

# Why s = 0 is not guided where its gain was not predicted, as in ``statistics["skipped"]``.
UNMEASURED = not_worth("guided s=0", "with so many BSDFs the render is too short to predict its gain")

# Variance of guidable light over that of all other light from which on it may change the choice.
MATTERS = 0.1

# Why a pilot decides nothing. Directly seen emission is the same for all candidates.
SAW_NOTHING = "the pilot found no light but that of emitters which the sensor sees directly"
NOT_FINITE = "the pilot found only invalid samples (NaN or infinite)"


@dataclass(frozen=True)
class PlannerState:
    """Decisions of a render so far; part of its progress.

    ``left_out``: what the last of ``decisions`` leaves out, as in ``statistics["skipped"]``; ``no_pilot``:
    why no pilot ran or decided; ``pilot``: ``rendered``, ``cached`` or empty; ``non_finite``: number of its
    non-finite values, counted as zero.
    """

    decisions: tuple[Decision, ...] = ()
    left_out: tuple[dict[str, str], ...] = ()
    no_pilot: str = ""
    pilot: str = ""
    non_finite: int = 0


@dataclass(frozen=True)
class _Result:
    """Result of a pilot.

    ``table`` of predictions for the ``alternatives``, the best first, what the best leaves out, and the
    ``moments`` from which they follow.
    """

    table: tuple[choice.Prediction, ...]
    left_out: tuple[dict[str, str], ...]
    moments: Moments
    alternatives: choice.Alternatives


class Planner:
    """The ``plan`` of one render of ``spp`` samples per pixel, and its decisions.

    ``is_open``: light that it lacks may make it merge; ``full``: the plan before any decision; ``threshold``
    of roulette in units of the image, None before a decision; ``decided``: saved with the render.
    """

    # The same for all seeds of a render, so that all decide alike.
    pilot_seed = 30

    def __init__(
        self, prepared: PreparedScene, settings: Settings, spp: int, findings: SceneCache, is_open: bool
    ):
        self._prepared, self._settings, self._findings, self._is_open = prepared, settings, findings, is_open
        self._pixels = int(prepared.camera.region.size.prod())
        self._samples = budget.expected_samples(settings, spp * self._pixels)
        self.full = plan(prepared, settings)
        joined = JOINED[-1] if self._is_worth_joining(self._samples) else 1
        self.full = self.plan = budget.first_plan(self.full, prepared, settings, self._pixels, joined)
        self.threshold, self.decided = None, PlannerState()
        self._result: _Result | None = None

    def begin(self) -> bool:
        """Adopt what is given or the scene alone decides, before the first pass.

        Returns whether a pilot is to run.
        """
        for given in self._settings.internals.decisions or ():
            self.adopt(given, ())
        settled, decision = self._settled()
        if self._settings.internals.decisions is None:
            self.decided = replace(self.decided, no_pilot=settled)
        if decision:
            self.adopt(decision, LEFT_OUT)
        return not settled

    def run_pilot(self) -> list[choice.Prediction]:
        """Run a pilot and adopt its decision; returns its predictions, the best first."""
        key = self._settings, self._is_open, self.pilot_seed, self._samples, self._pixels, JOINED
        result, is_known = self._findings.find("results", key, self._piloted)
        self._result, ran = result, "cached" if is_known else "rendered"
        self.decided = replace(self.decided, pilot=ran, non_finite=result.moments.non_finite)
        if result.table:
            self.adopt(result.table[0].decided(result.moments.mean), result.left_out)
        self.decided = replace(self.decided, no_pilot="" if self.decided.decisions else self._why_undecided())
        return list(result.table)

    def _piloted(self) -> _Result:
        """Result of a pilot.

        Its samples leave out light for guided s = 0. Other strategies sample near-specular paths too: where
        they are to do so, and this light matters, they are measured again, with it.
        """
        guidable = self._guidable()
        found = self._of_pilot(guidable)
        if guidable is None or not self._prepared.near_specular or not found.table:
            return found
        best = found.table[0]
        if best.candidate.guided or found.moments.guidable[0] < MATTERS * best.variance:
            return found
        return replace(self._of_pilot(None), left_out=found.left_out)

    def _of_pilot(self, guidable: GuidableLight | None) -> _Result:
        moments = self._measured(guidable)
        learnt = self._learnt(moments)
        alternatives = self._alternatives(learnt)
        table, left_out = choice.choose(moments, alternatives), ()
        if self.full.guided:  # whatever it costs
            table = [row for row in table if row.candidate.guided] or table
        if not moments.mean > 0:  # the pilot saw no light, or NaN
            table = []
        if table:
            unguided = table[0].candidate.emission is None
            left_out = (
                *choice.left_out(table, "merging" if self.full.merging else "guided s=0"),
                *[UNMEASURED] * (self.full.guidable and not (self.full.guided or self._predicts_guiding())),
                *(components.guided_emission.left_out(learnt) if learnt and unguided else ()),
            )
        return _Result(tuple(table), left_out, moments, alternatives)

    def _is_worth_joining(self, samples: int) -> bool:
        """Whether several light subpaths per lane pay in a render of ``samples`` samples, if they are few."""
        dispatch = self._prepared.traits.dispatch  # the approximation calls every BSDF five times more
        return (
            samples >= JOINED_SAMPLES + (budget.SAMPLES_PER_BSDF * dispatch.count if dispatch.many else 0)
            and self._pixels >= JOINED_PIXELS
            and not self._prepared.traits.transmits
            and dr.backend_v(mi.Float) == dr.JitBackend.LLVM
            and self._prepared.space is None
            and not (self.full.merging or self._prepared.emitters.shape_errors.small)
        )

    def _learnt(self, moments: Moments) -> Learnt | None:
        """Tables of emission fitted to a pilot; None without emission statistics."""
        if not moments.emission.size:
            return None
        counts, component = self._prepared.emitters.tables, components.guided_emission
        return component.learn(moments.emission, component.side_of(sum(counts)), counts)

    def _measured(self, guidable: GuidableLight | None) -> Moments:
        """Moments of a pilot, see `pilot.measure`."""
        samples, count = self._samples, budget.lanes(self._samples)
        seed = sequence_seed(mi.UInt32(self.pilot_seed), PILOT)
        flag = dr.scoped_set_flag(dr.JitFlag.KernelHistory, True)
        with gc_paused(), flag, evaluated_mode(self._prepared.emitters.evaluated):
            return pilot.measure(
                self._prepared, self.full, self._settings, seed, count, samples / count, guidable
            )

    def _predicts_guiding(self) -> bool:
        """Whether a pilot predicts the gain of photon-guided BSDF sampling."""
        if not self.full.guidable or components.why_absent("merging"):
            return False
        return self.full.merging or budget.predicts_guiding(self._prepared, self._samples)

    def _guidable(self) -> GuidableLight | None:
        """SDS light whose variance the pilot compares with that of other light."""
        if not self._predicts_guiding():
            return None
        spp = self._samples // self._pixels
        merges = self._is_open and not components.merging.why_not(self._prepared.camera.sensor, media=False)
        fewest = unsampled_light.FEWEST_HITS if merges else 0
        return unsampled_light.guidable(self._prepared, self.full, self._settings, spp, fewest)

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

    def confidence(self) -> float:
        """`choice.confidence` of the pilot's decision; 0 without one."""
        result = self._result
        return choice.confidence(result.moments, result.alternatives) if result and result.table else 0.0

    def why_no_pilot(self) -> str:
        """Sentence: why there are no predictions of a pilot."""
        return f"no pilot: {self._settled()[0] or self._why_undecided()}"

    def _why_undecided(self) -> str:
        """Why a pilot decided nothing."""
        return NOT_FINITE if self.decided.non_finite else SAW_NOTHING

    def _settled(self) -> tuple[str, Decision | None]:
        """Why no pilot runs, and the decision without one.

        An empty reason means that one runs.
        """
        if fixed := budget.fixed_by(self._settings):
            return f"nothing to choose with {' and '.join(fixed)}", None
        if not self.full.light:
            return "no light subpaths are possible", None
        if self._pixels < budget.FEW_PIXELS:
            return f"the film has fewer than {budget.FEW_PIXELS} pixels", None
        samples = self._samples
        least = budget.least_samples(self._prepared)
        of_kernel = budget.samples_of_kernel(self._prepared.traits)
        if decision := without_pilot(self._prepared, self.full, self._settings, samples, of_kernel):
            return "the scene alone decides in a render as short as this", decision
        if samples < least:
            return f"the render has {samples} samples, a pilot needs {least}", None
        return "", None

    def _alternatives(self, learnt: Learnt | None) -> choice.Alternatives:
        joins = self._is_worth_joining(self._samples)
        possible = candidates(self._prepared, self.full, self._settings)
        possible = [candidate for candidate in possible if candidate.joined == 1 or joins]
        return choice.Alternatives(possible, self._samples, learnt)
