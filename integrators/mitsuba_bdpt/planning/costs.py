"""What a sample costs, counted from what the pilot's subpaths did."""

from __future__ import annotations

import math
from collections.abc import Mapping

from .configuration import Configuration

# What takes how long, in units of a ray of a camera subpath (closest hit or shadow, with all that belongs to
# it). Fitted to candidates in 29 scenes on two cores (docs/reports/choices.json): off by 6 % (root mean
# square) for the ratios of their times.
COSTS = {
    "light_path": 1.7,  # to start a light subpath
    "far": 2.0,  # beside it, to start one from infinity
    "light": 0.76,  # each of its rays
    "light_in_media": 1.2,  # the same in a scene with media
    "inner": 0.55,  # to look for connections at all, per sample
    "joined": 0.65,  # a connection that is drawn and tested
    "shadow_inner": 0.65,  # each that is tested, where all are
    # In a scene with media, a pair that is evaluated by the lane of a packet that has most of them: others
    # wait for it, and long subpaths differ. (Six scenes: 0.13 to 0.28.)
    "packets": 0.18,
    "guide": 3.0,  # a vertex where s = 0 is guided
    "aimed": 7.0,  # each guided sample of it
    "diverging": 0.5,  # a pair whose BSDFs are evaluated, where the lanes of a packet meet different ones
}

# What a render takes besides its samples, most of it to record its kernel, in the same unit: with path
# tracing alone, for light subpaths beside it, for connections. (Renders of 2 samples of 16^2 pixels in seven
# scenes: 8 to 13 ms, 8 to 17 ms, 0 to 2 ms, where a ray takes 34 to 53 ns on two cores.) Previews of 128^2 at
# 4 samples per pixel have 200,000 to 500,000 rays.
FIXED = {"start": 180e3, "light": 250e3, "inner": 20e3, "guided": 600e3}

# Numbers of kinds of BSDFs from which on, and up to which, the lanes of a packet take turns in evaluating
# theirs. (BSDFs of one kind share their functions. By the number of BSDFs, a connection seemed to cost 1.3
# times what it does in a room of 12 BSDFs of 5 kinds, and path tracing alone was chosen there.)
FEW_KINDS, MANY_KINDS = 2, 16


def cost(candidate: Configuration, rays: Mapping[str, float], samples: float = math.inf) -> float:
    """Cost of a sample in a render of so many ``samples``; that of path tracing alone is 1.

    What is `FIXED` is included. ``rays`` per sample of the pilot, see `moments.Moments`.
    """
    total = camera = rays["camera"] + rays["shadow_s1"] + FIXED["start"] / samples
    if candidate.light_paths:
        total += FIXED["light"] / samples
        light = COSTS["light_path"] + COSTS["far"] * rays["far"]
        each = COSTS["light_in_media" if rays.get("media") else "light"]
        light += each * (rays["light"] + rays["shadow_t1"])
        total += light * candidate.light_paths
    if candidate.connections != "none":
        total += FIXED["inner"] / samples
        kind = "joined" if candidate.connections == "one" else "shadow_inner"
        total += COSTS["inner"] + COSTS[kind] * rays[kind]
        total += COSTS["packets"] * rays.get("packets", 0)
        part = (rays["kinds"] - FEW_KINDS) / (MANY_KINDS - FEW_KINDS)
        total += COSTS["diverging"] * min(max(part, 0), 1) * rays["evaluated"]
    if candidate.guided:
        total += FIXED["guided"] / samples
        total += (COSTS["guide"] + COSTS["aimed"] * candidate.guided) * rays["aimed"]
    return total / camera
