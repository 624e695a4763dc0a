"""Render all scenes of scenes/ for hours, and look for values that are not finite.

    python scripts/endurance.py --seconds 3600     # adds an hour to docs/endurance.json
    python scripts/endurance.py                    # until the scenes have 1e10 camera samples together
    python scripts/endurance.py --show             # the record, as a table

The scene that had the least time comes next, with another seed, another size and another heuristic each
time, and skip=auto and skip=none in turn. Every render is added to the record at once; Ctrl-C ends the one
that runs after its pass, a second Ctrl-C at once, and then it is not in the record. Exit status 1 if the
record has a value that is not finite, or a render that failed.
"""

from __future__ import annotations

import argparse
import json
import math
import re
import resource
import signal
import sys
import time
from contextlib import contextmanager
from pathlib import Path

import mitsuba_bdpt  # noqa: F401  (chooses LLVM before Dr.Jit is imported)
import numpy as np
import reference
from mistakes import answered
from mitsuba_bdpt.files import replacing
from mitsuba_bdpt.mis import HEURISTICS
from report import table

import mitsuba as mi  # isort: skip
import drjit as dr  # isort: skip

RECORD = reference.ROOT / "docs" / "endurance.json"

# Camera samples of all scenes together.
TARGET = 10**10

# One render ends after so many camera samples or so many seconds: starting costs little, settings change.
RENDER_SAMPLES, RENDER_SECONDS = 1 << 28, 40.0

# Widths in turn; a prime number, and one more and one less than a power of two, for what divides evenly.
SIZES = (256, 127, 640, 65, 512, 31)

SKIPS = ("auto", "none")


def settings(number: int) -> tuple[dict, int]:
    """Parameters of the plugin and width of the film for the ``number``-th render of a scene: over 48 renders
    every size meets both kinds of skip and every heuristic."""
    turn = number // len(SKIPS)
    return {
        "skip": SKIPS[number % len(SKIPS)],
        "heuristic": HEURISTICS[turn % len(HEURISTICS)],
    }, SIZES[(turn + turn // len(HEURISTICS)) % len(SIZES)]


def read(path: Path) -> dict:
    """The record: scenes by name; empty if there is none."""
    return json.loads(path.read_text()) if path.exists() else {"scenes": {}}


def write(path: Path, record: dict) -> None:
    """Write at once: a process that is killed leaves the whole file or none."""
    path.parent.mkdir(parents=True, exist_ok=True)
    with replacing(path) as temporary:
        temporary.write_text(json.dumps(record, indent=1) + "\n")


def empty() -> dict:
    """What is known of a scene before its first render."""
    return {
        "samples": 0,
        "non_finite": 0,
        "pixels_not_finite": 0,
        "seconds": 0.0,
        "renders": 0,
        "kernels_compiled": 0,
        "peak_memory": 0,
        "failed": [],
        "samples_by": {},
    }


def reset_peak() -> None:
    """Let `peak` begin anew, where the system can."""
    dr.detail.malloc_clear_statistics()
    try:
        Path("/proc/self/clear_refs").write_text("5")
    except OSError:
        pass  # then it is that of all renders of this process


def peak() -> int:
    """The most memory that this process had since `reset_peak`, in bytes."""
    status = Path("/proc/self/status")
    if status.exists() and (found := re.search(r"VmHWM:\s+(\d+) kB", status.read_text())):
        return int(found[1]) * 1024
    most = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return most if sys.platform == "darwin" else most * 1024


class Interruption:
    """Whether Ctrl-C or SIGTERM came. No exception: Python drops one that comes in a destructor, and Mitsuba
    makes another one of it while it loads a scene."""

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
        scene = reference.load_scene(name, resolution=width)
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
    found["non_finite"] = statistics.get("non_finite", 0)
    found["kernels_compiled"] = statistics.get("kernels", {}).get("compiled", 0)
    found["peak_memory"] = peak()
    key = f"skip={parameters['skip']} heuristic={parameters['heuristic']} width={width}"
    found["samples_by"] = {key: found["samples"]}
    return found


def added(entry: dict, found: dict) -> dict:
    """Both together: the sum of all but the peak."""
    by = {key: entry["samples_by"].get(key, 0) + n for key, n in found["samples_by"].items()}
    total = {key: entry[key] + found[key] for key in entry if key != "samples_by"}
    total["peak_memory"] = max(entry["peak_memory"], found["peak_memory"])
    return total | {"samples_by": entry["samples_by"] | by, "seconds": round(total["seconds"], 3)}


def samples_of(record: dict) -> int:
    """Of all scenes."""
    return sum(entry["samples"] for entry in record["scenes"].values())


def add(path: Path, name: str, found: dict) -> dict:
    """Add what a render found to the record on disk; returns it."""
    record = read(path)
    record["scenes"][name] = added(record["scenes"].get(name, empty()), found)
    source = reference.source_digest()
    sources = record.setdefault("samples_by_source", {})
    sources[source] = sources.get(source, 0) + found["samples"]
    record["scenes"] = dict(sorted(record["scenes"].items()))
    write(path, record)
    return record


def run(path: Path, names: list[str], target: int, seconds: float, samples: int, interruption) -> None:
    """Renders of ``samples`` each until the record has ``target``, the time is over, or an interruption."""
    end, record = time.monotonic() + seconds, read(path)
    while samples_of(record) < target and (left := end - time.monotonic()) > 0 and not interruption.asked:
        # A scene that fails at once must not be the next one for ever.
        entries = {name: record["scenes"].get(name, empty()) for name in names}
        name = min(names, key=lambda name: (entries[name]["seconds"], entries[name]["renders"]))
        if len(entries[name]["failed"]) > 2:
            names = [other for other in names if other != name]
            if not names:
                return
            continue
        timeout = min(left, RENDER_SECONDS)
        found = rendered(name, entries[name]["renders"], samples, timeout, interruption)
        record = add(path, name, found)
        rate = found["samples"] / max(found["seconds"], 1e-9)
        print(
            f"{name}: {found['samples']:.3g} samples, {rate:.2g} per second, {samples_of(record):.4g} in all"
        )
        sys.stdout.flush()


def text(record: dict) -> str:
    """The record as a table."""
    rows = [
        [
            f"`{name}`",
            f"{entry['samples']:.3g}",
            f"{entry['non_finite']}",
            f"{entry['pixels_not_finite']}",
            f"{len(entry['failed'])}",
            f"{entry['seconds']:.0f}",
            f"{entry['renders']}",
            f"{entry['peak_memory'] / 2**20:.0f} MiB",
            f"{entry['kernels_compiled']}",
        ]
        for name, entry in record["scenes"].items()
    ]
    heads = ["scene", "samples", "not finite", "pixels not finite", "failed", "seconds", "renders"]
    return table([*heads, "worst memory", "kernels compiled"], rows)


def is_clean(record: dict) -> bool:
    """Whether every value was finite and no render failed."""
    wrong = ("non_finite", "pixels_not_finite", "failed")
    return not any(entry[key] for entry in record["scenes"].values() for key in wrong)


def main(arguments=None) -> int:
    """Run the command line."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    known = reference.scene_names()
    parser.add_argument("scenes", nargs="*", metavar="SCENE", help="of scenes/; default: all")
    parser.add_argument("--seconds", type=float, default=math.inf, help="default: until there are --samples")
    parser.add_argument("--samples", type=float, default=TARGET, help="of all; default: %(default).0e")
    text_ = "camera samples of one render; default: %(default)s"
    parser.add_argument("--render-samples", type=int, default=RENDER_SAMPLES, metavar="N", help=text_)
    parser.add_argument("--record", type=Path, default=RECORD, help="default: docs/endurance.json")
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
    print(text(record))
    print(f"{samples_of(record):.4g} samples in all" + (", interrupted" if interruption.asked else ""))
    return 130 if interruption.asked else not is_clean(record)


if __name__ == "__main__":
    raise SystemExit(answered(main))
