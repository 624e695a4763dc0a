"""What a mistyped name may have meant, for messages."""

from __future__ import annotations

import difflib
from collections.abc import Iterable


def did_you_mean(name: str, known: Iterable[str]) -> str:
    """The question for the one of the ``known`` names that ``name`` is most like, with a space after it;
    empty if none is."""
    by_case = {other.lower(): other for other in known}
    near = difflib.get_close_matches(name.lower(), by_case, 1)
    return f"did you mean {by_case[near[0]]}? " if near else ""
