"""How much memory this process may take: of the machine, of its control groups, and by its own limits."""

from __future__ import annotations

import math
import os
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

ROOT = Path("/")
"""Where the files of the system are."""

_asked: list[float] = []
"""The limit of `set_limit`, if there is one."""


@dataclass(frozen=True)
class Available:
    """Memory in ``bytes`` that this process may still take, and what limits it."""

    bytes: float
    limit: str


def set_limit(most: float | None) -> None:
    """Let this process take ``most`` bytes of memory, whatever the system allows; None for no such limit.

    Nothing is enforced: what is known to need more raises an error before it begins.
    """
    _asked[:] = [] if most is None else [most]


def available() -> Available:
    """The least of all limits; infinite where none is known.

    Limits of the address space and of data (``ulimit -v`` and ``-d``) count what is in use already, those of
    the machine and of control groups (containers, slots of a farm) do not.
    """
    return min(_limits(), key=lambda found: found.bytes, default=Available(math.inf, "nothing"))


def peak() -> int | None:
    """Bytes of memory that this process has taken at most so far; None where the system has no count.

    On Linux of this process alone: ``ru_maxrss`` there is at least what the process had that began this one.
    """
    if sys.platform == "win32":
        return None
    if found := _status("VmHWM"):
        return found["VmHWM"]
    import resource

    found = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return found if sys.platform == "darwin" else 1024 * found


def _limits() -> Iterator[Available]:
    for most in _asked:
        yield Available(most, "the limit set by --memory")
    if hasattr(os, "sysconf"):  # not on Windows
        yield Available(os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES"), "the machine's memory")
    for file in _control_groups():
        text = file.read_text().strip()
        if text.isdecimal():  # else "max"
            yield Available(int(text), f"the control group's limit, {file}")
    yield from _own_limits()


def _control_groups() -> Iterator[Path]:
    """Files with the memory limits of this process's control groups, version 1 and 2, and of those around."""
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
        # In a container the path may be that of the machine, of which only the mount is seen.
        inner = Path(path.lstrip("/"))
        folders = [mount / folder for folder in (inner, *inner.parents)]
        yield from (file for folder in folders if (file := folder / name).is_file())


def _own_limits() -> Iterator[Available]:
    """Limits of the process, less what it takes already."""
    if sys.platform != "linux":
        return
    import resource

    taken = _status("VmSize", "VmData")
    for kind, name, option in (
        (resource.RLIMIT_AS, "VmSize", "-v"),
        (resource.RLIMIT_DATA, "VmData", "-d"),
    ):
        most = resource.getrlimit(kind)[0]
        if most != resource.RLIM_INFINITY:
            yield Available(max(most - taken.get(name, 0), 0), f"the process's limit, ulimit {option}")


def _status(*names: str) -> dict[str, int]:
    """The lines of these ``names`` in the process's status, in bytes; empty on other systems than Linux."""
    file, found = ROOT / "proc/self/status", {}
    for line in file.read_text().splitlines() if file.is_file() else []:
        name, _, value = line.partition(":")
        if name in names:
            found[name] = 1024 * int(value.split()[0])
    return found
