"""The command ``python -m mitsuba_bdpt`` (also installed as ``mitsuba-bdpt``).

``render`` renders a scene file; ``explain`` describes such a render; ``mix`` weights its layers anew;
``doctor`` checks the installation; `measuring` declares the commands that measure. Mitsuba is imported inside
`main`, because `doctor` has to run where that import fails.
"""

from __future__ import annotations

import argparse
import io
import re
import sys
from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import ClassVar, NoReturn

import mitsuba_bdpt

from ..errors import did_you_mean
from ..host import signals
from ..measure.options import SECONDS, SEED, STOPS, WHOLE, Number
from ..progress import KINDS
from ..settings import PARAMETERS, REPLACED
from . import measuring, mistakes
from .values import crop, definition, property_, size, weight

DEFAULT_VARIANT = "llvm_ad_rgb"


def main(arguments: Sequence[str] | None = None) -> int | None:
    """Run a command line (default: the process's own) and return its exit status."""
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):  # output must not fail for its encoding
            stream.reconfigure(errors="backslashreplace")
    parser = build_parser()
    options = parser.parse_args(arguments)
    if options.command not in ("render", "explain"):  # those load a scene first
        signals.end_later()
    if options.command == "doctor":
        from . import doctor

        return doctor.run(options.variant)
    if mitsuba_bdpt.failure is not None:
        print(f"error: {mitsuba_bdpt.failure}", file=sys.stderr)
        return mistakes.FAILURE
    from . import log, render

    with log.lines(getattr(options, "verbose", 0)):
        if options.command in measuring.COMMANDS:
            return measuring.run(options)
        if options.command == "mix":
            from . import mix

            return mistakes.answered(lambda: mix.run(options))
        return render.explain(options) if options.command == "explain" else render.run(options)


class Parser(argparse.ArgumentParser):
    """A parser without abbreviations, which suggests commands and options."""

    known: ClassVar[dict[str, None]] = {}  # names of commands and options of all parsers, each once

    def __init__(self, **settings):
        # An abbreviation may become ambiguous in the next version.
        super().__init__(allow_abbrev=False, **settings)

    def add_argument(self, *names, **settings):
        self.known.update(dict.fromkeys(name for name in names if name.startswith("-")))
        return super().add_argument(*names, **settings)

    def error(self, message: str) -> NoReturn:
        """End the process with a usage error, in one line."""
        wrong = re.search(r"(?:COMMAND: invalid choice: '|unrecognized arguments: )([^\s'=]*)", message)
        name = wrong[1] if wrong else ""
        parameter = name.lstrip("-").replace("-", "_")
        option = f"--{parameter.replace('_', '-')}"
        if option != name and option in self.known:
            question = f"did you mean {option}?"
        elif parameter in PARAMETERS:
            question = f"that is a parameter of the integrator: -P {parameter}=VALUE"
        else:
            is_unknown = wrong and name not in self.known  # else of another command
            question = REPLACED.get(name) or (did_you_mean(name, self.known) if is_unknown else "")
        question = question.rstrip() or f"see {self.prog} --help"
        self.exit(mistakes.USAGE, f"{self.prog}: error: {message}; {question}\n")


def build_parser() -> argparse.ArgumentParser:
    parser = Parser(
        prog="mitsuba-bdpt", description="Bidirectional path tracing for Mitsuba 3.", epilog=mistakes.STATUSES
    )
    parser.add_argument("--version", action="version", version=f"mitsuba-bdpt {mitsuba_bdpt.__version__}")
    commands = parser.add_subparsers(dest="command", required=True, metavar="COMMAND")

    def add_command(name: str, text: str) -> Parser:
        parser.known[name] = None
        return commands.add_parser(name, help=text, description=text)

    doctor = add_command("doctor", "print versions, variants and the LLVM library, and render a tiny image")
    doctor.add_argument("-m", "--variant", default=DEFAULT_VARIANT, help="default: %(default)s")
    add_render_arguments(add_command("render", "render a Mitsuba scene file to an EXR and a PNG image"))
    text = "list the strategies that a render of a scene file uses and skips, and the paths that none samples"
    explain = add_command("explain", text)
    add_scene_arguments(explain)
    explain.set_defaults(integrator="bdpt", time=None, target_error=None, denoise=False)
    add_mix_arguments(
        add_command("mix", "weight light groups or path layers of a rendered image anew, without a render")
    )
    measuring.add_commands(add_command)
    return parser


def add_mix_arguments(parser: argparse.ArgumentParser) -> None:
    add = parser.add_argument
    add("image", type=Path, help="EXR file that was rendered with light_groups or path_layers")
    text = (
        "factor of a group or path layer, or three for red, green and blue; 1 for others; * and ? in a name "
        "stand for any characters; without any, the layers are listed"
    )
    add("weights", type=weight, nargs="*", metavar="LAYER=X[,Y,Z]", help=text)
    text = "PNG or EXR file to write (beside an EXR a PNG); default: IMAGE.mixed.png"
    add("-o", "--output", type=Path, help=text)
    add("-m", "--variant", default=DEFAULT_VARIANT, help="default: %(default)s")
    add("--exposure", type=STOPS, default=0.0, metavar="EV", help="brightness of the PNG in stops")


def add_scene_arguments(parser: argparse.ArgumentParser) -> None:
    add = parser.add_argument
    add("scene", type=Path, help="scene file in Mitsuba's XML format")
    add("-m", "--variant", default=DEFAULT_VARIANT, help="Mitsuba variant; default: %(default)s")
    add("--spp", type=WHOLE, help="samples per pixel; default: the scene's")
    repeated = partial(add, action="append", default=[])
    repeated("-D", dest="defines", type=definition, metavar="K=V", help="parameter of the scene; repeatable")
    text = "parameter of the integrator, such as skip=none; repeatable"
    repeated("-P", dest="properties", type=property_, metavar="K=V", help=text)
    text = "folder in which files that the scene names are looked for, after the scene's own; repeatable"
    repeated("-a", "--append", type=Path, metavar="FOLDER", help=text)
    add("-s", "--sensor", type=Number(int, 0), default=0, metavar="INDEX", help="of the sensor; default: 0")
    add("--size", type=size, metavar="WxH", help="size of the image: of all films but meters'")
    add("--crop", type=crop, metavar="X,Y,W,H", help="render this part of the image alone, in pixels")
    add("--threads", type=WHOLE, metavar="N", help="number of threads; default: one for each core")
    text = "memory that the process may take; default: limits of the machine, its control groups and ulimit"
    add("--memory", type=Number(float, 1e-3), metavar="GIB", help=text)
    add("-v", "--verbose", action="count", default=0, help="log more: info (-v), debug (-vv), trace (-vvv)")


def add_render_arguments(parser: argparse.ArgumentParser) -> None:
    add_scene_arguments(parser)
    add = parser.add_argument
    text = "EXR file to write, a PNG comes beside it, folders are made; default: renders/SCENE.exr"
    add("-o", "--output", type=Path, help=text)
    text = "stop after the first pass that ends later than SECONDS; without --spp, at 65536 spp at the latest"
    add("--time", type=SECONDS, metavar="SECONDS", help=text)
    text = "stop at this estimated relMSE, at 65536 spp or --spp at the latest; adds layers of the variance"
    add("--target-error", type=Number(float, 1e-12), metavar="X", help=text)
    text = "write a checkpoint beside the image every MINUTES; deleted when the render is finished"
    add("--checkpoint", type=Number(float, 0), metavar="MINUTES", help=text)
    text = (
        "continue from the checkpoint of an interrupted render: auto (default) if there is one, must (also "
        "--resume without a value) or end with an error, never (begin anew)"
    )
    add("--resume", nargs="?", choices=("auto", "must", "never"), const="must", help=text)
    text = "JSON file to write with what was rendered: seconds, rays, passes, decisions, memory, versions"
    add("--statistics", type=Path, metavar="FILE", help=text)
    text = "bar, lines (for logs, from ten seconds on) or none; default: a bar on a terminal, lines elsewhere"
    add("--progress", choices=KINDS, default="auto", help=text)
    add("--preview", type=SECONDS, metavar="SECONDS", help="rewrite the PNG every SECONDS while it renders")
    text = "render in parts on the workers of a dask.distributed scheduler (extra [cluster])"
    add("--scheduler", metavar="ADDRESS", help=text)
    add("--parts", type=WHOLE, metavar="N", help="of a render on a cluster; default: 4 for each worker")
    text = "add a denoised image as a layer, which the PNG then shows (extra [denoise]); the raw one stays"
    add("--denoise", action="store_true", help=text)
    text = (
        "integrator to render with, or scene for the scene file's own; it takes over the file's max_depth, "
        "rr_depth, hide_emitters, timeout and layers of aov; default: %(default)s"
    )
    add("--integrator", default="bdpt", metavar="TYPE", help=text)
    add("--seed", type=SEED, default=0, help="of the random numbers; default: %(default)s")
    add("--exposure", type=STOPS, default=0.0, metavar="EV", help="brightness of the PNG in stops")
