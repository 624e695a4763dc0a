"""Markdown tables, and how their figures are written."""

from __future__ import annotations

from .analysis import NotJudged, Refused, Summary


def table(head, rows) -> str:
    """A Markdown table."""
    lines = [head, ["---"] * len(head), *rows]
    return "\n".join("| " + " | ".join(line) + " |" for line in lines) + "\n"


def ratio(x: float) -> str:
    """A ratio with three digits."""
    return f"{x:.3g}x" if x < 999.5 else f"{round(x, -1):.0f}x"


def ranged(found: Summary) -> str:
    """Median (smallest–largest)."""
    return f"{ratio(found.median)} ({ratio(found.smallest)[:-1]}–{ratio(found.largest)[:-1]})"


def said(figure, form=ranged) -> str:
    """A figure in words, or why there is none."""
    try:
        return form(figure())
    except NotJudged as why:
        return f"not judged: reference {100 * why.share:.2g} %"
    except Refused as why:
        return str(why)
