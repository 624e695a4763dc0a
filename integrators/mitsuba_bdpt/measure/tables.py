"""Formats Markdown tables and their figures."""

from __future__ import annotations

from .analysis import NotJudged, Refused, Summary
from .efficiency import refused_share


def table(head, rows) -> str:
    """Return a Markdown table; escapes bars and line ends."""
    lines = [head, ["---"] * len(head), *rows]
    return "".join("| " + " | ".join(map(_cell, line)) + " |\n" for line in lines)


def _cell(text: str) -> str:
    return " ".join(text.split("\n")).replace("|", "\\|")


def ratio(x: float) -> str:
    """Format a ratio with three digits."""
    return f"{x:.3g}x" if x < 999.5 else f"{round(x, -1):.0f}x"


def ranged(found: Summary) -> str:
    """Format median (smallest–largest)."""
    return f"{ratio(found.median)} ({ratio(found.smallest)[:-1]}–{ratio(found.largest)[:-1]})"


def said(figure, form=ranged) -> str:
    """Format a figure, or the reason why there is none."""
    try:
        return form(figure())
    except NotJudged as why:
        return f"not judged: reference {refused_share(why.share, 2)}"
    except Refused as why:
        return str(why)
