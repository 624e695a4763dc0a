"""What a render has done so far, and how long it took."""

from __future__ import annotations

import time
from contextlib import contextmanager
from dataclasses import dataclass, field, fields, replace

import drjit as dr

from ..transport.counters import COUNTERS


@dataclass(frozen=True)
class Work:
    """What is counted; a part of a render's progress.

    ``counts``: sums of `counters.COUNTERS` by name; kernels ``compiled``, and found ``cached``; ``seconds``
    in all, of which ``compile_seconds`` compile kernels and ``pilot_seconds`` are those of pilots (apart from
    their compiling)."""

    counts: dict = field(default_factory=lambda: dict.fromkeys(COUNTERS, 0))
    compiled: int = 0
    cached: int = 0
    seconds: float = 0.0
    compile_seconds: float = 0.0
    pilot_seconds: float = 0.0

    @property
    def idle_seconds(self) -> float:
        """In which no samples of the image were traced."""
        return self.compile_seconds + self.pilot_seconds

    def joined(self, other: Work) -> Work:
        """Of two renders together."""
        counts = {name: n + other.counts[name] for name, n in self.counts.items()}
        names = [f.name for f in fields(self) if f.name != "counts"]
        sums = {name: getattr(self, name) + getattr(other, name) for name in names}
        return Work(counts, **sums)


class Meter:
    """Waits for what one render launches, and notes what it did."""

    def __init__(self):
        self._started, self._running = time.perf_counter(), []
        self._noted = self._earlier = Work()
        self._earlier_spp = 0

    def resume(self, work: Work, spp: int):
        """Go on from the ``work`` of an earlier part of the render, of so many samples per pixel."""
        self._noted, self._earlier, self._earlier_spp = work, work, spp

    @property
    def work(self) -> Work:
        """All work so far, that of earlier parts of the render included."""
        return replace(self._noted, seconds=self._earlier.seconds + self.elapsed())

    def elapsed(self) -> float:
        """Seconds since this part of the render began."""
        return time.perf_counter() - self._started

    def rate(self, spp: int) -> float:
        """Samples per pixel and second of this part of the render, at ``spp`` in all.

        Compiling and pilots do not count.
        """
        busy = self.elapsed() - (self._noted.idle_seconds - self._earlier.idle_seconds)
        return (spp - self._earlier_spp) / max(busy, 1e-3)

    def launched(self, counts):
        """A batch runs; its ``counts`` are those of `kernel.trace`."""
        self._running.append(counts)

    def wait(self):
        """Wait for what was launched, and note what it did and how it was compiled."""
        dr.sync_thread()
        while self._running:
            batch = self._running.pop().numpy().tolist()
            counts = self._noted.counts
            counts = {name: counts[name] + n for name, n in zip(counts, batch, strict=True)}
            self._noted = replace(self._noted, counts=counts)
        for entry in dr.kernel_history():
            if entry["type"] == dr.KernelType.JIT:
                self._note_kernel(entry)

    def _note_kernel(self, entry: dict):
        """Note an entry of Dr.Jit's history.

        What is in the cache is still assembled, which is not compiling.
        """
        work = self._noted
        if entry["cache_hit"]:
            self._noted = replace(work, cached=work.cached + 1)
            return
        seconds = (entry["codegen_time"] + entry["backend_time"]) / 1000
        self._noted = replace(
            work, compiled=work.compiled + 1, compile_seconds=work.compile_seconds + seconds
        )

    @contextmanager
    def pilot(self):
        """Measures what is done inside of it as a pilot.

        Passes before it are waited for: their time is not the pilot's.
        """
        self.wait()
        started, compiled = time.perf_counter(), self._noted.compile_seconds
        yield
        self.wait()
        spent = time.perf_counter() - started - (self._noted.compile_seconds - compiled)
        self._noted = replace(self._noted, pilot_seconds=self._noted.pilot_seconds + spent)
