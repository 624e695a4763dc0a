"""Markdown tables, and their figures as texts."""

from __future__ import annotations

import math
import re
import statistics
from collections.abc import Callable, Iterable, Mapping, Sequence

from ..errors import CommandError
from .analysis import Summary, Unavailable
from .estimates import FEWEST_WITH_INTERVAL, RelativeError
from .metrics import Estimate

WIDE = 1e3
"""Ratio of the ends of an interval from which on it says nothing."""


def table(head: Iterable[str], rows: Iterable[Iterable[str]]) -> str:
    """Return a Markdown table; escapes bars and line ends."""
    first = list(head)
    lines = [first, ["---"] * len(first), *rows]
    return "".join("| " + " | ".join(map(_cell, line)) + " |\n" for line in lines)


def _cell(text: str) -> str:
    return " ".join(text.split("\n")).replace("|", "\\|")


def by_scene(scenes: Iterable[str], columns: Mapping[str, Callable[[str], object]]) -> str:
    """Return a table of a row per scene; ``columns``: figures of a scene by head, see `said`."""
    rows = [[f"`{scene}`", *(said(column, scene) for column in columns.values())] for scene in scenes]
    return table(["scene", *columns], rows)


def described(parameters: Mapping[str, object]) -> str:
    """Format the parameters of a plugin as TYPE KEY=VALUE ..."""
    found = dict(parameters)
    return " ".join([str(found.pop("type", "")), *(f"{key}={value}" for key, value in found.items())])


def met_text(met: bool) -> str:
    """Return whether a goal is met, as text of a table."""
    return "yes" if met else "**no**"


def ratio(x: float) -> str:
    """Format a ratio with three digits."""
    return f"{x:.3g}x" if x < 999.5 else f"{round(x, -1):.0f}x"


def ranged(found: Summary) -> str:
    """Format bound, median (smallest–largest)."""
    few = f"; n = {found.count}" if found.count < FEWEST_WITH_INTERVAL else ""
    middle = f"{ratio(found.median)} ({ratio(found.smallest)[:-1]}–{ratio(found.largest)[:-1]}{few})"
    return f"{found.bound} {middle}".lstrip()


def relative(found: RelativeError) -> str:
    """Format bound, relMSE (its interval), or why there is no interval."""
    return f"{found.bound} {positive(found.total, found.count)}".lstrip()


def positive(found: Estimate, count: int) -> str:
    """Format a positive error of ``count`` renders (its interval), or why there is none."""
    if has_interval(found, count):
        return f"{found.value:.2e} ({found.low:.2e}–{found.high:.2e})"
    return f"{found.value:.2e} ({_no_interval(count)})"


def has_interval(found: Estimate, count: int) -> bool:
    """Return whether a positive error of ``count`` renders has an interval that says something."""
    return count >= FEWEST_WITH_INTERVAL and found.high <= WIDE * found.low


def squared(found: Estimate, count: int) -> str:
    """Format a squared bias of ``count`` renders (its interval, from 0 on), or why there is none."""
    if count < FEWEST_WITH_INTERVAL:
        return f"{found.value:.2e} ({_no_interval(count)})"
    low, high = (f"{end:.2e}" if end > 0 else "0" for end in (found.low, found.high))
    return f"{found.value:.2e} ({low} to {high})" if high != "0" else f"{found.value:.2e} (0)"


def _no_interval(count: int) -> str:
    return "one render" if count == 1 else "too few renders for an interval"


def spanned(values: Sequence[float]) -> str:
    """Format the median of positive values (smallest–largest)."""
    middle, low, high = (f"{x:.3g}" for x in (statistics.median(values), min(values), max(values)))
    return middle if len(values) == 1 else f"{middle} ({low}–{high})"


def brief(found: RelativeError) -> str:
    """Format bound and relMSE with two digits, for captions."""
    return f"{found.bound} {found.total.value:.2g}".lstrip()


def said(figure: Callable[..., object], *given: object) -> str:
    """Call ``figure`` and format what it returns, or the reason why there is none."""
    try:
        found = figure(*given)
    except Unavailable as why:
        return str(why)
    if isinstance(found, Summary):
        return ranged(found)
    if isinstance(found, RelativeError):
        return relative(found)
    if isinstance(found, Estimate):
        if math.isinf(found.high):
            return f"{found.value:.2f} (too few renders for an interval)"
        return f"{found.value:.2f} ({found.low:.2f} to {found.high:.2f})"
    return str(found)


def replace_part(text: str, name: str, part: str) -> str:
    """Replace the text between the markers of ``name``; ``CommandError`` without them."""
    pattern = re.compile(rf"(<!-- report: {re.escape(name)} -->\n).*?(<!-- end -->)", re.DOTALL)
    if len(pattern.findall(text)) != 1:
        raise CommandError(f"there must be one `<!-- report: {name} -->` with an `<!-- end -->`")
    return pattern.sub(lambda m: m[1] + "\n" + part + "\n" + m[2], text)
