"""Which renders can afford a pilot, and of how many samples."""

from __future__ import annotations

import math
from dataclasses import replace

from ..settings import Settings
from ..transport.bsdf import Traits
from ..transport.plan import Plan

# Share of a render's samples that its pilot may take, and bounds of their number; a render of less than
# `LEAST_SAMPLES` has none. A pilot's sample takes several times as long as one of path tracing alone,
# and recording it longer than all of a short pilot's samples (scripts/overhead.py): 2 % of a render of
# `CHEAP_SAMPLES` of path tracing alone. In between a pilot is asked where the scene alone does not tell what
# pays: it is asked once for all renders of a scene, and what it decides is faster than a guess even in the
# first (docs/method/skipping.md).
PILOT_SHARE = 1 / 1024
LEAST_LANES, MOST_LANES = 1 << 12, 1 << 15
LEAST_SAMPLES, CHEAP_SAMPLES = 1 << 14, 1 << 24

# Costs of a pilot's kernel in a scene of many BSDFs (`bsdf.MANY`), in samples of a render without a pilot:
# compiling per kind of BSDF, recording per BSDF. Longer renders run a pilot
# (docs/development/experiments.md, "Choice of strategies").
SAMPLES_PER_KIND, SAMPLES_PER_BSDF = 1 << 16, 1 << 11

# Multiple of that length from which on the pilot also predicts the gain of guided s = 0, which takes three
# kernels in place of one (docs/development/experiments.md, "Choice of strategies").
GUIDING_TIMES = 4

# What a render is taken for whose number of samples is only a bound, see `expected_samples`.
PROVISIONAL_SAMPLES = 1 << 20

# Up to this ratio of its largest radiance to its mean a sky is even: a clear one without its sun has some
# ten, one with it thousands.
EVEN = 100

# Films of fewer pixels ask no pilot, which takes splats for as noisy as those of an image of many pixels, and
# have a light subpath for each camera subpath, since those that share one are correlated.
FEW_PIXELS = 64


def expected_samples(settings: Settings, left: int, done: int = 0) -> int:
    """Samples still to come of a render with ``left`` more at most.

    Under ``timeout`` and ``target_error`` nobody knows: as many as are ``done``, or `PROVISIONAL_SAMPLES`. (A
    pilot that takes half of the render would be as bad as one that sees rare paths which the render does not
    meet.)
    """
    open_end = settings.target_error > 0 or 0 <= settings.timeout < math.inf
    return min(left, max(PROVISIONAL_SAMPLES, done)) if open_end else left


def least_samples(traits: Traits) -> int:
    """Least number of samples of a render for which a pilot runs. ``traits``: of the scene's BSDFs."""
    asked = traits.asked
    if not asked.many:
        return LEAST_SAMPLES
    return SAMPLES_PER_KIND * asked.kinds + SAMPLES_PER_BSDF * asked.count


def predicts_guiding(traits: Traits, samples: int) -> bool:
    """Whether the pilot of a render with ``samples`` samples predicts the gain of guided s = 0."""
    return not traits.asked.many or samples >= GUIDING_TIMES * least_samples(traits)


def lanes(samples: int) -> int:
    """Samples of the pilot of a render of so many, which are enough for one."""
    return min(max(int(samples * PILOT_SHARE), LEAST_LANES), MOST_LANES)


def first_plan(full: Plan, settings: Settings, pixels: int) -> Plan:
    """What a render begins with: ``full``, unless its film has few pixels.

    Then there is a light subpath for each camera subpath, unless parameters say how many.
    """
    return (
        replace(full, camera_paths_per_light_path=1) if _is_auto(settings) and pixels < FEW_PIXELS else full
    )


def is_open(full: Plan, settings: Settings) -> bool:
    """Whether there is something to choose: nothing is given by hand, and light subpaths are possible."""
    return full.light and not is_by_hand(settings)


def is_by_hand(settings: Settings) -> bool:
    """Whether parameters say what is done. (Strategy images want all strategies.)"""
    return not _is_auto(settings) or settings.decisions is not None or settings.strategy_images


def _is_auto(settings: Settings) -> bool:
    return settings.skip == settings.light_paths == settings.connections == "auto"
