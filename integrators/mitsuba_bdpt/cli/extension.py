"""A render that goes on from one of fewer samples per pixel (``--resume --spp MORE``).

The samples of a render are one point sequence, which is over when the render is. More samples are a render of
their own, with a seed of its own, whose raw sums are added: `Snapshot.joined`.
"""

from __future__ import annotations

import json
from argparse import Namespace
from collections.abc import Callable
from dataclasses import asdict, replace
from functools import partial

import mitsuba as mi

from ..errors import CommandError
from ..run.rendering import PassReport
from ..run.snapshot import Snapshot
from .checkpoints import BEGIN_ANEW
from .cluster import STRIDE


def is_needed(kept: Snapshot, spp: int) -> bool:
    """Whether a render of ``spp`` samples per pixel is another one than that of which ``kept`` is a part.

    Raises ``CommandError`` if ``kept`` has as many already.
    """
    if kept.progress.whole and kept.identity["spp"] == spp:
        return False
    if kept.spp >= spp:
        raise CommandError(
            f"resume: the checkpoint has {kept.spp} samples per pixel already; increase --spp, or "
            f"{BEGIN_ANEW}."
        )
    return True


def _decisions(integrator) -> object:
    """The parameter ``decisions`` as identities of snapshots have it."""
    return json.loads(json.dumps(asdict(integrator.settings)["decisions"]))


class Extension:
    """The rest of a render of ``spp`` samples per pixel after those of the snapshot ``kept``."""

    def __init__(self, kept: Snapshot, scene: mi.Scene, integrator, options: Namespace):
        self._kept, self._newest = kept.image_only(), None
        self._assemble = partial(integrator.assemble, scene=scene, sensor=options.sensor)
        used = kept.identity["seed"]
        used = used if isinstance(used, list) else [used]
        # No two parts have one seed.
        seeds = ((options.seed + n * STRIDE) % 2**32 for n in range(len(kept.passes), 2**32))
        self.seed = next(seed for seed in seeds if seed not in used)
        self.assemble()  # what it is not possible with is said now
        if kept.identity["decisions"] != _decisions(integrator):
            raise CommandError(
                "resume: the checkpoint has other decisions; go on with those it was begun with (decisions)."
            )

    @property
    def whole(self) -> Snapshot:
        """All that is done."""
        return self._kept if self._newest is None else self._kept.joined(self._newest.snapshot())

    def watching(self, watch: Callable[[PassReport], object]) -> Callable[[PassReport], None]:
        """A function of the reports of the rest that calls ``watch`` with those of the whole render."""

        def watch_whole(report: PassReport) -> None:
            self._newest = report
            work = self._kept.progress.work
            watch(
                replace(
                    report,
                    spp_done=report.spp_done + self._kept.spp,
                    spp_total=report.spp_total + self._kept.spp,
                    seconds=report.seconds + work.seconds,
                    snapshot=lambda: self.whole,
                    image=self.assemble,
                )
            )

        return watch_whole

    def assemble(self) -> mi.TensorXf:
        """The image of all that is done, which is stored in the film, too."""
        return self._assemble(self.whole)
