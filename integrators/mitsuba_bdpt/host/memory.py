"""Memory limits of this process: machine, control groups and ulimits."""

from __future__ import annotations

import math
import os
import re
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

ROOT = Path("/")  # where the files of the system are

_limit_set: list[float] = []
"""The limit of `set_limit`, if there is one."""


@dataclass(frozen=True)
class Available:
    """Memory (``bytes``) that this process may still take, and its ``limit``."""

    bytes: float
    limit: str


def set_limit(most: float | None) -> None:
    """Set a limit of ``most`` bytes for work that is known to need more; None removes it."""
    _limit_set[:] = [] if most is None else [most]


def available() -> Available:
    """Return the smallest of all limits; infinite if none is known.

    ``ulimit -v`` and ``-d`` are reduced by the memory in use; other limits are not.
    """
    return min(_limits(), key=lambda found: found.bytes, default=Available(math.inf, "nothing"))


def peak() -> int | None:
    """Peak memory of this process in bytes; None if the system does not report it.

    ``ru_maxrss`` is avoided on Linux: it includes the parent process's memory before ``exec``.
    """
    if sys.platform == "win32":
        return None
    if found := _status().get("VmHWM"):
        return found
    import resource

    found = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return found if sys.platform == "darwin" else 1024 * found


def _limits() -> Iterator[Available]:
    for most in _limit_set:
        yield Available(most, "the limit set by --memory")
    if hasattr(os, "sysconf"):  # not on Windows
        yield Available(os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES"), "the machine's memory")
    for file in _control_groups():
        text = file.read_text().strip()
        if text.isdecimal():  # else "max"
            yield Available(int(text), f"the control group's limit, {file}")
    yield from _own_limits()


def _control_groups() -> Iterator[Path]:
    """Yield the memory limit files of this process's control groups and their parents."""
    memberships = ROOT / "proc/self/cgroup"
    lines = memberships.read_text().splitlines() if memberships.is_file() else []
    for line in lines:
        number, controllers, path = line.split(":", 2)
        if number == "0":
            mount, name = ROOT / "sys/fs/cgroup", "memory.max"
        elif "memory" in controllers.split(","):
            mount, name = ROOT / "sys/fs/cgroup/memory", "memory.limit_in_bytes"
        else:
            continue
        # In a container the path may be the host's, while only the mount is visible.
        inner = Path(path.lstrip("/"))
        folders = [mount / folder for folder in (inner, *inner.parents)]
        yield from (file for folder in folders if (file := folder / name).is_file())


def _own_limits() -> Iterator[Available]:
    """Yield the process's ulimits less the memory in use."""
    if sys.platform != "linux":
        return
    import resource

    taken = _status()
    limits = (resource.RLIMIT_AS, "VmSize", "-v"), (resource.RLIMIT_DATA, "VmData", "-d")
    for kind, name, option in limits:
        most = resource.getrlimit(kind)[0]
        if most != resource.RLIM_INFINITY:
            yield Available(max(most - taken.get(name, 0), 0), f"the process's limit, ulimit {option}")


def _status() -> dict[str, int]:
    """Memory fields of ``/proc/self/status`` in bytes; empty if not on Linux."""
    file = ROOT / "proc/self/status"
    fields = re.findall(r"(\w+):\s*(\d+) kB", file.read_text()) if file.is_file() else []
    return {name: 1024 * int(value) for name, value in fields}
