"""Where the time of a sample goes: renders with one thing changed at a time (``gpu.py --ablation``).

`WAYS` are the renders, the most informative ones first, of each of `SCENES`. As many processes as
``--beside`` says compile their kernels side by side (a first render of `SHORT` samples per pixel); then each
is timed alone: medians of `ROUNDS` short and long renders in turn, whose difference is free of what a render
costs whatever its length. What is not done within ``--seconds`` is recorded as not measured. The file is
written after each row.

Seconds of the kernels alone, by Dr.Jit's own events, stand beside those of the clock: the rest is Python,
which records every pass anew. Kernels with rays are OptiX's, which tells nothing of registers: ``--profile``
makes the renders of `PROFILED` one by one for a profiler that waits for the program's word (``ncu
--profile-from-start off``). The PTX of each kernel is counted, kept in an archive beside the file, and
assembled for its own ``.target`` if there is a ptxas on the PATH that does so.
"""

from __future__ import annotations

import contextlib
import itertools
import json
import multiprocessing
import re
import shutil
import statistics
import subprocess
import tempfile
import time
from dataclasses import dataclass, field
from multiprocessing.connection import wait
from unittest import mock
from zipfile import ZIP_DEFLATED, ZipFile

import mitsuba_bdpt  # noqa: F401 (before mitsuba: it chooses the LLVM library)

import drjit as dr  # isort: skip
import mitsuba as mi
import repository
from mitsuba_bdpt.host.introspection import versions
from mitsuba_bdpt.host.jit import evaluated_mode
from mitsuba_bdpt.image.accumulator import Accumulator
from mitsuba_bdpt.measure.tables import table
from mitsuba_bdpt.run import schedule
from mitsuba_bdpt.transport import inputs
from mitsuba_bdpt.transport.contribution import COUNTERS, Counters

SCENES = ("cornell_box", "open_sky", "veach_mis", "glass_caustics")

SHORT, ROUNDS = 2, 3
"""Samples per pixel of short renders, and how often each is timed."""

LONGEST, SECONDS = 128, 0.4
"""At most so many samples per pixel in a long render, which is to take about so long."""

COMPILING = 0.55
"""The share of the time that is left which compiling may take before timing begins."""

LARGE = 100
"""Operations of a kernel that traces something."""

BIG = 1 << 24
"""Samples in a launch, instead of `schedule.LAUNCH_SAMPLES`."""


@dataclass(frozen=True)
class Way:
    """A way to render a scene: the integrator's ``parameters``, and what is changed besides.

    ``launch``: samples in a launch; ``counters`` "none" leaves them out, "lanes" adds those of a warp up
    first; ``store``: vertices for which a lane has memory; ``evaluated``: loops are run step by step, their
    state in memory; ``most``: samples per pixel at most.
    """

    name: str
    parameters: dict
    sampler: str = "independent"
    rfilter: str = "box"
    launch: int = schedule.LAUNCH_SAMPLES
    counters: str = ""
    store: int = inputs.STORE_SIZES[0]
    evaluated: bool = False
    most: int = LONGEST


PATH = {"type": "path"}
ALONE = {"type": "bdpt", "light_paths": 0}
ONE, ALL, NONE = ({"type": "bdpt", "light_paths": 1, "connections": c} for c in ("one", "all", "none"))
RANDOM = {"points": "independent"}
WAYS = (
    Way("path", PATH),
    Way("light_paths=0", ALONE),
    Way("one", ONE),
    Way("light_paths=0, no counters", ALONE, counters="none"),
    Way("light_paths=0, launches of 2^24", ALONE, launch=BIG),
    Way("light_paths=0, independent", ALONE | RANDOM),
    Way("none", NONE),
    Way("all", ALL),
    Way("one, store of 8", ONE, store=8),
    Way("one, no counters", ONE, counters="none"),
    Way("one, launches of 2^24", ONE, launch=BIG, most=33),
    Way("light_paths=0, gaussian", ALONE, rfilter="gaussian"),
    Way("path, gaussian", PATH, rfilter="gaussian"),
    Way("path, evaluated", PATH, evaluated=True, most=8),
    Way("light_paths=0, all three", ALONE | RANDOM, launch=BIG, counters="none"),
    Way("one, gaussian", ONE, rfilter="gaussian"),
    Way("all, store of 8", ALL, store=8),
    Way("one, store of 16", ONE, store=16),
    Way("1/16, one", ONE | {"light_paths": 1 / 16}),
    Way("light_paths=0, counters added in lanes", ALONE, counters="lanes"),
    Way("path, multijitter", PATH, sampler="multijitter", most=32),
)
PROFILED = ("path", "light_paths=0", "one", "light_paths=0, no counters", "all", "one, store of 8")


@dataclass
class Subject:
    """A scene rendered in one way, in this process."""

    scene: mi.Scene
    integrator: mi.Integrator
    way: Way
    seeds: itertools.count = field(default_factory=itertools.count)

    @classmethod
    def of(cls, name: str, way: Way, size: int) -> Subject:
        """The scene ``name``, ``size`` pixels wide."""
        scene = repository.load_scene(name, resolution=size, sampler=way.sampler, rfilter=way.rfilter)
        depth = repository.benchmark_depth(name)
        return cls(scene, mi.load_dict(way.parameters | {"max_depth": depth}), way)

    def render(self, spp: int, profiled=False) -> tuple[float, list[dict]]:
        """Wall seconds of a render, and Dr.Jit's entries of its kernels."""
        kernels: list[dict] = []
        with (
            changed(self.way, kernels),
            shown_to_profiler(self.way) if profiled else contextlib.nullcontext(),
        ):
            dr.sync_thread()
            started = time.perf_counter()
            dr.eval(mi.render(self.scene, integrator=self.integrator, spp=spp, seed=next(self.seeds)))
            dr.sync_thread()
            seconds = time.perf_counter() - started
            dr.kernel_history()
        return seconds, kernels

    def compile(self) -> dict:
        """Seconds of the first render, and what its kernels are."""
        seconds, kernels = self.render(SHORT)
        traced = [k for k in kernels if k["operation_count"] >= LARGE]
        found = {k["hash"]: described(k) | {"seconds": 0.0} for k in traced}
        for k in traced:
            found[k["hash"]]["seconds"] += k["execution_time"] / 1000
        return {"first_seconds": seconds, "kernels": found}

    def time(self, spp: int) -> dict:
        """Seconds of short and long renders, in turn; ``spp`` of the long ones, 0 to choose."""
        short, _ = self.render(SHORT)
        longer = min(self.way.most, 4 * SHORT)
        each = max((self.render(longer)[0] - short) / (longer - SHORT), 1e-5)
        if self.way.launch == BIG:  # a pass of the first sample alone, then two whole launches at least
            long = spp or min(self.way.most, 2 * BIG // self.samples(1) + 1)
        else:
            long = spp or min(self.way.most, 1 << max(round(SECONDS / each) - 1, 4 * SHORT - 1).bit_length())
        rounds = [[self.render(n) for n in (SHORT, long)] for _ in range(ROUNDS)]
        row: dict = {"spp": long, "kernels_compiled": 0}
        for n, what in ((0, "short"), (1, "long")):
            turns = [both[n] for both in rounds]
            row[f"seconds_{what}"] = statistics.median(seconds for seconds, _ in turns)
            row[f"kernel_seconds_{what}"] = statistics.median(spent(kernels) for _, kernels in turns)
            row[f"launches_{what}"] = len(turns[-1][1])
            row["kernels_compiled"] += sum(not k["cache_hit"] for _, kernels in turns for k in kernels)
        more = self.samples(long - SHORT)
        for what in ("seconds", "kernel_seconds"):
            row[f"ns_{what}"] = 1e9 * (row[f"{what}_long"] - row[f"{what}_short"]) / more
        return row

    def samples(self, spp: int) -> int:
        """Number of samples of the image at ``spp`` samples per pixel."""
        return int(self.scene.sensors()[0].film().size().numpy().prod()) * spp


def spent(kernels: list[dict]) -> float:
    """Seconds that kernels ran."""
    return sum(k["execution_time"] for k in kernels) / 1000


@contextlib.contextmanager
def changed(way: Way, kernels: list[dict]):
    """Make the changes of a ``way``, and collect what `dr.kernel_history` tells of the ``kernels``."""
    tell = dr.kernel_history

    def told(*types):
        entries = tell(*types)
        kernels.extend(k for k in entries if k["type"] == dr.KernelType.JIT)
        return entries

    def uncounted(_):
        return dr.zeros(mi.UInt64, len(COUNTERS))

    def in_lanes(self):
        total = dr.zeros(mi.UInt64, len(COUNTERS))
        for i, name in enumerate(COUNTERS):
            if (value := getattr(self, name)) is not None:
                dr.scatter_add(total, mi.UInt64(value), mi.UInt32(i), mode=dr.ReduceMode.Local)
        return total

    with contextlib.ExitStack() as stack:
        stack.enter_context(mock.patch.object(dr, "kernel_history", told))
        for name in ("LAUNCH_SAMPLES", "LAUNCH_SAMPLES_CUDA"):
            stack.enter_context(mock.patch.object(schedule, name, way.launch))
        stack.enter_context(mock.patch.object(inputs, "STORE_SIZES", (way.store, *inputs.STORE_SIZES)))
        stack.enter_context(evaluated_mode(way.evaluated))
        if way.counters:
            summed = {"none": uncounted, "lanes": in_lanes}[way.counters]
            stack.enter_context(mock.patch.object(Counters, "summed", summed))
        stack.enter_context(dr.scoped_set_flag(dr.JitFlag.KernelHistory, True))
        yield


@contextlib.contextmanager
def shown_to_profiler(way: Way):
    """Let a profiler see a render, of `bdpt` the kernels of its passes alone."""
    if way.parameters["type"] == "path":
        with dr.profile_enable():
            yield
        return
    evaluate = Accumulator.evaluate

    def seen(*given):
        with dr.profile_enable():
            evaluate(*given)
            dr.sync_thread()

    with mock.patch.object(Accumulator, "evaluate", seen):
        yield


def described(kernel: dict) -> dict:
    """What Dr.Jit tells of a kernel, and what its code tells; the code itself is ``ir``."""
    code = kernel["ir"].getvalue()
    local = re.findall(r"\.local[^;\n]*?\.([bsuf])(\d+)[^;\n\[]*\[(\d+)\]", code)
    return {
        "optix": bool(kernel["uses_optix"]),
        "operations": kernel["operation_count"],
        "compile_seconds": (kernel["codegen_time"] + kernel["backend_time"]) / 1000,
        "from_disk": bool(kernel["cache_disk"]),
        "lines": code.count("\n"),
        "local_bytes": sum(int(bits) // 8 * int(n) for _, bits, n in local),
        "rays": len(re.findall(r"_optix_(?:trace|hitobject_trav)", code)),
        "functions": len(re.findall(r"^\s*(?:\.visible\s+)?\.func\b", code, re.MULTILINE)),
        **assembled(code),
        "ir": code,
    }


def assembled(code: str) -> dict:
    """Registers and stack of a kernel as ptxas states them; empty where it does not assemble the PTX.

    It does not assemble kernels of OptiX, whose intrinsics it does not know.
    """
    tool, target = shutil.which("ptxas"), re.search(r"^\.target\s+(\w+)", code, re.MULTILINE)
    if tool is None or target is None or "_optix_" in code:
        return {}
    with tempfile.NamedTemporaryFile("w", suffix=".ptx") as file:
        file.write(code)
        file.flush()
        command = [tool, "-v", f"-arch={target[1]}", file.name, "-o", "/dev/null"]
        try:
            said = subprocess.run(command, capture_output=True, text=True, timeout=60).stderr
        except subprocess.TimeoutExpired:
            return {}
    numbers = {
        "registers": r"Used (\d+) registers",
        "stack_bytes": r"(\d+) bytes stack frame",
        "spilled_bytes": r"(\d+) bytes spill stores",
    }
    found = {name: re.findall(pattern, said) for name, pattern in numbers.items()}
    return {name: max(map(int, values)) for name, values in found.items() if values}


def work(pipe, variant: str, size: int, spp: int) -> None:
    """A process that does what it is told: ("compile" or "time", scene, index of the way)."""
    mi.set_variant(variant)
    made: dict[tuple, Subject] = {}
    while (order := pipe.recv()) is not None:
        verb, *job = order
        try:
            if verb == "compile":
                made[tuple(job)] = Subject.of(job[0], WAYS[job[1]], size)
                answer = made[tuple(job)].compile()
            else:
                answer = made[tuple(job)].time(spp)
        except Exception as error:  # the others go on; it is in the file
            answer = {"failed": f"{type(error).__name__}: {error}"}
        pipe.send(answer)


class Crew:
    """Processes that render; ``rows`` holds what they answered, by (scene, index of the way)."""

    def __init__(self, options, record):
        self._options, self._record = options, record
        self._end = time.monotonic() + options.seconds
        self.rows: dict[tuple, dict] = {}
        self._members: dict = {}  # by pipe: process
        for _ in range(options.beside):
            self._hire()

    def _hire(self):
        context = multiprocessing.get_context("spawn")
        ours, theirs = context.Pipe()
        given = (theirs, self._options.variant, self._options.size, self._options.spp)
        process = context.Process(target=work, args=given, daemon=True)
        process.start()
        theirs.close()
        self._members[ours] = process

    def left(self) -> float:
        """Seconds that are left."""
        return self._end - time.monotonic()

    def run(self, jobs: list[tuple]) -> None:
        """Compile and time ``jobs``, as many as there is time for; all that were begun are in the file."""
        while jobs and self.left() > 0:
            until = self.left() * (1 - COMPILING)
            owners = self._compile(jobs, until)
            for job, pipe in sorted(owners.items(), key=lambda item: (item[0][1], item[0][0])):
                if self.left() <= 0:
                    break
                if pipe in self._members:
                    pipe.send(("time", *job))
                    self._answer(pipe, job)
                else:  # it died of another one
                    jobs.append(job)
            if not owners:
                return

    def _compile(self, jobs: list[tuple], until: float) -> dict:
        """Compile ``jobs`` until ``until`` seconds are left, and say whose pipe has which."""
        owners, busy = {}, {}
        idle = list(self._members)
        while True:
            while jobs and idle and self.left() > until:
                pipe, job = idle.pop(), jobs.pop(0)
                pipe.send(("compile", *job))
                busy[pipe] = job
            if not busy or self.left() <= 0:
                return owners
            for pipe in wait(list(busy), timeout=max(self.left(), 0)):
                job = busy.pop(pipe)
                if self._answer(pipe, job):
                    owners[job] = pipe
                if pipe in self._members:
                    idle.append(pipe)
                else:  # it died of this job; its other ones are lost with it
                    jobs += (lost := [other for other, owner in owners.items() if owner == pipe])
                    owners = {other: owner for other, owner in owners.items() if other not in lost}
                    idle += [p for p in self._members if p not in busy and p not in idle]

    def _answer(self, pipe, job: tuple) -> bool:
        """Wait for what a process says of a ``job``; whether it has not failed."""
        row = self.rows.setdefault(job, {})
        try:
            patience = max(self.left(), 0) + 5
            answer = pipe.recv() if pipe.poll(patience) else {"failed": "the time was over"}
        except (EOFError, OSError):
            answer = {"failed": f"its process ended with {self._members.pop(pipe).exitcode}"}
            self._hire()
        row |= answer
        self._record(self.rows)
        print(
            *job[:1],
            WAYS[job[1]].name,
            answer.get("failed") or "done",
            round(self.left()),
            "s left",
            flush=True,
        )
        return "failed" not in answer

    def dismiss(self) -> None:
        """End all processes."""
        for process in self._members.values():
            process.terminate()


def jobs_of(scenes: list[str]) -> list[tuple[str, int]]:
    """All (scene, index of the way), the most informative ones first."""
    return [(scene, i) for i in range(len(WAYS)) for scene in scenes]


def recorded(options, jobs: list[tuple], rows: dict) -> dict:
    """What the file holds; code of kernels goes into an archive beside it."""
    lines = []
    for scene, i in jobs:
        row = dict(rows.get((scene, i), {}))
        row["kernels"] = [
            {"hash": h} | {k: v for k, v in one.items() if k != "ir"}
            for h, one in row.get("kernels", {}).items()
        ]
        row["measured"] = "ns_seconds" in row
        lines.append({"scene": scene, "way": WAYS[i].name} | row)
    told = {
        "variant": options.variant,
        "device": options.device,
        "size": options.size,
        "beside": options.beside,
    }
    return told | {"software": versions(), "rows": lines}


def one_row_per_line(found: dict) -> str:
    """Format what `recorded` returns as JSON with one row per line."""
    head = json.dumps({name: value for name, value in found.items() if name != "rows"}, indent=1)
    rows = ",\n  ".join(map(json.dumps, found["rows"]))
    return f'{head[:-2]},\n "rows": [\n  {rows}\n ]\n}}\n'


def measure(options) -> None:
    """Measure all ways in all scenes and write the file."""
    mi.set_variant(options.variant)
    jobs = jobs_of(options.scenes or list(SCENES))
    saved: set[str] = set()

    def record(rows: dict) -> None:
        options.output.write_text(one_row_per_line(recorded(options, jobs, rows)))
        with ZipFile(options.output.with_suffix(".zip"), "a", ZIP_DEFLATED) as archive:
            for row in rows.values():
                for name, one in row.get("kernels", {}).items():
                    if name not in saved:
                        archive.writestr(f"{name}.ptx", one["ir"])
                        saved.add(name)

    options.output.with_suffix(".zip").unlink(missing_ok=True)
    crew = Crew(options, record)
    try:
        crew.run(list(jobs))
    finally:
        crew.dismiss()
    record(crew.rows)


def profile(options) -> None:
    """Make the renders of `PROFILED`, the second of each for the profiler, and name what it sees."""
    mi.set_variant(options.variant)
    ways = {way.name: way for way in WAYS}
    for name in PROFILED:
        for scene in options.scenes or list(SCENES):
            subject = Subject.of(scene, ways[name], options.size)
            subject.render(SHORT)
            _, kernels = subject.render(SHORT, profiled=True)
            print(
                f"# profiled: {scene} | {name} |",
                *(k["hash"] for k in kernels if k["operation_count"] >= LARGE),
                flush=True,
            )


def page(found: dict) -> str:
    """The tables of a file, as Markdown: nanoseconds of a sample, and kernels."""
    scenes = list(dict.fromkeys(row["scene"] for row in found["rows"]))
    rows = {(row["way"], row["scene"]): row for row in found["rows"]}
    ways = list(dict.fromkeys(row["way"] for row in found["rows"]))
    blocks = [["", *scenes]] + [
        [way, *(_nanoseconds(rows[way, s], rows["path", s]) for s in scenes)] for way in ways
    ]
    kernels = [["", *scenes]] + [[way, *(_kernel(rows[way, s]) for s in scenes)] for way in ways]
    return "\n".join(table(head, rest) for head, *rest in (blocks, kernels))


def _nanoseconds(row: dict, path: dict) -> str:
    """Format the time per sample by the clock and of the kernels, and the ratio to the kernels of `path`."""
    if not row["measured"]:
        return row.get("failed", "not measured").splitlines()[0][:40]
    clock, kernels = row["ns_seconds"], row["ns_kernel_seconds"]
    text = f"{clock:.3g}, {kernels:.3g}"
    return text + (f" ({kernels / path['ns_kernel_seconds']:.2f}x)" if path["measured"] else "")


def _kernel(row: dict) -> str:
    """Format lines and bytes of local arrays of the slowest kernel, and registers and stack if known."""
    if not row["kernels"]:
        return "–"
    one = max(row["kernels"], key=lambda k: k["seconds"])
    known = [
        f"{one[key]} {key.replace('_', ' ')}"
        for key in ("registers", "stack_bytes", "spilled_bytes")
        if key in one
    ]
    return ", ".join(
        [
            f"{one['lines']} lines",
            f"{one['local_bytes']} bytes",
            *known,
            f"first {row['first_seconds']:.0f} s",
        ]
    )
