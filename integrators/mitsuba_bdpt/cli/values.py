"""Argparse types of values on command lines."""

from __future__ import annotations

import argparse
import contextlib
import re

PropertyValue = bool | int | float | str

MOST_FRAMES = 1 << 20
"""Sensors in a range, at most."""


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


def definition(text: str) -> tuple[str, str]:
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
