"""Argparse types of values on command lines."""

from __future__ import annotations

import argparse
import contextlib
import math
import re
from collections.abc import Callable

from ..measure.options import Number

PropertyValue = bool | int | float | str

RESUME = ("auto", "must", "never")
"""When a render goes on from a checkpoint: if there is one, in any case, or not at all."""

MOST_EXACT = 2**53
"""Up to this all whole numbers are exact as ``float``."""

MOST_FRAMES = 1 << 20
"""Sensors in a range, at most."""


def number(kind: type, least: float, most: float = math.inf) -> Callable[[str], float]:
    """Return an argparse type: a finite number of ``kind`` in [``least``, ``most``]."""
    return within(Number(kind, least, most))


def within(bounds: Number) -> Callable[[str], float]:
    read = whole if bounds.kind is int else bounds.kind

    def parse(text: str) -> float:
        with contextlib.suppress(ValueError):
            if bounds.holds(value := read(text)):
                return value
        raise argparse.ArgumentTypeError(f"got {text!r}, which must be {bounds}")

    return parse


def whole(text: str) -> int:
    """Parse a whole number, also with an exponent such as ``1e6``; ``ValueError`` for others."""
    with contextlib.suppress(ValueError):
        return int(text)
    value = float(text)
    if not value.is_integer() or abs(value) > MOST_EXACT:
        raise ValueError(text)
    return int(value)


def _utf8(text: str) -> str:
    """Decode an argument as UTF-8, in which Mitsuba's texts are, whatever the encoding of the locale."""
    return text.encode("utf-8", "surrogateescape").decode("utf-8", "replace")


def weight(text: str) -> tuple[str, tuple[float, ...]]:
    """Parse ``LAYER=X`` or ``LAYER=X,Y,Z``, the weight of a light group or path layer."""
    text = _utf8(text)
    name, equals, values = text.rpartition("=")
    with contextlib.suppress(ValueError):
        if name.strip() and equals:
            return name.strip(), tuple(float(value) for value in values.split(","))
    raise argparse.ArgumentTypeError(
        f"got {text!r}, which must have the form LAYER=X or LAYER=X,Y,Z, factors of linear light"
    )


def size(text: str) -> tuple[int, ...]:
    """Parse ``WIDTHxHEIGHT``, integers of at least 1."""
    return _pixels(text, r"(\d+)[xX](\d+)", "WIDTHxHEIGHT")


def crop(text: str) -> tuple[int, ...]:
    """Parse ``X,Y,WIDTH,HEIGHT``, integers, the last two at least 1."""
    return _pixels(text, ",".join([r"\s*(\d+)\s*"] * 4), "X,Y,WIDTH,HEIGHT")


def _pixels(text: str, pattern: str, form: str) -> tuple[int, ...]:
    match = re.fullmatch(pattern, text)
    numbers = tuple(map(int, match.groups())) if match else (0,)
    if not all(numbers[-2:]):
        raise argparse.ArgumentTypeError(f"got {text!r}, which must have the form {form}, in pixels")
    return numbers


def frames(text: str) -> list[int]:
    """Parse sensor indices: ``3``, ``0-9``, ``0-99:10`` (every tenth), or a list."""
    found = []
    for part in text.split(","):
        match = re.fullmatch(r"\s*(\d+)(?:-(\d+)(?::(\d+))?)?\s*", part)
        first, last, step = (match and match[i] for i in (1, 2, 3)) if match else (None, None, None)
        if first is None or step == "0" or (last is not None and int(last) < int(first)):
            raise argparse.ArgumentTypeError(
                f"got {text!r}, which must be numbers of sensors such as 3, 0-9, 0-99:10 or 0,5,7"
            )
        numbers = range(int(first), int(last or first) + 1, int(step or 1))
        if len(numbers) > MOST_FRAMES:
            raise argparse.ArgumentTypeError(f"got {text!r}, which must be {MOST_FRAMES} numbers at most")
        found += numbers
    return found


def resume(text: str) -> str:
    if text not in RESUME:
        scene = "; write the scene before --resume" if text.lower().endswith(".xml") else ""
        raise argparse.ArgumentTypeError(f"got {text!r}, which must be {', '.join(RESUME)} or nothing{scene}")
    return text


def definition(text: str) -> tuple[str, str]:
    """Parse ``KEY=VALUE``."""
    text = _utf8(text)
    key, equals, value = text.partition("=")
    if not key or not equals:
        raise argparse.ArgumentTypeError(f"got {text!r}, which must have the form KEY=VALUE")
    return key, value


def property_(text: str) -> tuple[str, PropertyValue]:
    """Parse ``KEY=VALUE``, with a Boolean, integer, number or string as value."""
    key, value = definition(text)
    if value in ("true", "false"):
        return key, value == "true"
    for kind in (int, float):
        try:
            return key, kind(value)
        except ValueError:
            continue
    return key, value
