"""The subcommands that measure, with the extra ``[measure]``: their arguments, and what runs them.

The room `measure` is imported when one of them runs, since it needs packages that the rest does without.
"""

from __future__ import annotations

import argparse
import importlib.util
import sys
from argparse import Namespace
from collections.abc import Callable
from pathlib import Path

from ..errors import CommandError
from . import mistakes
from .values import number, property_

NEEDED = ("colour", "flip_evaluator", "matplotlib", "pyarrow", "scipy")
"""What the extra ``[measure]`` installs, as modules."""

RESOLUTION = 128
"""Width of a reference unless said, as in `measure.project`."""

WHOLE = number(int, 1)


def run(options: Namespace) -> int:
    """Run a subcommand and return its exit status."""
    try:
        return mistakes.answered(lambda: _run(options))
    except KeyboardInterrupt:
        print("interrupted; what was finished is kept", file=sys.stderr)
        return mistakes.INTERRUPTED


def _run(options: Namespace) -> int:
    check_installed(options.command)
    return options.measuring(options)


def check_installed(command: str) -> None:
    """Raise ``CommandError`` if the extra ``[measure]`` is not there."""
    missing = [name for name in NEEDED if importlib.util.find_spec(name) is None]
    if missing:
        raise CommandError(
            f"{command} needs {', '.join(missing)}; install them with: pip install 'mitsuba-bdpt[measure]'"
        )


def add_commands(add_command: Callable[[str, str], argparse.ArgumentParser]) -> None:
    """Declare all subcommands; ``add_command`` makes the parser of one, of its name and help."""
    for name, (help_text, declare, measuring) in COMMANDS.items():
        parser = add_command(name, help_text)
        text = "folder with scenes/, references/, presets/, results/; default: the current one"
        parser.add_argument("--project", type=Path, default=Path(), metavar="DIR", help=text)
        declare(parser)
        parser.set_defaults(measuring=measuring)


def integrator(text: str) -> tuple[str, dict]:
    """An argparse type: ``TYPE KEY=VALUE …``, itself and as the parameters of a plugin."""
    kind, *properties = text.split() or [""]
    if not kind or "=" in kind:
        raise argparse.ArgumentTypeError(f"got {text!r}, which must have the form TYPE KEY=VALUE …")
    return text, {"type": kind} | dict(map(property_, properties))


def parameters(text: str) -> dict:
    """An argparse type: as `integrator`, the parameters alone."""
    return integrator(text)[1]


def _resolution(text: str) -> int:
    """An argparse type: a width that the tiles of a bias check divide."""
    value = WHOLE(text)
    if value % 4:
        raise argparse.ArgumentTypeError(f"got {text!r}, which must be divisible by 4")
    return value


def _depth(text: str) -> int:
    """An argparse type: a number of edges, or -1 for no limit."""
    value = number(int, -1)(text)
    if value == 0:
        raise argparse.ArgumentTypeError("got '0', which must be at least 1, or -1 for no limit")
    return value


def _add_reference_seconds(parser) -> None:
    text = "that making a reference may take where there is none, per scene; default: %(default)g"
    kind = number(float, 0)
    parser.add_argument("--reference-seconds", type=kind, default=600.0, metavar="SECONDS", help=text)


def _add_resolution(parser, default: int | None = RESOLUTION) -> None:
    text = f"width of image and reference; default: {RESOLUTION}"
    parser.add_argument("--resolution", type=_resolution, default=default, metavar="PIXELS", help=text)


SCENES = "scene files, or names in PROJECT/scenes"


def _declare_sweep(parser) -> None:
    add = parser.add_argument
    add("preset", help="TOML file, or a name in PROJECT/presets: what is rendered")
    add("-o", "--output", type=Path, help="folder; default: PROJECT/results/NAME_OF_PRESET")
    add("--scenes", nargs="+", help="these of the preset alone; other rows stay as they are")
    add("--scheduler", metavar="ADDRESS", help="of a dask.distributed cluster to render on (extra [cluster])")
    _add_reference_seconds(parser)


def _declare_report(parser) -> None:
    parser.add_argument("folder", help="what sweep has filled, or a name in PROJECT/results")
    parser.add_argument("--readme", type=Path, help="a Markdown file whose parts are filled")


def _declare_page(parser) -> None:
    parser.add_argument("folder", help="what sweep has filled, or a name in PROJECT/results")
    parser.add_argument("-o", "--output", type=Path, help="default: FOLDER/page.html")


def _declare_reference(parser) -> None:
    add = parser.add_argument
    add("scenes", nargs="*", help=SCENES)
    add("--all", action="store_true", help="all scenes of PROJECT/scenes")
    add("--spp", type=WHOLE, default=64, help="of the renders to judge; default: %(default)s")
    add("--seconds", type=number(float, 0), default=600.0, help="per scene; default: %(default)g")
    _add_resolution(parser)
    add("--max-depth", type=_depth, help="default: that of presets/benchmark.toml, else of the scene's file")
    text = (
        "what renders it, path (with media: volpath) only where that converges, merging (bdpt with it) where "
        "nothing else finds all light; default: as references/scenes.toml says, else bdpt"
    )
    add("--by", choices=("path", "bdpt", "merging"), help=text)


def _declare_compare(parser) -> None:
    add = parser.add_argument
    text = "TYPE KEY=VALUE …, in quotes; sampler=TYPE is the sensor's sampler"
    add("sides", nargs=2, type=parameters, metavar="SIDE", help=text)
    add("--scenes", nargs="+", required=True, help=SCENES)
    add("--spp", type=WHOLE, nargs="+", default=[64], help="default: 64")
    add("--pairs", type=WHOLE, default=12, help="default: %(default)s")
    _add_resolution(parser)
    _add_reference_seconds(parser)


def _declare_equal_time(parser) -> None:
    add = parser.add_argument
    add("scene", help="a scene file, or a name in PROJECT/scenes")
    add("--spp", type=WHOLE, default=64, help="of the last integrator; default: %(default)s")
    text = "TYPE KEY=VALUE …, each in quotes; default: path (with media: volpath) and bdpt"
    add("-i", "--integrators", nargs="+", type=integrator, default=[], help=text)
    add("--sampler", help="type of the sensor's sampler; default: the file's")
    text = "image to take errors against, at its own size; default: a reference of the project"
    add("--reference", type=Path, metavar="EXR", help=text)
    _add_resolution(parser, None)
    _add_reference_seconds(parser)
    add("-o", "--output", type=Path, help="default: PROJECT/renders/equal_time_SCENE.png")


def _declare_pyramid(parser) -> None:
    add = parser.add_argument
    add("scene", help="a scene file, or a name in PROJECT/scenes")
    text = "EXR file to write, PNGs come beside it; default: PROJECT/renders/pyramid_SCENE.exr"
    add("-o", "--output", type=Path, help=text)
    add("--max-depth", type=WHOLE, default=5, help="longest path in edges; default: %(default)s")
    add("--spp", type=WHOLE, default=64, help="default: %(default)s")
    add("--seed", type=number(int, 0, 2**32 - 1), default=0, help="default: %(default)s")
    add("--resolution", type=WHOLE, help="width of the image; default: the file's")
    add("--heuristic", default="balance", help="default: %(default)s")
    add("--exposure", type=number(float, -100, 100), default=0.0, help="stops, of the pictures")


def _declare_fireflies(parser) -> None:
    add = parser.add_argument
    add("scenes", nargs="+", help=SCENES)
    add("--seeds", type=WHOLE, default=5, help="renders of each scene; default: %(default)s")
    add("--spp", type=WHOLE, default=64, help="default: %(default)s")
    _add_resolution(parser)
    add("--max-depth", type=WHOLE, help="default: that of presets/benchmark.toml, else of the scene's file")
    text = "values of its pixel by which a sample is off; default: %(default)s"
    add("--level", type=number(float, 1e-9), default=0.5, help=text)
    add("--top", type=WHOLE, default=12, help="samples examined of each render; default: %(default)s")
    add("--lines", type=WHOLE, default=6, help="kinds of paths of each scene; default: %(default)s")
    _add_reference_seconds(parser)


def _sweep(options: Namespace) -> int:
    from ..measure import sweep

    return sweep.run(options)


def _report(options: Namespace) -> int:
    from ..measure import report

    return report.run(options)


def _page(options: Namespace) -> int:
    from ..measure import page

    return page.run(options)


def _reference(options: Namespace) -> int:
    from ..measure import making

    return making.run(options)


def _compare(options: Namespace) -> int:
    from ..measure import compare

    return compare.run(options)


def _equal_time(options: Namespace) -> int:
    from ..measure import equal_time

    return equal_time.run(options)


def _pyramid(options: Namespace) -> int:
    from ..measure import pyramid

    return pyramid.run(options)


def _fireflies(options: Namespace) -> int:
    from ..measure import fireflies

    return fireflies.run(options)


COMMANDS: dict[str, tuple[str, Callable, Callable[[Namespace], int]]] = {
    "sweep": (
        "render scenes by several integrators, budgets and seeds: a row of times and errors for each render",
        _declare_sweep,
        _sweep,
    ),
    "report": ("tables and plots of a sweep, as Markdown", _declare_report, _report),
    "page": ("a sweep as one HTML file, with images to compare", _declare_page, _page),
    "reference": (
        "make references with an error estimate of their own",
        _declare_reference,
        _reference,
    ),
    "compare": (
        "two ways to render, alternating: time, error and efficiency of the first over the second",
        _declare_compare,
        _compare,
    ),
    "equal-time": ("a picture of integrators side by side at equal time", _declare_equal_time, _equal_time),
    "pyramid": ("an image of each strategy (s, t), as EXR and PNG", _declare_pyramid, _pyramid),
    "fireflies": ("the paths behind the worst values of a scene's renders", _declare_fireflies, _fireflies),
}
"""Help, declaration of the arguments and run of each subcommand."""
