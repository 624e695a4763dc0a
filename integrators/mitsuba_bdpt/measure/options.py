"""Options of measurements: names, defaults and bounds, for the command and Python.

A dataclass per measurement. Imports only the standard library, since the command declares its options first.
"""

from __future__ import annotations

import argparse
import contextlib
import math
from collections.abc import Sequence
from dataclasses import Field, dataclass, field, fields
from functools import partial
from pathlib import Path
from typing import Any, cast

from ..errors import CommandError, UsageTypeError

VARIANT = "llvm_ad_rgb"  # Mitsuba's variant in which all measurements render
RESOLUTION = 128  # width of references, and of what is judged by them, unless said
REFERENCE_SECONDS = 600.0  # seconds that making a reference may take, unless said


@dataclass(frozen=True)
class Number:
    """A finite number in [least, most], multiple of ``step``; or the value ``apart``.

    Called with such a number, or its text, returns the number; else raises argparse's error.
    """

    kind: type
    least: float
    most: float = math.inf
    step: int = 1
    apart: int | None = None

    def __str__(self) -> str:
        found = "a whole number" if self.kind is int else "a number"
        found += f" of at least {self.least:g}"
        if self.most < math.inf:
            found += f" and at most {self.most if self.kind is int else format(self.most, 'g')}"
        if self.step > 1:
            found += f", divisible by {self.step}"
        return found if self.apart is None else f"{found}, or {self.apart}"

    def __call__(self, given: Any) -> Any:
        value = given
        with contextlib.suppress(ValueError):
            if isinstance(given, str):
                value = _whole(given) if self.kind is int else float(given)
        numbers = int if self.kind is int else int | float
        if not isinstance(value, numbers) or isinstance(value, bool) or not self._has(value):
            raise argparse.ArgumentTypeError(f"got {given!r}, which must be {self}")
        return value

    def _has(self, value: float) -> bool:
        is_within = self.least <= value <= self.most and value < math.inf
        return value == self.apart or (is_within and (self.step == 1 or value % self.step == 0))


def _whole(text: str) -> int | float:
    """Parse a whole number, also with an exponent such as ``1e6``."""
    with contextlib.suppress(ValueError):
        return int(text)
    value = float(text)
    return int(value) if value.is_integer() else value


WHOLE, SEED, STOPS = Number(int, 1), Number(int, 0, 2**32 - 1), Number(float, -100, 100)
SECONDS, WIDTH = Number(float, 0), Number(int, 4, step=4)


def option(default: Any, kind: Any, text: str, **declared: Any) -> Any:
    """Return a field: default, argparse's type or choices, and help.

    ``declared``: further arguments for argparse, and ``short``, another name there.
    """
    return field(default=default, metadata={"kind": kind, "text": text, "declared": declared})


_width = partial(option, kind=WIDTH, text=f"width of image and reference in pixels; default: {RESOLUTION}")
_reference_seconds = partial(
    option, kind=SECONDS, text="limit of making a missing reference, per scene; default: %(default)g"
)
_windows = partial(
    option,
    None,
    str,
    "centres of two magnified windows, shares of width and height such as 0.3,0.6 0.8,0.2; default: where "
    "the errors of the first and the last image differ most",
    nargs=2,
    metavar="X,Y",
)
_budget = partial(
    option,
    None,
    WHOLE,
    "budget at which all are compared; default: the largest of which all scenes have two renders",
)
_columns = partial(
    option,
    kind=Number(int, 1, 2),
    text="width, in columns of a page: 1 is 8.5 cm, 2 are 17.8 cm; default: %(default)s",
)


def text_of_path(name: str, value: Any) -> str:
    """Return a ``value`` as text; raises ``UsageTypeError`` unless text or path."""
    if not isinstance(value, str | Path):
        raise UsageTypeError(f"{name}={value!r} must be a text or a path")
    return str(value)


class Options:
    """Base of all options."""

    def __post_init__(self):
        """Raise ``CommandError`` for invalid values, ``UsageTypeError`` for no path.

        Options of several values accept a single one.
        """
        for found in options_of(type(self)):
            name, kind = found.name, found.metadata["kind"]
            value: Any = getattr(self, name)
            if value is None and found.default is None:
                continue
            takes_several = "nargs" in found.metadata["declared"]
            several = takes_several and isinstance(value, list | tuple)
            values: Sequence[Any] = cast(Sequence[Any], value) if several else [value]
            if kind in (str, Path):
                values = [kind(text_of_path(name, one)) for one in values]
            elif isinstance(kind, Number):
                try:
                    values = list(map(kind, values))
                except argparse.ArgumentTypeError as error:
                    raise CommandError(f"{name}={value!r} must be {kind}") from error
            elif value not in kind:
                raise CommandError(f"{name}={value!r} must be one of {', '.join(kind)}")
            object.__setattr__(self, name, tuple(values) if takes_several else values[0])


def options_of(kind: type) -> list[Field[Any]]:
    return [found for found in fields(kind) if "kind" in found.metadata]


@dataclass(frozen=True)
class Sweep(Options):
    """Options of sweeps."""

    scenes: tuple[str, ...] | None = option(
        None, str, "scenes of the preset, or files where it lists none; default: all", nargs="+"
    )
    output: Path | None = option(None, Path, "folder; default: PROJECT/results/NAME_OF_PRESET", short="-o")
    reference_seconds: float | None = option(
        None,
        SECONDS,
        f"limit of making a missing reference, per scene; default: {REFERENCE_SECONDS:g}; with --seconds "
        "half of these, shared by the scenes",
    )
    seconds: float | None = option(
        None, SECONDS, "limit of everything: large budgets and later seeds are cut first; default: none"
    )


FIGURE_FORMATS = (".pdf", ".svg", ".png")


@dataclass(frozen=True)
class Figure(Options):
    """Options of figures of a sweep."""

    output: Path | None = option(
        None, Path, "PDF, SVG or PNG file by its ending; default: FOLDER/PLOT.pdf", short="-o"
    )
    plot: str = option(
        "samples",
        ("samples", "seconds", "efficiency", "rays", "crops"),
        "relMSE over samples or seconds, efficiencies, rays by kind, or images (at equal time, unless the "
        "preset has match = 'spp') with windows and errors in false colours; default: %(default)s",
    )
    columns: int = _columns(1)
    scenes: tuple[str, ...] | None = option(None, str, "scenes to draw; default: all", nargs="+")
    integrators: tuple[str, ...] | None = option(
        None, str, "names of integrators beside the first; default: all compared ones", nargs="+"
    )
    spp: int | None = _budget()
    windows: tuple[str, ...] | None = _windows()


@dataclass(frozen=True)
class Report(Options):
    """Options of reports and pages of a sweep."""

    spp: int | None = _budget()


@dataclass(frozen=True)
class MakeReference(Options):
    """Options of references."""

    spp: int = option(64, WHOLE, "samples per pixel of the renders to judge; default: %(default)s")
    seconds: float = option(REFERENCE_SECONDS, SECONDS, "limit per scene; default: %(default)g")
    resolution: int = _width(RESOLUTION)
    max_depth: int | None = option(
        None,
        Number(int, 1, apart=-1),
        "longest path in edges, -1: no limit; default: of presets/benchmark.toml, else of the scene's file",
    )
    by: str | None = option(
        None,
        ("path", "bdpt", "merging"),
        "what renders it, path (with media: volpath) only where that converges, merging (bdpt with it) where "
        "nothing else finds all light; default: as references/scenes.toml says, else bdpt",
    )


@dataclass(frozen=True)
class Compare(Options):
    """Options of comparisons of two configurations."""

    spp: tuple[int, ...] = option((64,), WHOLE, "samples per pixel; default: 64", nargs="+")
    pairs: int = option(12, WHOLE, "pairs of renders; default: %(default)s")
    resolution: int = _width(RESOLUTION)
    reference_seconds: float = _reference_seconds(REFERENCE_SECONDS)


@dataclass(frozen=True)
class EqualTime(Options):
    """Options of pictures at equal time."""

    spp: int = option(64, WHOLE, "samples per pixel of the last integrator; default: %(default)s")
    sampler: str | None = option(None, str, "type of the sensor's sampler; default: the scene's")
    reference: Path | None = option(
        None, Path, "EXR to take errors against, at its own size; default: a reference of the project"
    )
    resolution: int | None = _width(None)
    reference_seconds: float = _reference_seconds(60.0)
    windows: tuple[str, ...] | None = _windows()
    output: Path | None = option(
        None,
        Path,
        "PDF, SVG or PNG file by its ending; default: PROJECT/renders/equal_time_SCENE.png",
        short="-o",
    )
    columns: int = _columns(2)


@dataclass(frozen=True)
class Pyramid(Options):
    """Options of technique pyramids."""

    output: Path | None = option(
        None,
        Path,
        "EXR file with PNGs beside it, or pyramids as PDF, SVG or PNG with the EXR beside them; default: "
        "PROJECT/renders/pyramid_SCENE.exr",
        short="-o",
    )
    columns: int = _columns(2)
    max_depth: int = option(5, WHOLE, "longest path in edges; default: %(default)s")
    spp: int = option(64, WHOLE, "samples per pixel; default: %(default)s")
    seed: int = option(0, SEED, "seed of the render; default: %(default)s")
    resolution: int | None = option(None, WHOLE, "width of the image; default: the scene's")
    heuristic: str = option("balance", str, "heuristic of multiple importance sampling; default: %(default)s")
    exposure: float = option(0.0, STOPS, "exposure of the pictures in stops; default: %(default)g")


def _documented(kind: type[Options]) -> str:
    """Return the docstring of a dataclass of options, with the meaning of each."""
    lines = [kind.__doc__ or "", ""]
    for found in options_of(kind):
        bounds: Any = found.metadata["kind"]
        text = found.metadata["text"] % {"default": found.default}
        if isinstance(bounds, tuple):
            bounds = f"one of {', '.join(cast(tuple[str, ...], bounds))}"
        lines.append(f"* ``{found.name}``{'' if isinstance(bounds, type) else f' ({bounds})'}: {text}")
    return "\n".join(lines)


for _kind in Options.__subclasses__():
    _kind.__doc__ = _documented(_kind)
