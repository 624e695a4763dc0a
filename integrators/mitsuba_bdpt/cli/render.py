"""``python -m mitsuba_bdpt render``: from a scene file to an EXR and a PNG."""

from __future__ import annotations

import json
import math
import sys
import time
from argparse import Namespace
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field
from pathlib import Path

import drjit as dr
import mitsuba as mi
import numpy as np
from rich.console import Console
from rich.progress import BarColumn, Progress, SpinnerColumn, TextColumn

from ..errors import CommandError, message
from ..files.images import check_channels, check_png, prepare_output, write_images
from ..files.loading import check_file, choose_sensor, load
from ..host.versions import versions
from . import checkpoints, cluster
from .mistakes import INTERRUPTED

UNLIMITED_SPP = 1 << 16
"""Samples per pixel where only the time limits them."""

PASS_SPP = 16
"""Samples per pixel between two looks at the clock, for integrators that do not look themselves."""

SETS = {"time": {"timeout"}, "target_error": {"target_error", "until_error", "variance"}}
"""The integrator's parameters that an option sets, see `loading.load`."""


@dataclass
class Outcome:
    """What a finished or interrupted rendering leaves besides the film."""

    seconds: float
    spp: int
    interrupted: bool = False
    statistics: dict = field(default_factory=dict)


def run(options: Namespace) -> int:
    """Render as the command line `options` say and return the exit status."""
    try:
        check_file(options.scene)  # before a folder is made for its image
        output = options.output or Path("renders") / f"{options.scene.stem}.exr"
        prepare_output(output)
        check_options(options, output)
        scene, integrator = load(options)
        check_integrator(options, integrator)
        sensor = choose_sensor(scene, options.sensor)
        check_png(sensor.film())
        check_channels(sensor.film(), integrator.aov_names())
        open_ended = options.time is not None or options.target_error is not None
        spp = options.spp or (UNLIMITED_SPP if open_ended else sensor.sampler().sample_count())
        if not spp:
            raise CommandError(
                "The scene's sampler has sample_count=0: nothing is to be rendered; give --spp N."
            )
        outcome = render(scene, integrator, options, spp, output)
        if outcome.interrupted and not outcome.spp:
            print("interrupted before the first pass was over; no image written", file=sys.stderr)
            return INTERRUPTED
        attributes = {"bdptSettings": settings(options, spp), "bdptStatistics": report(outcome)}
        write_images(sensor.film(), output, attributes, options.exposure)
    except KeyboardInterrupt:
        print("interrupted; no image written", file=sys.stderr)
        return INTERRUPTED
    except (OSError, RuntimeError, TypeError, ValueError) as error:
        print(f"error: {message(error)}", file=sys.stderr)
        return 1
    print(summary(output, outcome, sensor.film().crop_size(), asked_error(integrator)))
    return INTERRUPTED if outcome.interrupted else 0


def explain(options: Namespace) -> int:
    """Print what a render as the command line `options` say would do, and return the exit status."""
    try:
        scene, integrator = load(options)
        sensor = choose_sensor(scene, options.sensor)
        spp = options.spp or sensor.sampler().sample_count()
        print(integrator.explain(scene, sensor, spp))
    except KeyboardInterrupt:
        print("interrupted", file=sys.stderr)
        return INTERRUPTED
    except (OSError, RuntimeError, TypeError, ValueError) as error:
        print(f"error: {message(error)}", file=sys.stderr)
        return 1
    return 0


def check_options(options: Namespace, output: Path) -> None:
    """Raise ``CommandError`` for options that contradict one another."""
    if options.resume and options.checkpoint is None:
        raise CommandError("resume needs --checkpoint MINUTES: how often to write the next ones.")
    if options.parts is not None and options.scheduler is None:
        raise CommandError("parts needs --scheduler: without one, a render is made in one piece.")
    for name in ("checkpoint", "target_error", "time"):
        if options.scheduler is not None and getattr(options, name) is not None:
            raise CommandError(
                f"scheduler together with {name} is not possible: parts are rendered elsewhere, all of them; "
                "leave out one or the other."
            )
    properties = dict(options.properties)
    for option, names in SETS.items():
        for name in names & set(properties):
            value = getattr(options, option)
            if value is not None and not (name == "variance" and properties[name] is True):
                raise CommandError(
                    f"-P {name}={properties[name]} together with --{option.replace('_', '-')} {value:g} is "
                    f"not possible: the option sets {name} itself; leave out one or the other."
                )
    checkpoints.check(options, output)


def check_integrator(options: Namespace, integrator: mi.Integrator) -> None:
    """Raise ``CommandError`` for options that only ``bdpt`` can follow, and for what these cannot."""
    for name in ("checkpoint", "scheduler"):
        if getattr(options, name) is not None and not hasattr(integrator, "assemble"):
            raise CommandError(
                f"{name} is for the integrator bdpt, not for {integrator.class_name()}; use "
                "--integrator bdpt."
            )
    if options.checkpoint is not None and integrator.settings.points == "sampler":
        raise CommandError(
            "checkpoint with points=sampler is not possible: a scene's sampler cannot start in the middle of "
            "its samples; use points=sobol."
        )
    if options.scheduler is not None:
        cluster.check_settings(integrator.settings)


def render(scene: mi.Scene, integrator: mi.Integrator, options: Namespace, spp: int, output: Path) -> Outcome:
    """Render into the sensor's film, drawing progress on a terminal."""
    if options.scheduler is not None:
        started = time.perf_counter()
        with progress_bar() as bar:
            statistics, interrupted = cluster.render(scene, integrator, options, spp, show_pass(bar, None))
        return Outcome(time.perf_counter() - started, sum(statistics["passes"]), interrupted, statistics)
    if options.time is not None and not hasattr(integrator, "on_pass"):
        return render_repeatedly(scene, integrator, options, spp)
    return render_here(scene, integrator, options, spp, output)


def render_here(scene, integrator, options: Namespace, spp: int, output: Path) -> Outcome:
    """Render in one go, with checkpoints if they are wanted."""
    started, interrupted, asked, arguments = time.perf_counter(), False, spp, {}
    watchers, kept, limit = [], None, options.time
    if options.checkpoint is not None:
        kept = checkpoints.Checkpoints(options, output)
        watchers.append(kept.after_pass)
    if options.resume:
        arguments["start"] = checkpoints.start(options, output)
        limit = limit and limit + arguments["start"].progress.work.seconds
    with progress_bar() as bar:
        if hasattr(integrator, "on_pass"):
            watchers.append(show_pass(bar, limit))
            integrator.on_pass = lambda report: [watch(report) for watch in watchers]
        try:
            integrator.render(
                scene, options.sensor, options.seed, spp, develop=False, evaluate=True, **arguments
            )
            dr.sync_thread()
        except KeyboardInterrupt:
            interrupted = True
    statistics = getattr(integrator, "statistics", None) or {}
    if "passes" in statistics:
        spp = int(sum(statistics["passes"]))
    elif interrupted:
        # Mitsuba's own integrators leave nothing behind.
        spp = 0
    if kept is not None:
        kept.end(finished=not interrupted and (spp == asked or reached(asked_error(integrator), statistics)))
    return Outcome(time.perf_counter() - started, spp, interrupted, statistics)


def asked_error(integrator) -> float:
    """The parameter ``target_error``, from wherever it comes; 0 for other integrators than `bdpt`."""
    return getattr(getattr(integrator, "settings", None), "target_error", 0)


def reached(asked: float, statistics: Mapping) -> bool:
    """Whether the error that was ``asked`` for, if not 0, is reached."""
    return 0 < asked and statistics["error"] <= asked


def render_repeatedly(scene, integrator, options: Namespace, spp: int) -> Outcome:
    """Render with one seed after the other until the time is over, and leave the mean in the film.

    Mitsuba's integrators render all samples at once in vectorised variants, whatever their timeout.
    """
    started, done, total, interrupted = time.perf_counter(), 0, 0.0, False
    film = choose_sensor(scene, options.sensor).film()
    try:
        while done < spp and (done == 0 or time.perf_counter() - started < options.time):
            size, seed = min(PASS_SPP, spp - done), options.seed + done // PASS_SPP
            integrator.render(scene, options.sensor, seed, size, develop=False, evaluate=True)
            # Raw sums with their weights: passes of any size and filter add up.
            total = total + size * np.array(film.develop(raw=True), dtype=np.float64)
            done += size
    except KeyboardInterrupt:
        interrupted = True
    if done:
        film.prepare(integrator.aov_names())
        mean = mi.TensorXf((total / done).astype(np.float32))
        film.put_block(mi.ImageBlock(mean, film.crop_offset(), border=False))
    return Outcome(time.perf_counter() - started, done, interrupted)


def progress_bar() -> Progress:
    """A bar on standard error, silent where that is not a terminal."""
    console = Console(stderr=True)
    columns = (SpinnerColumn(), BarColumn(), TextColumn("{task.description}"))
    return Progress(*columns, console=console, transient=True, disable=not console.is_terminal)


def show_pass(bar: Progress, limit: float | None) -> Callable[[object], None]:
    """Start a task on `bar`; the result is to be called with a report after every pass."""
    task = bar.add_task("rendering", total=None)

    def draw(report) -> None:
        done = report.spp_done / report.spp_total
        left = report.seconds * (1 / max(done, 1e-9) - 1)
        if limit:
            left = max(0.0, min(left, limit - report.seconds))
            done = max(done, min(1.0, report.seconds / limit))
        rate = readable(report.rays / max(report.seconds, 1e-9))
        open_ended = report.spp_total == UNLIMITED_SPP
        text = f"{report.spp_done}{'' if open_ended else f'/{report.spp_total}'} spp, {rate} rays/s"
        if limit or not open_ended:
            text += f", {left:.0f} s left"
        if getattr(report, "error", None) is not None:
            text += f", relMSE {report.error:.2g}"
        bar.update(task, total=1.0, completed=done, description=text)

    return draw


def settings(options: Namespace, spp: int) -> str:
    """The command line as JSON, for the header of the image."""
    values = {key: str(v) if isinstance(v, Path) else v for key, v in vars(options).items()}
    values |= {"spp": spp, "defines": dict(options.defines)}
    values["properties"] = dict(options.properties)
    return json.dumps(values)


def report(outcome: Outcome) -> str:
    """What was rendered, and with what, as JSON for the header of the image."""
    own = {
        "wall_seconds": round(outcome.seconds, 3),
        "spp": outcome.spp,
        "interrupted": outcome.interrupted,
        "versions": versions(),
    }
    found = own | outcome.statistics
    if found.get("error") == math.inf:  # which JSON does not know
        found["error"] = None
    # A value that JSON does not know must not cost a finished image.
    return json.dumps(found, default=str)


def summary(output: Path, outcome: Outcome, size: Iterable[int], target_error: float) -> str:
    """The closing line."""
    width, height = size
    parts = [
        f"{output}: {outcome.seconds:.1f} s",
        f"{outcome.spp} spp ({readable(outcome.spp * width * height)} samples)",
    ]
    rays = outcome.statistics.get("rays")
    if rays:
        kinds = ", ".join(f"{kind} {readable(count)}" for kind, count in rays.items())
        parts.append(f"{readable(sum(rays.values()))} rays ({kinds})")
    if "error" in outcome.statistics:
        error = outcome.statistics["error"]
        missed = 0 < target_error < error
        text = f"relMSE about {error:.2g}" if math.isfinite(error) else "relMSE not known"
        if missed:
            text += f", not the {target_error:g} asked for: that takes more samples (--spp, --time)"
        parts.append(text)
    if outcome.statistics.get("no_pilot"):
        parts.append(f"no pilot: {outcome.statistics['no_pilot']}")
    if outcome.statistics.get("non_finite"):
        parts.append(f"{outcome.statistics['non_finite']} values were not finite and count as zero")
    parts.append(", ".join(f"{name} {version}" for name, version in versions().items()))
    if outcome.interrupted:
        parts.append("interrupted")
    return "; ".join(parts)


def readable(number: float) -> str:
    """A number to three digits with a unit prefix."""
    for limit, unit in ((1e9, " G"), (1e6, " M"), (1e3, " k")):
        if number >= limit:
            return f"{number / limit:.3g}{unit}"
    return f"{number:.3g}"
