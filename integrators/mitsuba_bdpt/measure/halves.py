"""Sums of the renders of a reference, kept between runs."""

from __future__ import annotations

import json
import math
import zipfile
import zlib
from pathlib import Path

import numpy as np

from ..errors import CommandError
from ..files.whole import replacing
from .agreement import FEWEST_RUNS, Means, tile_columns
from .reference import Reference, kept_of, means_of, source_digest

PASS_SPP = 256
"""Samples per pixel of a render of the whole image."""


class Halves:
    """Sums of two independent halves of the renders, stored in a file.

    With ``counts`` of renders per pixel, the tile means of each whole render, and digests of the plugin's
    sources.
    """

    def __init__(self, path: Path, key: str):
        self.path, self.key, self.rounds, self.columns = path, key, 0, []
        self.sums = self.counts = np.zeros(0)  # allocated in the first round
        self.sources: set[str] = set()
        self.earlier: Means | None = None
        if path.is_file():
            try:
                with path.open("rb") as file:
                    self._take(np.load(file))
            except (EOFError, LookupError, ValueError, zipfile.BadZipFile, zlib.error) as error:
                raise CommandError(
                    f"{str(path)!r} is damaged ({error}); delete it: what references/ holds is gone on from"
                ) from error
        self.sources.add(source_digest())

    def _take(self, kept):
        """Continue from the content of a file, if it is of the same reference."""
        if str(kept["key"]) != self.key:
            print(f"{self.path}: of another scene, integrator or number of samples; begun anew")
            return
        self.rounds, self.sums = int(kept["rounds"]), kept["sums"]
        self.columns = list(kept["columns"])
        whole = np.full((*self.sums.shape[1:3], 1), float(self.rounds))
        self.counts = kept.get("counts", whole)
        self.sources = set(kept["sources"].tolist())
        self.earlier = means_of(json.loads(str(kept["earlier"]))) if "earlier" in kept else None

    def go_on_from(self, stored: Reference, windows: list):
        """Use a stored reference in place of earlier renders.

        Its seeds are not used again. ``windows``: slices of rows and columns.
        """
        spp = stored.provenance["spp"]
        whole, most = spp / (2 * PASS_SPP), stored.provenance.get("spp_in_windows", spp) / (2 * PASS_SPP)
        self.counts = np.full((*stored.image.shape[:2], 1), whole)
        for window in windows:
            self.counts[window] = most
        self.sums = np.stack([stored.image + stored.difference, stored.image - stored.difference])
        self.sums *= self.counts
        self.rounds = math.ceil((1 + len(windows)) * most)  # upper bound of the rounds rendered
        self.sources |= set(stored.provenance.get("sources", ()))  # missing in older files
        self.earlier = stored.means

    def means(self) -> Means | None:
        """Means of all renders of the whole image; None if there are too few."""
        if len(self.columns) < FEWEST_RUNS:
            return self.earlier
        made = Means.of(self.columns)
        return self.earlier.joined(made) if self.earlier else made

    def add(self, images, window=None, times: float = 1.0):
        """Add an image to each half, and store the sums.

        ``window`` (slices of rows and columns): part of the image that was rendered; ``times``: its samples
        relative to a whole image. Raises ``CommandError`` for non-finite values, without changing the sums.
        """
        if not all(np.isfinite(image).all() for image in images):
            raise CommandError(f"{self.path.name}: round {self.rounds} has values that are not finite")
        if not self.rounds:
            self.sums, self.counts = np.zeros((2, *images[0].shape)), np.zeros((*images[0].shape[:2], 1))
        self.sums[:, *(window or ())] += times * np.stack(images)
        self.counts[window or ...] += times
        if window is None:
            self.columns += [tile_columns(image) for image in images]
        self.rounds += 1
        self.path.parent.mkdir(parents=True, exist_ok=True)
        kept = {"sums": self.sums, "counts": self.counts, "columns": np.array(self.columns)}
        kept |= {"earlier": json.dumps(kept_of(self.earlier))} if self.earlier else {}
        with replacing(self.path) as temporary, temporary.open("wb") as file:
            np.savez(file, key=self.key, rounds=self.rounds, sources=sorted(self.sources), **kept)

    def mean(self):
        """Return the image, and half the difference of the halves (a sample of its error)."""
        a, b = self.sums / self.counts
        return (a + b) / 2, (a - b) / 2

    def reference(self, provenance: dict) -> Reference:
        """Return the reference; needs at least one round."""
        image, difference = self.mean()
        return Reference(image, difference, self.means(), provenance)
