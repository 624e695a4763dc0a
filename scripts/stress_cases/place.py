"""Scenes in other units, in other places, turned, under other lights."""

from __future__ import annotations

import reference

import mitsuba as mi  # isort: skip

from .case import Case, Outcome


def _plain() -> Outcome:
    scene = reference.load_scene("cornell_box", resolution=16)
    bdpt = mi.load_dict({"type": "bdpt", "max_depth": 6})
    bdpt.render(scene, spp=16)
    count = bdpt.statistics["non_finite"]
    return Outcome(count == 0, f"{count} values that are not finite")


CASES = (
    Case("plain-cornell-box", "Scale and place", "`cornell_box` as it is", "all values finite", _plain, True),
)
