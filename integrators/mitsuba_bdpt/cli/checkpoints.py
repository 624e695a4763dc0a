"""Checkpoints of ``python -m mitsuba_bdpt render``, to resume a killed render."""

from __future__ import annotations

import hashlib
import json
import os
import sys
import time
from argparse import Namespace
from dataclasses import replace
from pathlib import Path

from ..errors import CommandError
from ..files.loading import contents
from ..files.whole import replacing
from ..run.snapshot import Snapshot, read

BEGIN_ANEW = "begin anew by --resume never"  # what to do about a checkpoint that is of no use


def path_of(output: Path) -> Path:
    return output.with_suffix(".checkpoint.npz")


def digest(options: Namespace) -> str:
    """Hash the loaded scene's files, files and spectra that they name, definitions, sensor and film."""
    film = [options.size, options.crop] if options.size or options.crop else []
    found = hashlib.sha256(json.dumps([sorted(options.defines), options.sensor, *film]).encode())
    for part in contents(options.scene, dict(options.defines), options.append):
        found.update(hashlib.sha256(part).digest())
    return found.hexdigest()


def start(options: Namespace) -> Snapshot | None:
    """Return the snapshot to continue from, or None.

    Raises ``CommandError`` for a snapshot of another scene, or for a missing one that is required.
    """
    path = path_of(options.output)
    if options.checkpoint is None or options.resume == "never":
        return None
    if not path.exists():
        if options.resume == "must":
            raise CommandError(f"resume: there is no checkpoint {str(path)!r}; leave out --resume.")
        return None
    try:
        kept = read(path)
    except ValueError as error:
        raise CommandError(f"resume: {error}; {BEGIN_ANEW}.") from error
    if kept.progress.scene != digest(options):
        raise CommandError(
            f"resume: {str(path)!r} is of another scene: {str(options.scene)!r}, a file that it names, its "
            f"definitions (-D) or the sensor have changed; undo that, or {BEGIN_ANEW}."
        )
    return kept


class Checkpoints:
    """Checkpoints of one render: `after_pass` at intervals, `write` at once."""

    def __init__(self, options: Namespace, start: Snapshot | None = None):
        self.path, self._seconds = path_of(options.output), 60 * options.checkpoint
        self._scene = digest(options)
        self._kept = 0 if start is None else start.spp  # samples per pixel in the file
        self._last, self._report = time.monotonic(), None

    def after_pass(self, report) -> None:
        self._report = report
        if time.monotonic() - self._last >= self._seconds:
            self.write()

    def write(self) -> None:
        """Write the state of the last report, if any.

        A full disk does not end the render: it is reported, and the previous checkpoint is kept.
        """
        if self._report is None:
            return
        snapshot = self._report.snapshot()
        whole = replace(snapshot, progress=replace(snapshot.progress, scene=self._scene))
        try:
            with replacing(self.path) as temporary, temporary.open("wb") as file:
                file.write(whole.to_bytes())
                file.flush()
                # Before renaming, or a power cut could leave a truncated file.
                os.fsync(file.fileno())
            self._kept = whole.spp
        except OSError as error:
            why = f"{error.strerror or error}; the render goes on"
            print(f"warning: no checkpoint {str(self.path)!r}: {why}", file=sys.stderr)
        self._last = time.monotonic()

    def written_at_end(self, done: int) -> None:
        """Write the state of a render that ended with ``done`` samples per pixel.

        Prints where the checkpoint lacks samples of the image.
        """
        self.write()
        if self._kept >= done:
            return
        path, again = repr(str(self.path)), "the same command renders the others again"
        text = f"checkpoint {path} has {self._kept} of the image's {done} samples per pixel; {again}"
        if not self._kept and self._report is None:
            text = f"no checkpoint {path} yet: interrupted in the first pass; the same command starts anew"
        print(text, file=sys.stderr)

    def remove(self) -> None:
        self.path.unlink(missing_ok=True)
