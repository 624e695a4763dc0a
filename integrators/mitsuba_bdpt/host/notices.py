"""State that is kept with a scene from render to render.

Warnings that were logged, what follows from the shapes, the results of pilots and of estimates of lost light.
"""

from __future__ import annotations

import sys
from collections import OrderedDict
from collections.abc import Callable, Hashable
from functools import cache
from typing import Any, TypeVar

import mitsuba as mi

# So many scenes, the latest ones.
REMEMBERED = 64

# Findings of a kind that are remembered of each scene, the latest ones.
FINDINGS = 16

_scenes: OrderedDict[int, tuple] = OrderedDict()

Found = TypeVar("Found")


def notes(scene: mi.Scene, sensor: mi.Sensor) -> dict[str, Any]:
    """A dictionary that belongs to ``scene`` as long as it lives; ``sensor`` is one that it is rendered with.

    A scene cannot be referred to weakly, and one that is kept alive would take part in the virtual calls of
    others. Another one may lie where it was: what tells them apart is the filter of its sensor's film, which
    is small enough to be kept.
    """
    for number in [n for n, held in _scenes.items() if _references(held) <= _alone()]:
        del _scenes[number]  # its scene is gone
    mark = next(iter(scene.sensors()), sensor).film().rfilter()
    known, found = _scenes.pop(id(scene), (None, None))
    if known is not mark:
        found = {}
    _scenes[id(scene)] = mark, found
    while len(_scenes) > REMEMBERED:
        _scenes.popitem(last=False)
    return found


def _references(held: tuple) -> int:
    """How many there are to the filter in an entry of `_scenes`; a film counts as one."""
    return sys.getrefcount(held[0])


@cache
def _alone() -> int:
    """`_references` where no film is left."""
    return _references((mi.load_dict({"type": "box"}), {}))


def remembered(
    scene: mi.Scene,
    sensor: mi.Sensor,
    kind: str,
    key: Hashable,
    find: Callable[[], Found],
    most: int = FINDINGS,
) -> tuple[Found, bool]:
    """Return what ``find()`` returned for this ``key``, and whether it is remembered from an earlier call.

    Of each ``kind`` the latest ``most`` are kept.
    """
    known = notes(scene, sensor).setdefault(kind, {})
    is_known, found = key in known, known.pop(key, None)
    known[key] = found = found if is_known else find()
    while len(known) > most:
        del known[next(iter(known))]
    return found, is_known


def warn_once(scene: mi.Scene, sensor: mi.Sensor, text: str, about: Hashable = None):
    """Log a warning, unless it was logged for the ``scene`` before.

    The same warning is one of the same ``text``, or one ``about`` the same where the text has numbers that
    differ from render to render.
    """
    said = notes(scene, sensor).setdefault("said", set())
    about = about or text
    if about not in said:
        said.add(about)
        mi.Log(mi.LogLevel.Warn, text)
