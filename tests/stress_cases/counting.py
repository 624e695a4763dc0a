"""Outcomes of many trials of a kind: how many went which way, and what went wrong."""

from __future__ import annotations

from collections import Counter

from .case import Outcome


def short(value, length: int = 160) -> str:
    text = " ".join(str(value).split())
    return text if len(text) <= length else f"{text[:length]} …"


def counted(counts: Counter, wrong: list[str]) -> Outcome:
    """All is well if nothing is ``wrong``."""
    text = ", ".join(f"{n} {what}" for what, n in counts.items())
    return Outcome(not wrong, text + (f"; {len(wrong)} not so: {'; '.join(wrong[:4])}" if wrong else ""))
