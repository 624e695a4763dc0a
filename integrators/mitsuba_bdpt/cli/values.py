"""Argparse types of values on command lines."""

from __future__ import annotations

import argparse
import contextlib
import re

PropertyValue = bool | int | float | str


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
