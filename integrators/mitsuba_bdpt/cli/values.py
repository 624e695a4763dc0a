"""Values on command lines: argparse types."""

from __future__ import annotations

import argparse
import math
from collections.abc import Callable
from typing import TypeVar

PropertyValue = bool | int | float | str

Number = TypeVar("Number", int, float)


def number(kind: type[Number], minimum: float, maximum: float = math.inf) -> Callable[[str], Number]:
    """An argparse type: a finite `kind` between `minimum` and `maximum`."""

    def parse(text: str) -> Number:
        try:
            value = kind(text)
        except ValueError:
            value = None
        if value is None or not (minimum <= value <= maximum and math.isfinite(value)):
            most = maximum if kind is int else f"{maximum:g}"
            limit = "" if maximum == math.inf else f" and at most {most}"
            name = "a whole number" if kind is int else "a number"
            raise argparse.ArgumentTypeError(
                f"got {text!r}, which must be {name} of at least {minimum:g}{limit}"
            )
        return value

    return parse


def definition(text: str) -> tuple[str, str]:
    """Split ``KEY=VALUE``."""
    key, equals, value = text.partition("=")
    if not key or not equals:
        raise argparse.ArgumentTypeError(f"got {text!r}, which must have the form KEY=VALUE")
    return key, value


def property_(text: str) -> tuple[str, PropertyValue]:
    """Split ``KEY=VALUE`` and read the value as a Boolean, a whole number, a number or a string."""
    key, value = definition(text)
    if value in ("true", "false"):
        return key, value == "true"
    for kind in (int, float):
        try:
            return key, kind(value)
        except ValueError:
            continue
    return key, value
