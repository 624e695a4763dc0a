"""Markdown tables, and numbers as texts."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence

import pandas as pd


def table(head: Iterable[str], rows: Iterable[Iterable[str]]) -> str:
    """Return a Markdown table; escapes bars and line ends."""
    return markdown(pd.DataFrame([*rows], columns=[*head], dtype=str))


def markdown(frame: pd.DataFrame) -> str:
    """Return a frame of texts as a Markdown table; escapes bars and line ends."""
    plain = frame.rename(columns=_escaped).map(_escaped)
    return plain.to_markdown(index=False, tablefmt="github", disable_numparse=True) + "\n"


def _escaped(text: str) -> str:
    return " ".join(text.split("\n")).replace("|", "\\|")


def described(parameters: Mapping[str, object]) -> str:
    """Format the parameters of a plugin as TYPE KEY=VALUE ..."""
    found = dict(parameters)
    return " ".join([str(found.pop("type", "")), *(f"{key}={value}" for key, value in found.items())])


def ratio(x: float) -> str:
    """Format a ratio with three digits."""
    return f"{x:.3g}x" if x < 999.5 else f"{round(x, -1):.0f}x"


def spanned(values: Sequence[float] | pd.Series) -> str:
    """Format the median of positive values (smallest–largest)."""
    middle, low, high = (f"{x:.3g}" for x in pd.Series(values).quantile([0.5, 0, 1]))
    return middle if len(values) == 1 else f"{middle} ({low}–{high})"
