"""Processes of their own for what may crash, hang or spoil the process, and full disks for them."""

from __future__ import annotations

import contextlib
import os
import resource
import selectors
import subprocess
import sys
import tempfile
import time
from pathlib import Path

PRELUDE = """
import mitsuba_bdpt, short_pilots, sys
import mitsuba as mi
import drjit as dr
import numpy as np
mi.set_variant("llvm_ad_rgb")
"""

# Said of what can't be tried.
NO_DISK = "this user can't mount a disk"


def environment(**changes: str | None) -> dict[str, str]:
    """This process's, with the modules that it finds; ``None`` removes a variable."""
    found = os.environ | {"PYTHONPATH": os.pathsep.join(sys.path)} | changes
    return {name: value for name, value in found.items() if value is not None}


def python(code: str, *arguments: str, limit: float = 1000, **keywords) -> subprocess.CompletedProcess:
    """Run Python code after `PRELUDE`; ``keywords`` go to ``subprocess.run``."""
    keywords = {"env": environment()} | keywords
    command = [sys.executable, "-c", PRELUDE + code, *arguments]
    return subprocess.run(command, capture_output=True, text=True, timeout=limit, check=False, **keywords)


def command(*arguments, limit: float = 1000, **keywords) -> subprocess.CompletedProcess:
    """Run ``python -m mitsuba_bdpt`` with these ``arguments``."""
    keywords = {"env": environment()} | keywords
    line = [sys.executable, "-m", "mitsuba_bdpt", *map(str, arguments)]
    return subprocess.run(line, capture_output=True, text=True, timeout=limit, check=False, **keywords)


@contextlib.contextmanager
def small_disk(size: int):
    """A folder on a disk of so many bytes, and what to pass to `python` or `command` besides.

    Files can't grow beyond so many bytes where this user can't mount one. A third value names which of both
    it is.
    """
    with tempfile.TemporaryDirectory(prefix="bdpt_stress_") as name:
        options = ["-t", "tmpfs", "-o", f"size={size}", "tmpfs", name]
        mounted = subprocess.run(["mount", *options], capture_output=True, check=False).returncode == 0
        try:
            if mounted:
                yield Path(name), {}, f"a disk of {size} bytes"
            else:

                def limited():
                    resource.setrlimit(resource.RLIMIT_FSIZE, (size, size))

                yield Path(name), {"preexec_fn": limited}, f"files of {size} bytes at most"
        finally:
            if mounted:
                subprocess.run(["umount", "-l", name], check=True)


@contextlib.contextmanager
def read_only_folder():
    """A folder that this user can't write to, holding an empty folder ``in``.

    ``None`` where there is no way to make one (root writes everywhere, and may not be allowed to mount).
    """
    with tempfile.TemporaryDirectory(prefix="bdpt_stress_") as name:
        folder = Path(name)
        root, mounted = os.geteuid() == 0, False
        if root:
            options = ["-t", "tmpfs", "-o", "ro", "tmpfs", name]
            mounted = subprocess.run(["mount", *options], capture_output=True, check=False).returncode == 0
        else:
            folder.chmod(0o555)
        try:
            yield folder if mounted or not root else None
        finally:
            if mounted:
                subprocess.run(["umount", "-l", name], check=True)
            else:
                folder.chmod(0o755)


class Lines:
    """A process whose lines on standard output come within some seconds each, or it is killed."""

    def __init__(self, arguments: list[str], limit: float):
        self.limit = limit
        self.process = subprocess.Popen(
            arguments, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, env=environment()
        )
        self._selector = selectors.DefaultSelector()
        self._selector.register(self.process.stdout, selectors.EVENT_READ)
        self._rest = b""
        os.set_blocking(self.process.stdout.fileno(), False)

    def next(self) -> str | None:
        """The next line; None if the process has ended. Raises ``TimeoutError``, the process killed."""
        deadline = time.monotonic() + self.limit
        while b"\n" not in self._rest:
            if not self._selector.select(max(deadline - time.monotonic(), 0)):
                self.process.kill()
                self.process.wait()
                raise TimeoutError
            data = self.process.stdout.read()
            if data == b"":
                self.process.wait()
                return None
            self._rest += data or b""
        line, _, self._rest = self._rest.partition(b"\n")
        return line.decode()
