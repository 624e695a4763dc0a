"""Render all scenes of scenes/ for hours, and look for values that are not finite.

    python scripts/endurance.py --seconds 3600     # adds an hour to docs/reports/endurance.json
    python scripts/endurance.py                    # until the scenes have 1e10 camera samples together
    python scripts/endurance.py --show             # the record, as a table

The scene that had the least time comes next, with another seed, another size and another heuristic each
time, and skip=auto and skip=none in turn. Every render is added to the record at once; Ctrl-C ends the one
that runs after its pass, a second Ctrl-C at once, and then it is not in the record. A scene of which several
renders have failed is left out until the plugin's source is another. A run that adds to the record of the
project ends by writing the table between the lines `<!-- report: endurance -->` and `<!-- end -->` of
docs/reports/endurance.md.

Exit status 130 if the run was interrupted; else 1 if the record has a value that is not finite or a render
that failed, of whatever version; 2 for a mistake, 0 if all is well.
"""

from __future__ import annotations

import json
import math
import signal
import sys
import time
from contextlib import contextmanager, suppress
from pathlib import Path

import command_line
import mitsuba_bdpt  # noqa: F401  (chooses LLVM before Dr.Jit is imported)
import numpy as np
import repository
from mitsuba_bdpt.cli.mistakes import INTERRUPTED, answered
from mitsuba_bdpt.cli.values import number
from mitsuba_bdpt.files.texts import write_json, write_text
from mitsuba_bdpt.host import memory
from mitsuba_bdpt.measure import reference
from mitsuba_bdpt.measure.tables import replace_part, table
from mitsuba_bdpt.settings import HEURISTICS

import mitsuba as mi  # isort: skip
import drjit as dr  # isort: skip

RECORD = repository.ROOT / "docs" / "reports" / "endurance.json"
PAGE = repository.ROOT / "docs" / "reports" / "endurance.md"

# Camera samples of all scenes together.
TARGET = 10**10

# One render ends after so many camera samples or so many seconds: starting costs little, settings change.
RENDER_SAMPLES, RENDER_SECONDS = 1 << 28, 40.0

# Widths in turn; a prime number, and one more and one less than a power of two, for what divides evenly.
SIZES = (256, 127, 640, 65, 512, 31)

SKIPS = ("auto", "none")

# Renders of a scene that may fail before it is left out.
MOST_FAILURES = 3

# Counts of a record that must be 0. (`failed` is a list of texts.)
WRONG = ("non_finite", "non_finite_in_pilot", "pixels_not_finite", "failed")


def settings(number: int) -> tuple[dict, int]:
    """Parameters of the plugin and width of the film for the ``number``-th render of a scene.

    Over 24 renders every size meets both kinds of skip and every heuristic.
    """
    turn = number // len(SKIPS)
    return {
        "skip": SKIPS[number % len(SKIPS)],
        "heuristic": HEURISTICS[turn % len(HEURISTICS)],
    }, SIZES[turn // len(HEURISTICS) % len(SIZES)]


def read(path: Path) -> dict:
    """The record: scenes by name; empty if there is none."""
    return json.loads(path.read_text()) if path.exists() else {"scenes": {}}


def empty() -> dict:
    """What is known of a scene before its first render."""
    return {
        "samples": 0,
        "non_finite": 0,
        "non_finite_in_pilot": 0,
        "pixels_not_finite": 0,
        "seconds": 0.0,
        "renders": 0,
        "kernels_compiled": 0,
        "peak_memory": 0,
        "failed": [],
        "failed_by_source": {},
        "samples_by": {},
    }


def reset_peak() -> None:
    """Let `peak` begin anew, where the system can."""
    dr.detail.malloc_clear_statistics()
    with suppress(OSError):  # then it is that of all renders of this process
        Path("/proc/self/clear_refs").write_text("5")


def peak() -> int:
    """The most memory that this process had since `reset_peak`, in bytes."""
    return memory.peak() or 0


class Interruption:
    """Whether Ctrl-C or SIGTERM came.

    No exception: Python drops one that comes in a destructor, and Mitsuba makes another one of it while it
    loads a scene.
    """

    def __init__(self):
        self.asked = False

    @contextmanager
    def listening(self):
        """While this lasts."""
        numbers = (signal.SIGINT, signal.SIGTERM)
        before = [signal.signal(number, self._ask) for number in numbers]
        try:
            yield
        finally:
            for number, handler in zip(numbers, before, strict=True):
                signal.signal(number, handler)

    def _ask(self, number, frame):
        self.asked = True
        signal.signal(number, signal.SIG_DFL)


def rendered(name: str, number: int, samples: int, timeout: float, interruption: Interruption) -> dict:
    """What the ``number``-th render of a scene adds to its entry."""
    parameters, width = settings(number)
    found = empty() | {"renders": 1}
    reset_peak()
    started = time.perf_counter()
    statistics = {}
    try:
        scene = repository.load_scene(name, resolution=width)
        film = scene.sensors()[0].film()
        pixels = math.prod(int(n) for n in film.crop_size())
        depth = scene.integrator().max_depth
        bdpt = mi.load_dict({"type": "bdpt", "max_depth": depth, "timeout": timeout, **parameters})
        bdpt.on_pass = lambda report: interruption.asked and bdpt.cancel()
        bdpt.render(scene, seed=number, spp=max(samples // pixels, 1), develop=False)
        statistics = bdpt.statistics
        image = np.array(film.develop())
        found["samples"] = pixels * sum(statistics["passes"])
        found["pixels_not_finite"] = int((~np.isfinite(image)).any(axis=-1).sum())
    except (RuntimeError, ValueError, NotImplementedError) as error:  # other scenes go on
        found["failed"] = [
            f"render {number}, {parameters}, width {width}: {' '.join(str(error).split())[:300]}"
        ]
    found["seconds"] = time.perf_counter() - started
    for key in ("non_finite", "non_finite_in_pilot"):
        found[key] = statistics.get(key, 0)
    found["kernels_compiled"] = statistics.get("kernels", {}).get("compiled", 0)
    found["peak_memory"] = peak()
    key = f"skip={parameters['skip']} heuristic={parameters['heuristic']} width={width}"
    found["samples_by"] = {key: found["samples"]}
    return found


def added(entry: dict, found: dict) -> dict:
    """Both together: the sum of all but the peak. (Older records lack some of the keys.)"""
    entry, total = empty() | entry, {}
    for key, value in entry.items():
        if isinstance(value, dict):
            total[key] = value | {name: value.get(name, 0) + n for name, n in found[key].items()}
        else:
            total[key] = value + found[key]
    total["peak_memory"] = max(entry["peak_memory"], found["peak_memory"])
    return total | {"seconds": round(total["seconds"], 3)}


def samples_of(record: dict) -> int:
    """Of all scenes."""
    return sum(entry["samples"] for entry in record["scenes"].values())


def add(path: Path, name: str, found: dict, source: str) -> dict:
    """Add what a render of this version of the ``source`` found to the record on disk; returns it."""
    record = read(path)
    if found["failed"]:
        found = found | {"failed_by_source": {source: len(found["failed"])}}
    record["scenes"][name] = added(record["scenes"].get(name, empty()), found)
    sources = record.setdefault("samples_by_source", {})
    sources[source] = sources.get(source, 0) + found["samples"]
    record["scenes"] = dict(sorted(record["scenes"].items()))
    write_json(path, record)
    return record


def left_out(record: dict, source: str) -> list[str]:
    """Scenes that have failed too often with this version of the ``source`` to be tried again with it."""
    return [
        name
        for name, entry in record["scenes"].items()
        if entry.get("failed_by_source", {}).get(source, 0) >= MOST_FAILURES
    ]


def run(path: Path, names: list[str], target: int, seconds: float, samples: int, interruption) -> None:
    """Renders of ``samples`` each until the record has ``target``, the time is over, or an interruption."""
    end, record, said = time.monotonic() + seconds, read(path), set()
    source = reference.source_digest()  # of what is imported, whatever is edited meanwhile
    while samples_of(record) < target and (left := end - time.monotonic()) > 0 and not interruption.asked:
        # A scene that fails at once must not be the next one for ever.
        out = left_out(record, source)
        for name in [name for name in names if name in out and name not in said]:
            said.add(name)
            print(f"{name}: left out after {MOST_FAILURES} failures: {record['scenes'][name]['failed'][-1]}")
        entries = {name: record["scenes"].get(name, empty()) for name in names if name not in out}
        if not entries:
            return
        name = min(entries, key=lambda name: (entries[name]["seconds"], entries[name]["renders"]))
        timeout = min(left, RENDER_SECONDS)
        found = rendered(name, entries[name]["renders"], samples, timeout, interruption)
        record = add(path, name, found, source)
        rate = found["samples"] / max(found["seconds"], 1e-9)
        print(
            f"{name}: {found['samples']:.3g} samples, {rate:.2g} per second, {samples_of(record):.4g} in all"
        )
        sys.stdout.flush()


def in_words(count: int) -> str:
    """A large number, to three digits."""
    for size, word in ((10**12, "trillion"), (10**9, "billion"), (10**6, "million")):
        if count >= 0.9995 * size:
            return f"{count / size:.3g} {word}"
    return f"{count:,}"


def text(record: dict) -> str:
    """The record in words and as a table."""
    entries = record["scenes"].values()
    total = {key: sum(entry[key] for entry in entries) for key in ("renders", "seconds")}
    lost = {key: _count(entries, key) for key in WRONG}
    words = (
        f"{in_words(samples_of(record))} camera samples in {total['renders']} renders of {len(entries)} "
        f"scenes, {total['seconds'] / 3600:.1f} hours: {lost['non_finite']} values and "
        f"{lost['pixels_not_finite']} pixels not finite, {lost['non_finite_in_pilot']} values of pilots, "
        f"{lost['failed']} renders failed."
    )
    by_source = record.get("samples_by_source", {})  # older records do not say
    if by_source:
        parts = [f"{in_words(count)} of `{source}`" for source, count in by_source.items()]
        words += f" By digest of the plugin's source: {', '.join(parts)}."
    out = left_out(record, reference.source_digest())
    if out:
        words += f" Left out after {MOST_FAILURES} failures with this version of the source: "
        words += ", ".join(f"`{name}`" for name in out) + "."
    return f"{words}\n\n{_table(record)}"


def _count(entries, key: str) -> int:
    """Of all ``entries``; older records lack some of the keys."""
    values = [entry.get(key, 0) for entry in entries]
    return sum(len(value) if isinstance(value, list) else value for value in values)


def _table(record: dict) -> str:
    rows = [
        [
            f"`{name}`",
            f"{entry['samples']:.3g}",
            f"{entry['non_finite']}",
            f"{entry.get('non_finite_in_pilot', 0)}",
            f"{entry['pixels_not_finite']}",
            f"{len(entry['failed'])}",
            f"{entry['seconds']:.0f}",
            f"{entry['renders']}",
            f"{entry['peak_memory'] / 2**20:.0f} MiB",
            f"{entry['kernels_compiled']}",
        ]
        for name, entry in record["scenes"].items()
    ]
    heads = ["scene", "samples", "not finite", "in pilots", "pixels not finite", "failed", "seconds"]
    return table([*heads, "renders", "worst memory", "kernels compiled"], rows)


def is_clean(record: dict) -> bool:
    """Whether every value was finite and no render failed."""
    return not any(_count(record["scenes"].values(), key) for key in WRONG)


def main(arguments=None) -> int:
    """Run the command line."""
    parser = command_line.parser(__doc__)
    known = repository.PROJECT.scene_names()
    parser.add_argument("scenes", nargs="*", metavar="SCENE", help="of scenes/; default: all")
    text_ = "default: until there are --samples"
    parser.add_argument("--seconds", type=number(float, 0), default=math.inf, help=text_)
    text_ = "of all; default: %(default).0e"
    parser.add_argument("--samples", type=number(float, 1), default=TARGET, help=text_)
    text_ = "camera samples of one render; default: %(default)s"
    whole = number(int, 1)
    parser.add_argument("--render-samples", type=whole, default=RENDER_SAMPLES, metavar="N", help=text_)
    parser.add_argument("--record", type=Path, default=RECORD, help="default: docs/reports/endurance.json")
    parser.add_argument("--show", action="store_true", help="print the record only")
    args = parser.parse_args(arguments)
    if unknown := set(args.scenes) - set(known):
        parser.error(f"not in scenes/: {', '.join(sorted(unknown))}")
    interruption = Interruption()
    if not args.show:
        mi.set_variant("llvm_ad_rgb")
        names = args.scenes or known
        with interruption.listening():
            run(args.record, names, int(args.samples), args.seconds, args.render_samples, interruption)
    record = read(args.record)
    print(text(record) + "interrupted" * interruption.asked)
    if not args.show and args.record.resolve() == RECORD.resolve():
        write_text(PAGE, replace_part(PAGE.read_text(), "endurance", text(record)))
    return INTERRUPTED if interruption.asked else not is_clean(record)


if __name__ == "__main__":
    raise SystemExit(answered(main))
