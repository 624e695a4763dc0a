"""Checkpoints of ``python -m mitsuba_bdpt render``: what a render that was killed goes on from."""

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
from ..files.images import attribute
from ..files.named import named_files
from ..files.whole import check_writable, replacing
from ..host.versions import versions
from ..run.snapshot import Snapshot, read

BEGIN_ANEW = "begin anew by --resume never"
"""What to do about a checkpoint that is of no use."""

CONTENT = "bdptContent"
"""Attribute of images beside checkpoints: `content`."""


def path_of(output: Path) -> Path:
    """Where the checkpoint of an image lies: beside it."""
    return output.with_suffix(".checkpoint.npz")


def digest(options: Namespace) -> str:
    """Of a scene file, the files that it names, definitions on the command line, sensor and film."""
    film = [options.size, options.crop] if options.size or options.crop else []
    found = hashlib.sha256(json.dumps([sorted(options.defines), options.sensor, *film]).encode())
    for path in (options.scene, *named_files(options.scene, options.defines, options.append)):
        found.update(hashlib.sha256(path.read_bytes()).digest())
    return found.hexdigest()


def content(options: Namespace) -> str:
    """What determines the image of a command line but for its noise, as a hash."""
    names = "variant", "integrator", "properties", "denoise", "exposure"
    return _hash([digest(options), versions(), *(getattr(options, name) for name in names)])


def identity(options: Namespace, spp: int) -> str:
    """What determines the image of a command line with ``spp`` samples per pixel, as a hash."""
    return _hash([content(options), spp, options.seed, options.time, options.target_error])


def _hash(values: list) -> str:
    return hashlib.sha256(json.dumps(values).encode()).hexdigest()


def attributes(options: Namespace, output: Path) -> dict[str, str]:
    """Attributes of an image for renders that are resumed beside it."""
    is_needed = options.checkpoint is not None or path_of(output).exists()
    return {CONTENT: content(options)} if is_needed else {}


def samples_of_image(options: Namespace, output: Path) -> int:
    """Samples per pixel of the image that a resumed render would replace; 0 if it is of other content."""
    is_resumed = options.checkpoint is not None and options.resume != "never" and path_of(output).exists()
    if not is_resumed or attribute(output, CONTENT) != content(options):
        return 0
    return int(json.loads(attribute(output, "bdptStatistics") or "{}").get("spp", 0))


def check(options: Namespace, output: Path) -> None:
    """Raise an error if no checkpoint can be written."""
    path = path_of(output)
    if options.checkpoint is not None:
        check_writable(path)


def start(options: Namespace, output: Path) -> Snapshot | None:
    """The snapshot to go on from, None to begin; raises ``CommandError`` for one of another scene.

    Also if there has to be one and there is none.
    """
    path = path_of(output)
    if options.checkpoint is None or options.resume == "never":
        return None
    if not path.exists():
        if options.resume == "must":
            raise CommandError(
                f"resume: there is no checkpoint {str(path)!r}; leave out --resume to begin anew."
            )
        return None
    try:
        kept = read(path)
    except ValueError as error:
        raise CommandError(f"resume: {error}; {BEGIN_ANEW}.") from error
    if kept.progress.scene != digest(options):
        raise CommandError(
            f"resume: {str(path)!r} is of another scene: {str(options.scene)!r}, a file that "
            "it names, its definitions (-D) or the sensor have changed; go on with those it was begun with, "
            f"or {BEGIN_ANEW}."
        )
    return kept


class Checkpoints:
    """Writes the checkpoints of one render: `after_pass` every so many minutes, `write` at once."""

    def __init__(self, options: Namespace, output: Path):
        self.path, self._seconds, self._scene = path_of(output), 60 * options.checkpoint, digest(options)
        self._last, self._report = time.monotonic(), None

    def after_pass(self, report) -> None:
        """To be called with every ``PassReport``."""
        self._report = report
        if time.monotonic() - self._last >= self._seconds:
            self.write()

    def write(self) -> None:
        """Write what the last report knows, if there was one.

        A full disk must not cost the render: it is said on standard error, and the former checkpoint stays.
        """
        if self._report is None:
            return
        snapshot = self._report.snapshot()
        whole = replace(snapshot, progress=replace(snapshot.progress, scene=self._scene))
        try:
            with replacing(self.path) as temporary, temporary.open("wb") as file:
                file.write(whole.to_bytes())
                file.flush()
                # Before the name, which would stand for half a file after a power cut.
                os.fsync(file.fileno())
        except OSError as error:
            why = f"{error.strerror or error}; the render goes on"
            print(f"warning: no checkpoint {str(self.path)!r}: {why}", file=sys.stderr)
        self._last = time.monotonic()

    def remove(self) -> None:
        """The render is finished and its image written: there is nothing to go on from."""
        self.path.unlink(missing_ok=True)
