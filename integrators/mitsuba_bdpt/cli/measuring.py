"""The subcommands that measure, with the extra ``[measure]``.

`measure` is imported when one of them runs, since it needs further packages.
"""

from __future__ import annotations

import argparse
import importlib
import importlib.util
from argparse import Namespace
from collections.abc import Callable
from pathlib import Path

from ..errors import CommandError
from ..measure import options
from . import mistakes
from .values import property_

NEEDED = "colour flip_evaluator jinja2 markdown_it matplotlib pandas pyarrow pydantic scipy tabulate".split()
"""What the extra ``[measure]`` installs, as modules."""


def run(arguments: Namespace) -> int | None:

    def measured() -> int:
        check_installed(arguments.command)
        module = COMMANDS[arguments.command][1]
        return importlib.import_module(f"..measure.{module}", __package__).run(arguments)

    return mistakes.answered(measured, "interrupted; what was finished is kept, and the same command goes on")


def check_installed(command: str) -> None:
    missing = [name for name in NEEDED if importlib.util.find_spec(name) is None]
    if missing:
        raise CommandError(
            f"{command} needs {', '.join(missing)}; install them with: pip install 'mitsuba-bdpt[measure]'"
        )


def add_commands(add_command: Callable[[str, str], argparse.ArgumentParser]) -> None:
    """Declare all subcommands; ``add_command(name, help)`` returns a parser."""
    for name, (help_text, _, kind, *others) in COMMANDS.items():
        parser = add_command(name, help_text)
        text = "folder with scenes/, references/, presets/, results/; default: the current one"
        parser.add_argument("--project", type=Path, default=Path(), metavar="DIR", help=text)
        for *names, settings in others:
            parser.add_argument(*names, **settings)
        if kind is not None:
            declare(parser, kind)


def integrator(text: str) -> tuple[str, dict]:
    """Argparse type: ``TYPE KEY=VALUE …``; returns the text and a plugin's parameters."""
    kind, *properties = text.split() or [""]
    if not kind or "=" in kind:
        raise argparse.ArgumentTypeError(f"got {text!r}, which must have the form TYPE KEY=VALUE …")
    return text, {"type": kind} | dict(map(property_, properties))


def declare(parser: argparse.ArgumentParser, kind: type) -> None:
    for field in options.options_of(kind):
        given, values = dict(field.metadata["declared"]), field.metadata["kind"]
        names = [given.pop("short")] if "short" in given else []
        given["choices" if isinstance(values, tuple) else "type"] = values
        names.append(f"--{field.name.replace('_', '-')}")
        parser.add_argument(*names, default=field.default, help=field.metadata["text"], **given)


_SCENE = ("scene", {"help": "a scene file, or a name in PROJECT/scenes"})
_SCENES = {"help": "scene files, or names in PROJECT/scenes"}
_FOLDER = ("folder", {"help": "what sweep has filled, or a name in PROJECT/results"})
_CONFIGURATION = "TYPE KEY=VALUE …, in quotes; sampler=TYPE is the sensor's sampler"
_INTEGRATORS = "TYPE KEY=VALUE …, each in quotes; default: path (with media: volpath) and bdpt"

COMMANDS: dict[str, tuple] = {
    "sweep": (
        "render scenes by several integrators, budgets and seeds: a row of times and errors for each render",
        "sweep",
        options.Sweep,
        ("preset", {"help": "TOML file, or a name in PROJECT/presets: what is rendered"}),
    ),
    "report": ("tables and plots of a sweep, as Markdown", "report", options.Report, _FOLDER),
    "figure": ("a figure of a sweep for a paper, as PDF, SVG or PNG", "figures", options.Figure, _FOLDER),
    "page": (
        "a sweep as one HTML file, with images to compare",
        "page",
        options.Report,
        _FOLDER,
        ("-o", "--output", {"type": Path, "help": "default: FOLDER/page.html"}),
    ),
    "reference": (
        "make references with an error estimate of their own",
        "making",
        options.MakeReference,
        ("scenes", {"nargs": "*"} | _SCENES),
        ("--all", {"action": "store_true", "help": "all scenes of PROJECT/scenes"}),
    ),
    "compare": (
        "two configurations, rendered alternately: time, error, efficiency of the first over the second",
        "compare",
        options.Compare,
        (
            "sides",
            {
                "nargs": 2,
                "type": lambda text: integrator(text)[1],
                "metavar": "CONFIGURATION",
                "help": _CONFIGURATION,
            },
        ),
        ("--scenes", {"nargs": "+", "required": True} | _SCENES),
    ),
    "equal-time": (
        "a picture of integrators side by side at equal time",
        "equal_time",
        options.EqualTime,
        _SCENE,
        ("-i", "--integrators", {"nargs": "+", "type": integrator, "default": [], "help": _INTEGRATORS}),
    ),
    "pyramid": ("an image of each strategy (s, t), as EXR and PNG", "pyramid", options.Pyramid, _SCENE),
}
"""Help, module of `measure` whose ``run`` does it, options, and further arguments, of each subcommand."""
