"""``python -m mitsuba_bdpt render``: from a scene file to an EXR and a PNG."""

from __future__ import annotations

import json
import math
import sys
import tempfile
import time
from argparse import Namespace
from collections.abc import Callable, Iterable, Mapping
from contextlib import closing
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from ..errors import CommandError, FailureError
from ..files.images import STATISTICS, check_channels, check_output, write_images, write_png
from ..files.loading import Loaded, check_file, choose_sensor, load
from ..files.texts import write_json
from ..files.whole import check_writable
from ..host import memory, signals
from ..host.introspection import versions
from ..progress import Report, display, readable
from ..run.rendering import PassReport
from . import checkpoints, cluster
from .mistakes import INTERRUPTED, USAGE, Ending, answered, in_words, status_of, terminable

UNLIMITED_SPP = 1 << 16  # samples per pixel where only the time limits them
PASS_SPP = 16  # samples per pixel between two looks at the clock, for integrators that do not look themselves

STOPPING = "interrupted; stopping after this pass"


@dataclass
class Outcome:
    """Result of a finished or interrupted render, beside the film."""

    seconds: float
    spp: int
    interrupted: bool = False
    statistics: dict = field(default_factory=dict)
    error: Exception | None = None  # what has ended it before its end, if something else than a signal has
    written: Callable[[], object] = lambda: None  # to be called when the image is written


def run(options: Namespace) -> int | None:
    return _ended(lambda ending: _run(options, ending))


def _ended(command: Callable[[Ending], int]) -> int | None:
    with terminable() as ending:
        status = answered(lambda: command(ending), signals.NOTHING_WRITTEN)
    return ending.status if status == INTERRUPTED else status


def _run(options: Namespace, ending: Ending) -> int:
    check_file(options.scene)  # before creating the image's folder
    options.output = options.output or Path("renders") / f"{options.scene.stem}.exr"
    check_output(options.output, ".exr")
    if options.statistics is not None:
        options.statistics.parent.mkdir(parents=True, exist_ok=True)
        check_writable(options.statistics)
    check_options(options)
    scene, integrator, used = loaded(options, ending)
    check_integrator(options, integrator)
    film = choose_sensor(scene, options.sensor).film()
    check_channels(film, integrator.aov_names())
    spp = samples_per_pixel(scene, options)
    print(f"integrator: {used}", file=sys.stderr)
    try:
        outcome = render(scene, integrator, options, spp)
        ending.patient = True
        is_whole = finish(film, integrator, options, outcome, spp)
    except OSError as error:  # errors about paths were raised before
        raise FailureError(in_words(error)) from error
    return 0 if is_whole and not ending.signalled else ending.status


def loaded(options: Namespace, ending: Ending) -> Loaded:
    """Like `load`; also sets the memory limit and number of threads of the process.

    A signal ends the process at once (see `signals`), or the command when all is loaded.
    """
    memory.set_limit(options.memory and options.memory * 2**30)
    ending.patient = True  # an exception would break imports
    try:
        found = load(options)
    except RuntimeError as error:
        if status_of(error) == USAGE or "Traceback (most" in str(error):  # of a plugin in Python
            raise
        raise CommandError(in_words(error)) from error
    finally:
        signals.end_later()
        ending.patient = False
    if ending.signalled:
        raise KeyboardInterrupt
    if options.threads is not None:
        dr.set_thread_count(options.threads)
    return found


def finish(film: mi.Film, integrator: mi.Integrator, options: Namespace, outcome: Outcome, spp: int) -> bool:
    """Write an image, then remove its checkpoint; returns whether it was completed."""
    if outcome.interrupted and not outcome.spp:
        print("interrupted before the first pass was over; no image written", file=sys.stderr)
        return False
    pairs = {name: dict(getattr(options, name)) for name in ("defines", "properties")}
    settings, found = plain(vars(options) | {"spp": spp} | pairs), report(outcome)
    no_png = write(film, options, {"bdptSettings": json.dumps(settings), STATISTICS: json.dumps(found)})
    if options.statistics is not None:
        write_json(options.statistics, {"settings": settings} | found)
    outcome.written()
    print_line(summary(options, outcome, film, integrator.settings if is_ours(integrator) else None, spp))
    if outcome.error is not None:
        raise outcome.error
    if no_png:
        raise FailureError(no_png)
    return not outcome.interrupted


def samples_per_pixel(scene: mi.Scene, options: Namespace) -> int:
    """Return the samples per pixel, at most; ``CommandError`` if none."""
    if is_open_ended(options):
        return UNLIMITED_SPP
    spp = options.spp or choose_sensor(scene, options.sensor).sampler().sample_count()
    if not spp:
        raise CommandError("The scene's sampler has sample_count=0: nothing is to be rendered; give --spp N.")
    return spp


def is_open_ended(options: Namespace) -> bool:
    """Return whether only time or error ends the render."""
    return not options.spp and (options.time is not None or options.target_error is not None)


def write(film: mi.Film, options: Namespace, attributes: Mapping[str, str]) -> str:
    """Write the image; where that fails into a temporary folder, which the error names.

    Returns why there is no PNG, see `write_images`.
    """
    try:
        return write_images(film, options.output, attributes, options.exposure)
    except OSError as error:
        error.filename = error.filename or str(options.output)
        rescued = Path(tempfile.mkdtemp(prefix="mitsuba-bdpt-")) / options.output.name
        try:
            write_images(film, rescued, attributes, options.exposure)
        except OSError:
            raise error from None
        raise FailureError(f"{in_words(error)}; the image is {str(rescued)!r} instead") from error


def print_line(line: str) -> None:
    """Print a ``line``; a closed stream must not end the render."""
    try:
        print(line, flush=True)
    except OSError as error:
        sys.stdout = None
        if not isinstance(error, BrokenPipeError):  # a reader such as head may close early
            print(f"warning: standard output: {error}", file=sys.stderr)


def explain(options: Namespace) -> int | None:

    def explained(ending: Ending) -> int:
        scene, integrator, _ = loaded(options, ending)
        sensor = choose_sensor(scene, options.sensor)
        print_line(integrator.explain(scene, sensor, options.spp or sensor.sampler().sample_count()))
        return 0

    return _ended(explained)


def check_options(options: Namespace) -> None:
    given = {name for name, value in vars(options).items() if value is not None}
    for name, other in (("resume", "checkpoint"), ("parts", "scheduler")):
        if name in given and other not in given:
            raise CommandError(f"{name} needs --{other}; give it too, or leave out --{name}.")
    for name in ("checkpoint", "target_error", "time", "threads", "memory"):
        if {"scheduler", name} <= given:
            raise CommandError(f"scheduler together with {name} is not possible; leave out one or the other.")
    for option, name in (("time", "timeout"), ("target_error", "target_error")):  # see `loading.load`
        if option in given and name in dict(options.properties):
            raise CommandError(f"-P {name}=X sets what --{option.replace('_', '-')} sets; leave out one.")
    if options.checkpoint is not None:
        check_writable(checkpoints.path_of(options.output))


def check_integrator(options: Namespace, integrator: mi.Integrator) -> None:
    """Raise ``CommandError`` for options that the integrator does not support."""
    for name in ("checkpoint", "scheduler", "preview", "memory"):
        if getattr(options, name) is not None and not is_ours(integrator):
            raise CommandError(
                f"{name} is for the integrator bdpt, not for {integrator.class_name()}; use "
                "--integrator bdpt."
            )
    if options.scheduler is not None:
        cluster.check_settings(integrator.settings)


def render(scene: mi.Scene, integrator: mi.Integrator, options: Namespace, spp: int) -> Outcome:
    film = choose_sensor(scene, options.sensor).film()
    if not is_ours(integrator):
        return render_foreign(scene, integrator, options, spp)
    watchers = [] if options.preview is None else [preview(options, film)]
    if options.scheduler is None:
        return render_here(scene, integrator, options, spp, watchers)
    started = time.perf_counter()
    with closing(display(options.progress)) as shown:
        watch = partial(_call_all, [shown, *watchers])
        statistics, ended = cluster.render(scene, integrator, options, spp, watch)
    seconds, done = time.perf_counter() - started, sum(statistics["passes"])
    error = ended if isinstance(ended, Exception) else None
    return Outcome(seconds, done, ended is not None, statistics=statistics, error=error)


def preview(options: Namespace, film: mi.Film) -> Callable[[PassReport], None]:
    """Return a watcher that rewrites the PNG with the image so far, first after the first pass.

    A PNG that cannot be written does not end the render.
    """
    path, last = options.output.with_suffix(".png"), -math.inf

    def shown(report: PassReport) -> None:
        nonlocal last
        if time.monotonic() - last < options.preview:
            return
        report.image()
        try:
            write_png(film, film.bitmap(), path, options.exposure)
        except (OSError, RuntimeError) as error:  # Mitsuba's for an image that is too large for a PNG
            print(f"warning: no preview {str(path)!r}: {error}", file=sys.stderr)
        last = time.monotonic()

    return shown


def _call_all(watchers: Iterable[Callable], report: PassReport) -> None:
    for watcher in watchers:
        watcher(report)


def render_here(scene, integrator, options: Namespace, spp: int, watchers: list) -> Outcome:
    """Render in this process, with checkpoints if requested."""
    started, interrupted = time.perf_counter(), False
    integrator.statistics = {}  # not those of the previous render
    kept, limit = None, options.time
    start = checkpoints.start(options)
    if start is not None:
        total = start.identity["spp"]
        print(f"resume: the checkpoint has {start.spp} of {total} samples per pixel", file=sys.stderr)
        limit = limit and limit + start.progress.work.seconds
    if options.checkpoint is not None:
        kept = checkpoints.Checkpoints(options, start)
        watchers = [kept.after_pass, *watchers]
    with closing(display(options.progress, limit, is_open_ended(options))) as shown:
        integrator.on_pass = partial(_call_all, [*watchers, shown])
        try:
            with signals.announced(STOPPING):
                integrator.render(scene, options.sensor, options.seed, spp, develop=False, start=start)
                dr.sync_thread()
        except KeyboardInterrupt:
            interrupted = True
        finally:
            integrator.on_pass = None
    statistics, target = integrator.statistics, integrator.settings.target_error
    done = int(sum(statistics.get("passes", ())))
    outcome = Outcome(time.perf_counter() - started, done, interrupted, statistics=statistics)
    if kept is not None:
        whole = done == spp or (0 < target and statistics.get("error", math.inf) <= target)
        # A finished render keeps it until the image is written.
        if whole and not interrupted:
            outcome.written = kept.remove
        else:
            kept.written_at_end(done)
    return outcome


def is_ours(integrator: mi.Integrator) -> bool:
    return hasattr(integrator, "assemble")


def render_foreign(scene, integrator, options: Namespace, spp: int) -> Outcome:
    """Render by an integrator of Mitsuba's.

    They ignore their timeout in vectorised variants: under a time limit, renders with consecutive seeds until
    it is over; the film has the mean.
    """
    started, done, total, interrupted = time.perf_counter(), 0, 0.0, False
    film, limit = choose_sensor(scene, options.sensor).film(), options.time
    size = spp if limit is None else min(PASS_SPP, spp)
    with closing(display(options.progress, limit, is_open_ended(options))) as shown:
        try:
            while done < spp and (done == 0 or time.perf_counter() - started < limit):
                size, seed = min(size, spp - done), options.seed + done // PASS_SPP
                with signals.announced(STOPPING):
                    integrator.render(scene, options.sensor, seed, size)
                    dr.sync_thread()
                if limit is not None:
                    # Raw sums include their weights, so passes of any size add up.
                    total = total + size * np.array(film.develop(raw=True), dtype=np.float64)
                done += size
                shown(Report(done, spp, time.perf_counter() - started, 0, None))
        except KeyboardInterrupt:
            interrupted = True
    if done and limit is not None:
        film.prepare(integrator.aov_names())
        mean = mi.TensorXf((total / done).astype(np.float32))
        film.put_block(mi.ImageBlock(mean, film.crop_offset(), border=False))
    return Outcome(time.perf_counter() - started, done, interrupted)


def report(outcome: Outcome) -> dict:
    """Return what was rendered, and with which versions, as JSON values."""
    own = {
        "wall_seconds": round(outcome.seconds, 3),
        "spp": outcome.spp,
        "interrupted": outcome.interrupted,
        "resident_memory": memory.peak(),
        "versions": versions(),
    }
    return plain(own | outcome.statistics)


def plain(value) -> Any:
    """Convert a ``value`` to JSON: None if non-finite, text for other objects."""
    if isinstance(value, Mapping):
        return {str(key): plain(held) for key, held in value.items()}
    if isinstance(value, list | tuple):
        return [plain(held) for held in value]
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return value if value is None or isinstance(value, str | int | float) else str(value)


def stopped_by(options: Namespace, parameters, outcome: Outcome, spp: int) -> str:
    """Return what ended a render before all of its ``spp`` samples per pixel; empty if nothing did.

    With the time of compilation if that is a large part of a time limit.
    """
    if outcome.interrupted or outcome.spp >= spp:
        return ""
    done = f"{outcome.spp} spp" if is_open_ended(options) else f"{outcome.spp} of {spp} spp"
    target, limit = (parameters.target_error, parameters.timeout) if parameters else (0, options.time)
    if 0 < target and outcome.statistics.get("error", math.inf) <= target:
        return f"stopped by target_error={target:g} after {done}"
    if limit is None or limit < 0:
        return ""
    compiling = outcome.statistics.get("seconds", {}).get("compile", 0)
    spent = f", compiling took {compiling:.0f} s" if compiling > max(limit / 4, 1) else ""
    return f"stopped by the time limit of {limit:g} s after {done}{spent}"


def summary(options: Namespace, outcome: Outcome, film: mi.Film, parameters, spp: int) -> str:
    """Return the closing line; ``parameters``: `Settings`, or None of other integrators."""
    statistics, (width, height) = outcome.statistics, film.crop_size()
    parts = [
        f"{options.output}: {outcome.seconds:.1f} s",
        f"{outcome.spp} spp ({readable(outcome.spp * width * height)} samples)",
        stopped_by(options, parameters, outcome, spp),
    ]
    if rays := statistics.get("rays"):
        kinds = ", ".join(f"{kind} {readable(count)}" for kind, count in rays.items())
        parts.append(f"{readable(sum(rays.values()))} rays ({kinds})")
    if "error" in statistics:
        error, target = statistics["error"], parameters.target_error
        parts.append(f"relMSE about {error:.2g}" if math.isfinite(error) else "relMSE not known")
        if 0 < target < error:
            parts[-1] += f", not the {target:g} asked for: that takes more samples (--spp, --time)"
    if statistics.get("no_pilot"):
        parts.append(f"no pilot: {statistics['no_pilot']}")
    parts.append("interrupted" if outcome.interrupted else "")
    return "; ".join(filter(None, parts))
