"""What was tried to break the method: cases by section, run by scripts/stress.py and as tests."""

from importlib import import_module

import short_pilots  # noqa: F401

from .case import Case

# Modules of this package, in the order of the table; each has a tuple ``CASES``.
SECTIONS = (
    "place",
    "geometry",
    "weights",
    "non_finite",
    "non_finite_shapes",
    "bad_input",
    "processes",
    "by_chance",
)


def cases() -> list[Case]:
    """All of them, in the order of the table. Raises ``ValueError`` if two have the same name."""
    found = [case for section in SECTIONS for case in import_module(f".{section}", __name__).CASES]
    names = [case.name for case in found]
    if twins := {name for name in names if names.count(name) > 1}:
        raise ValueError(f"stress cases with the same name: {sorted(twins)}")
    return found
