"""Which renders run a pilot, and the pilot's number of samples."""

from __future__ import annotations

import math
from dataclasses import replace

from ..scene.prepared import PreparedScene
from ..settings import Settings
from ..transport.plan import Plan

# The pilot's share of a render's samples, bounds of the pilot's samples, and bounds of the render's samples:
# from `LEAST_SAMPLES` on the pilot's gain pays for it in the first render of a scene, from `FOCUSED_SAMPLES`
# on where light is focused (`focuses`); from `CHEAP_SAMPLES` on recording the pilot takes about 2 % of the
# render. See experiments, "Short renders".
PILOT_SHARE = 1 / 128
LEAST_LANES, MOST_LANES = 1 << 12, 1 << 15
FOCUSED_SAMPLES, LEAST_SAMPLES, CHEAP_SAMPLES = 1 << 16, 1 << 18, 1 << 24

# Compilation per kind of BSDF and recording per BSDF of a pilot's kernel in a scene of many BSDFs
# (`bsdf.MANY`), in samples of a render without a pilot. Longer renders run a pilot.
SAMPLES_PER_KIND, SAMPLES_PER_BSDF = 1 << 15, 1 << 11

# Multiple of that length from which on the pilot also predicts the gain of photon-guided BSDF sampling, which
# takes three kernels instead of one; see experiments, "Choice of strategies".
GUIDING_TIMES = 4

PROVISIONAL_SAMPLES = 1 << 20  # assumed samples of a render of unknown length, see `expected_samples`

# Largest ratio of maximum to mean radiance of an environment that s = 0 samples well by itself (a clear sky
# without its sun has about ten): light subpaths and guided samples do not pay, but in long renders. Tighter
# bounds: `aim.EVEN_SKY` of photons, `configuration.UNIFORM` of weights.
EVEN = 100

# Films of fewer pixels run no pilot, whose variance of splats assumes an image of many pixels. They trace a
# light subpath per camera subpath, since camera subpaths that share one are correlated.
FEW_PIXELS = 64

# Camera subpaths per light subpath without a decision, in scenes that do not focus light and have fewer
# emitters than `MANY_EMITTERS`; in others `possible.plan` has four. See experiments, "Short renders".
UNFOCUSED, MANY_EMITTERS = 16, 16


def expected_samples(settings: Settings, most: int) -> int:
    """Number of samples of a render of at most ``most``; under ``timeout`` and ``target_error`` assumed."""
    open_end = settings.target_error > 0 or 0 <= settings.timeout < math.inf
    return min(most, PROVISIONAL_SAMPLES) if open_end else most


def focuses(prepared: PreparedScene) -> bool:
    """Whether light may be focused: by glass, by mirrors, smooth or nearly so, or into beams in media."""
    return prepared.specular or bool(prepared.near_specular) or prepared.space is not None


def least_samples(prepared: PreparedScene) -> int:
    """Least number of samples of a render that runs a pilot."""
    least = FOCUSED_SAMPLES if focuses(prepared) else LEAST_SAMPLES
    return max(least, samples_of_kernel(prepared))


def samples_of_kernel(prepared: PreparedScene) -> int:
    """Compilation and recording of a pilot's kernel in samples; 0 without many BSDFs."""
    dispatch = prepared.traits.dispatch
    return SAMPLES_PER_KIND * dispatch.kinds + SAMPLES_PER_BSDF * dispatch.count if dispatch.many else 0


def first_plan(full: Plan, prepared: PreparedScene, settings: Settings, pixels: int, joined: int) -> Plan:
    """The plan before any decision: ``full`` with a number of light subpaths, unless set by parameters.

    ``joined``: light subpaths per lane, where they are few.
    """
    if not full.light or not settings.skip == settings.light_paths == settings.connections == "auto":
        return full
    if pixels < FEW_PIXELS:
        return replace(full, camera_paths_per_light_path=1)
    many = prepared.emitters.count >= MANY_EMITTERS
    if many or focuses(prepared) or settings.strategy_images:
        return full
    joined = joined if full.connections == "one" else 1
    return replace(full, camera_paths_per_light_path=UNFOCUSED, joined=joined)


def fixed_by(settings: Settings) -> list[str]:
    """The parameters that fix the strategies, with their values (strategy images need all strategies)."""
    values = {name: getattr(settings, name) for name in ("skip", "light_paths", "connections")}
    texts = {name: value if isinstance(value, str) else f"{value:g}" for name, value in values.items()}
    fixed = [f"{name}={text}" for name, text in texts.items() if text != "auto"]
    fixed += ["decisions"] * (settings.internals.decisions is not None)
    return fixed + ["layers=strategies"] * settings.strategy_images
