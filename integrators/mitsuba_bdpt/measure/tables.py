"""Markdown tables, and how their figures are written."""

from __future__ import annotations

from .analysis import NotJudged, Refused, Summary
from .efficiency import refused_share


def table(head, rows) -> str:
    """A Markdown table; bars and ends of lines in a name or a text do not end a cell."""
    lines = [head, ["---"] * len(head), *rows]
    return "".join("| " + " | ".join(map(_cell, line)) + " |\n" for line in lines)


def _cell(text: str) -> str:
    return " ".join(text.split("\n")).replace("|", "\\|")


def ratio(x: float) -> str:
    """A ratio with three digits."""
    return f"{x:.3g}x" if x < 999.5 else f"{round(x, -1):.0f}x"


def ranged(found: Summary) -> str:
    """Median (smallest–largest)."""
    return f"{ratio(found.median)} ({ratio(found.smallest)[:-1]}–{ratio(found.largest)[:-1]})"


def said(figure, form=ranged) -> str:
    """Format a figure, or the reason for which there is none."""
    try:
        return form(figure())
    except NotJudged as why:
        return f"not judged: reference {refused_share(why.share, 2)}"
    except Refused as why:
        return str(why)
