"""What a case of the stress table is."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass


@dataclass(frozen=True)
class Outcome:
    """How a case went.

    ``ok``: whether that happened which the case expects, None if it could not be tried here; ``happened``:
    what did, with its figures, a few words of Markdown for the table.
    """

    ok: bool | None
    happened: str


@dataclass(frozen=True)
class Case:
    """Something tried.

    Its ``name`` (lower case, words with hyphens, unique), the heading ``section`` of the table, what is
    ``tried`` and what is ``expected`` with the reason of every tolerance, in a few words of Markdown; ``run``
    does it, in a process of its own with the variant ``llvm_ad_rgb`` set. ``quick`` cases, of a few seconds
    each, are tests too; figures of a ``timed`` one depend on the clock or the memory, and differ from run to
    run.
    """

    name: str
    section: str
    tried: str
    expected: str
    run: Callable[[], Outcome]
    quick: bool = False
    timed: bool = False


def of_section(section: str) -> Callable[..., Case]:
    """Makes a `Case` of that section from its other fields, in their order."""
    return lambda name, *rest, **more: Case(name, section, *rest, **more)
