"""Makes reference images that include an estimate of their own error.

A reference is good enough if its own error adds at most 1 % to the relMSE, raw and trimmed, of `bdpt` with
the samples per pixel that it has to judge (and of `path` in the same time if `path` makes it); one that
another command makes on the way, which subtracts its error, 10 %. It is the mean of two halves with different
seeds, which differ by twice the standard error of their mean, rendered until that is reached or the time is
over. `Recipe` names the integrator; windows in which few samples find the light have more samples.

`reference` describes the files. Each round is stored; a further run continues from the stored image, whose
rounding to half precision is far below its error.
"""

from __future__ import annotations

import datetime
import math
import platform
import time
from argparse import Namespace
from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import mitsuba as mi
import numpy as np

from ..errors import CommandError, message
from ..files.texts import read_toml
from ..files.whole import check_writable
from ..host.introspection import versions
from ..run.rendering import raise_interrupt
from .agreement import FEWEST_RUNS, TILES, Means, tile_columns
from .metrics import TRIM, rel_mse
from .models import Radiance, Recipe, checked
from .options import REFERENCE_SECONDS, VARIANT, MakeReference
from .project import Project
from .reference import (
    Reference,
    header_of,
    load_reference,
    make_command,
    reference_path,
    source_digest,
    write,
)
from .scenes import SceneFile, integrator_of, path_tracers, samples_taken
from .showing import amount

EVERYTHING = {"type": "bdpt", "skip": "none", "light_paths": 1, "connections": "all", "merging": False}
WAYS = {
    "path": {"type": "path"},
    "bdpt": EVERYTHING,
    "merging": EVERYTHING | {"merging": True, "spp_per_pass": 64},
}
"""What makes references, see `_way`. Passes of so few samples have the most photons."""

FOCUS_TIMES = 16  # times the samples of the rest, in windows

# Samplers of `path` (`multijitter` has half the error of `independent` at equal time) and of `volpath` (whose
# images of grids have NaN with `multijitter`, Mitsuba 3.9.1).
SAMPLER = "multijitter"
OF_MEDIA = "independent"

PASS_SPP = 256
"""Samples per pixel of a render of the whole image, where there is time."""

LEAST_SPP, TRIAL_SPP = 4, 16
"""Samples per pixel of such a render at least; and of one that measures the seconds of a sample."""

FITTED = 0.8  # share of the time left for which renders are planned

FIRST_SEED = 1_000_000  # far from the seeds of measurements
WINDOW_PASSES = 4  # per render of a window
TRIALS = 3  # renders of bdpt that estimate the error to judge
TWICE = 2  # samples of `path` in the time of one of `bdpt`, approximately
REFERENCE_SHARE = 0.01  # largest share of the reference's own error in a measured error
SUBTRACTED_SHARE = 0.1  # the same where the reference is made on the way
MARGIN = 0.9  # of that share


def recipe_of(project: Project, name: str) -> Recipe:
    file = project.references / "scenes.toml"
    tables = read_toml(file) if file.is_file() else {}
    return checked(Recipe, tables.get(name, {}), f"{file}: [{name}]")


@dataclass(frozen=True)
class Job:
    """A reference to be made.

    ``spp``: of the renders to judge; ``share``: the largest of its own error in theirs; ``seconds``: time
    limit, after the first `FEWEST_RUNS` renders; ``max_depth``: None for the project's; ``by``: a key of
    `WAYS` that replaces the recipe's.
    """

    project: Project
    scene: SceneFile
    resolution: int
    max_depth: int | None = None
    spp: int = 64
    seconds: float = REFERENCE_SECONDS
    by: str | None = None
    share: float = REFERENCE_SHARE

    @cached_property
    def scene_sha256(self) -> str:
        """SHA-256 of the scene, computed before it is rendered."""
        return self.scene.sha256

    @cached_property
    def depth(self) -> int:
        return self.max_depth or self.project.depth(self.scene)

    @property
    def spp_per_render(self) -> int:
        """Samples per pixel of a render of the whole image where there is time.

        At most `PASS_SPP`; the smallest power of two for which `FEWEST_RUNS` reach the ``share``.
        """
        enough = self.spp / self.share / FEWEST_RUNS
        return min(max(2 ** math.ceil(math.log2(enough)), LEAST_SPP), PASS_SPP)

    @property
    def path(self) -> Path:
        return reference_path(self.project, self.scene.name, self.resolution, self.depth)

    @property
    def is_outdated(self) -> bool:
        """Whether the stored reference is of another version of the scene."""
        sha256 = self.scene_sha256
        return self.path.is_file() and header_of(self.path).get("scene_sha256", sha256) != sha256

    @property
    def is_missing(self) -> bool:
        """Whether there is no reference of this version of the scene, or one that was interrupted."""
        is_begun = self.path.is_file() and header_of(self.path).get("means", True) is None
        return not self.path.is_file() or self.is_outdated or is_begun

    @property
    def stored(self) -> Reference | None:
        """The stored reference; None if it is of another scene."""
        try:
            return load_reference(self.project, self.scene, self.resolution, self.depth)
        except ValueError:
            return None


def requested(project: Project, name: str, options: MakeReference | Namespace) -> Job:
    """Return the job of a scene, a file or a name, by the ``options``."""
    scene = project.scene(name)
    limits = options.max_depth, options.spp, options.seconds, options.by
    return Job(project, scene, fitted(scene, options.resolution), *limits)


def obtained(job: Job) -> Reference:
    """Return the stored reference, or make it if it is missing or of another version of the scene.

    A new one is reported on standard output. It ends when its own error is a tenth of the renders', or at the
    time limit.
    """
    check(job)
    if job.is_missing:
        made = replace(job, max_depth=job.depth, share=SUBTRACTED_SHARE)
        print(said(made, *make(made)), flush=True)
    return load_reference(job.project, job.scene, job.resolution, job.depth)


def check(job: Job) -> None:
    """Raise ``CommandError``, before rendering, if a reference cannot be made."""
    recipe_of(job.project, job.scene.name)
    if (width := fitted(job.scene, job.resolution)) != job.resolution:
        raise CommandError(f"resolution={job.resolution} of {job.scene.name!r} must be {width}")
    try:
        if job.is_missing:
            job.path.parent.mkdir(parents=True, exist_ok=True)
            check_writable(job.path)
    except OSError as error:
        raise CommandError(
            f"project={str(job.project.root)!r}: the reference of {job.scene.name} cannot be written into "
            f"{str(job.path.parent)!r} ({error.strerror}); name another folder, for references, by --project"
        ) from error


def make(job: Job) -> tuple[Reference, bool]:
    """Render until the reference is good enough or the time is over, and store it.

    Returns it, and whether it is good enough. A reference cut short by time does not replace a better one of
    the same light and version of the scene.
    """
    check(job)
    recipe = recipe_of(job.project, job.scene.name)
    check_writable(job.path)
    if recipe.radiance is not None:
        reference = _known(job, recipe.radiance)
        write(job.path, reference)
        return reference, True
    if job.is_missing:
        print(_announced(job), flush=True)
    return _rendered(job, recipe)


def _announced(job: Job) -> str:
    where = f"{job.resolution} and depth {job.depth}"
    if job.is_outdated:
        why = f"the scene has changed since its reference at {where} was made; making one anew"
    else:
        why = f"no reference at {where} yet; making one"
    return f"{job.scene.name}: {why}, for at most about {job.seconds:g} s"


def fitted(scene: SceneFile, wanted: int) -> int:
    """Load a scene, and return the nearest width at which it can be measured; prints a message if it differs.

    Raises ``CommandError`` if there is none near.
    """
    widths = range(TILES, max(4 * wanted, TILES + 1), TILES)
    fitting = [n for n in widths if scene.size(n)[1] % TILES == 0]
    width = min(fitting, key=lambda n: abs(n - wanted), default=None)
    if width is None:
        own = " x ".join(map(str, scene.size()))
        raise CommandError(
            f"scene={scene.name!r} has a film of {own} pixels, which divides into {TILES} x {TILES} tiles at "
            f"no width near {wanted}; take another resolution"
        )
    if width != wanted:
        size, asked = (" x ".join(map(str, scene.size(n))) for n in (width, wanted))
        why = f"the {asked} of resolution={wanted} do not divide into {TILES} x {TILES} tiles"
        print(f"{scene.name}: rendered with {size} pixels: {why}", flush=True)
    return width


def _pixels(image):
    return np.array(image, dtype=np.float64)[..., :3]


class Halves:
    """Sums of two independent halves of the renders.

    With ``counts`` of renders per pixel, the tile means of each whole render (of those with the most samples,
    ``times`` `PASS_SPP`), and digests of the plugin's sources.
    """

    def __init__(self, name: str):
        self.name, self.rounds, self.columns, self.times = name, 0, [], 0.0
        self.sums = self.counts = np.zeros(0)  # allocated in the first round
        self.sources = {source_digest()}
        self.earlier: Means | None = None

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
        # Older files have no rounds: an upper bound.
        self.rounds = stored.provenance.get("rounds", math.ceil((1 + len(windows)) * most))
        self.sources |= set(stored.provenance.get("sources", ()))  # missing in older files
        self.earlier = stored.means

    def means(self) -> Means | None:
        """Means of all renders of the whole image; None if there are too few."""
        if len(self.columns) < FEWEST_RUNS:
            return self.earlier
        made = Means.of(self.columns)
        # Earlier renders may have had far more or far fewer samples.
        found = [made, self.earlier, self.earlier.joined(made)] if self.earlier else [made]
        return min(found, key=lambda means: float(np.max(means.whole.error)))

    def add(self, images, window=None, times: float = 1.0):
        """Add an image to each half.

        ``window`` (slices of rows and columns): part of the image that was rendered; ``times``: its samples
        relative to a whole image. Raises ``CommandError`` for non-finite values, without changing the sums.
        """
        if not all(np.isfinite(image).all() for image in images):
            raise CommandError(f"{self.name}: round {self.rounds} has values that are not finite")
        if not self.rounds:
            self.sums, self.counts = np.zeros((2, *images[0].shape)), np.zeros((*images[0].shape[:2], 1))
        self.sums[:, *(window or ())] += times * np.stack(images)
        self.counts[window or ...] += times
        if window is None and times > self.times:
            self.earlier, self.columns, self.times = self.means(), [], times
        if window is None and times == self.times:
            self.columns += [tile_columns(image) for image in images]
        self.rounds += 1

    def reference(self, provenance: dict) -> Reference:
        a, b = self.sums / self.counts
        return Reference((a + b) / 2, (a - b) / 2, self.means(), provenance)


class AccuracyTarget:
    """The renders that a reference has to judge.

    Default `bdpt` with ``spp`` samples per pixel (with `merging` if that makes the reference), and a path
    tracer in the same time if that makes it.
    """

    def __init__(self, job: Job, scene, by: str):
        self.job, self.scene, self.by = job, scene, by

    @cached_property
    def images(self) -> list[np.ndarray]:
        found: list[np.ndarray] = []
        ours = {"type": "bdpt", "merging": self.by == "merging"}
        rivals = [(ours, self.job.spp)]
        rivals += [(_way(self.job.scene, self.by), TWICE * self.job.spp)] * (self.by == "path")
        for parameters, samples in rivals:
            rival = integrator_of(parameters, self.job.depth)
            for seed in range(TRIALS):
                spp = samples_taken(self.scene, rival, samples)
                image = mi.render(self.scene, integrator=rival, spp=spp, seed=seed)
                found.append(_pixels(image))
        return found

    def check(self, reference: Reference) -> None:
        """Raise ``CommandError`` if a reference is black, since errors are relative."""
        if not reference.image.any():
            raise CommandError(
                f"scene={self.job.scene.name!r} is black: the samples of its reference found no light; check "
                f"its lamps, its sensor and max_depth={self.job.depth}, or leave it out"
            )

    def reached(self, reference: Reference) -> bool:
        """Return whether the reference is good enough for their errors and a bias check."""
        self.check(reference)
        if reference.means is None:
            return False
        return all(
            reference.share_of(image, trim) <= MARGIN * self.job.share * rel_mse(image, reference.image, trim)
            for image in self.images
            for trim in (0.0, TRIM)
        )


def _way(scene: SceneFile, by: str, merging_radius: float = 0.25) -> dict:
    """Return the integrator's parameters for a key ``by`` of `WAYS`, for `_loaded`.

    ``merging_radius``: in pixels.
    """
    if by == "path":
        return {"type": path_tracers(scene.has_media)[0]}
    return WAYS[by] | ({"merging_radius": merging_radius} if by == "merging" else {})


def _loaded(way: dict) -> mi.Integrator:
    """Load an integrator; ``merging_radius`` is one of `settings.Internals`."""
    integrator = mi.load_dict({name: value for name, value in way.items() if name != "merging_radius"})
    if "merging_radius" in way:
        integrator.settings = integrator.settings.varied(merging_radius=way["merging_radius"])
    return integrator


def provenance_of(job: Job, **more: Any) -> dict[str, Any]:
    return {
        "scene": job.scene.name,
        "scene_sha256": job.scene_sha256,
        "resolution": job.resolution,
        "max_depth": job.depth,
        "date": datetime.date.today().isoformat(),
        "machine": platform.machine(),
        "versions": versions(),
        **more,
    }


def _known(job: Job, radiance: Radiance) -> Reference:
    width, height = job.scene.size(job.resolution)
    value = radiance.limit - (radiance.lacks * 2.0**-job.depth if job.depth > 0 else 0.0)
    image = np.full((height, width, 3), value)
    provenance = provenance_of(job, integrator="known answer")
    return Reference(image, 0 * image, Means.known(image), provenance)


def _rendered(job: Job, recipe: Recipe) -> tuple[Reference, bool]:
    """Render and store a reference, or return the better one that is stored; False if time was over first."""
    started = time.perf_counter()
    by = job.by or recipe.by
    parameters = _way(job.scene, by, recipe.merging_radius) | {"max_depth": job.depth}
    integrator = _loaded(parameters)
    sampler = OF_MEDIA if parameters["type"] == path_tracers(True)[0] else SAMPLER
    made_by = {"integrator": parameters, "sampler": sampler}
    scene = job.scene.load(job.resolution, sampler)
    windows = [Window(job, share, sampler) for share in recipe.windows]
    halves, aim, stored = Halves(job.scene.name), AccuracyTarget(job, scene, by), job.stored
    if stored is not None and made_by.items() <= stored.provenance.items():
        halves.go_on_from(stored, [window.slices for window in windows])
        if aim.reached(halves.reference({})):
            return stored, True
        stored = None
    spp = _fitting(job, scene, integrator, started)
    for reached in _refined(job, halves, aim, (scene, integrator, windows), spp, started):
        counts = halves.counts * 2 * PASS_SPP
        provenance = provenance_of(
            job,
            **made_by,
            spp=round(float(counts.min())),
            spp_in_windows=round(float(counts.max())),
            spp_per_render=spp,
            rounds=halves.rounds,
            first_seed=FIRST_SEED,
            sources=sorted(halves.sources),
            judges_spp=job.spp,
            share=job.share,
        )
        made = halves.reference(provenance)
        if stored is None or reached:
            write(job.path, made)
    if stored is not None and not reached:
        if stored.merged == made.merged and stored.error < made.error:
            print(f"{job.scene.name}: the stored reference is better than what the time allowed, and stays")
            return stored, False
        write(job.path, made)
    return made, reached


def _fitting(job: Job, scene, integrator, started: float) -> int:
    """Return the samples per pixel of renders of which `FEWEST_RUNS` fit into a job's seconds.

    A power of two, `LEAST_SPP` to ``job.spp_per_render``, or what the sampler makes of it. Prints a warning
    where not even the least fit.
    """

    def seconds(spp: int) -> float:
        began = time.perf_counter()
        np.array(mi.render(scene, integrator=integrator, spp=spp, seed=FIRST_SEED - 1))
        return time.perf_counter() - began

    seconds(LEAST_SPP)  # compiles
    of_a_sample = seconds(TRIAL_SPP) / TRIAL_SPP
    spent = time.perf_counter() - started
    wanted = FITTED * (job.seconds - spent) / (FEWEST_RUNS * of_a_sample)
    if wanted < LEAST_SPP:
        least = spent + FEWEST_RUNS * LEAST_SPP * of_a_sample
        print(
            f"warning: {job.scene.name}: {job.seconds:g} s are too few for its reference, which takes about "
            f"{least:.2g} s with the fewest samples ({spent:.2g} s to load and compile)",
            flush=True,
        )
    found = min(2 ** math.floor(math.log2(max(wanted, LEAST_SPP))), job.spp_per_render)
    return samples_taken(scene, integrator, found)


def _refined(
    job: Job, halves: Halves, aim: AccuracyTarget, rendered: tuple, spp: int, started: float
) -> Iterator[bool]:
    """Add rounds to the ``halves`` until they are good enough or the time is over.

    Yields whether they are, after each round. ``rendered``: scene, integrator and windows; ``spp``: of each
    render. On the way to other renders, those with less than the job's are not judged: there is no time.
    """
    scene, integrator, windows = rendered
    reached, spent, last = False, 0.0, 0.0
    with amount(f"{job.scene.name}: seconds of the reference", job.seconds) as show:
        # A round that would end too late does not begin.
        while halves.means() is None or not (reached or spent + last > job.seconds):
            began = time.perf_counter()
            behind = [w for w in windows if w.is_behind(halves)]
            for window in behind:
                count = samples_taken(window.scene, integrator, WINDOW_PASSES * spp)
                images = _pair(window.scene, integrator, halves, count)
                halves.add(images, window.slices, count / PASS_SPP)
            if not behind:
                halves.add(_pair(scene, integrator, halves, spp), times=spp / PASS_SPP)
            now = halves.reference({})
            aim.check(now)
            reached = (spp >= job.spp_per_render or job.share == REFERENCE_SHARE) and aim.reached(now)
            spent, last = time.perf_counter() - started, time.perf_counter() - began
            show(spent)
            yield reached


def _pair(scene, integrator, halves: Halves, spp: int):
    seed = FIRST_SEED + 2 * halves.rounds
    return [_pixels(mi.render(scene, integrator=integrator, spp=spp, seed=seed + i)) for i in (0, 1)]


class Window:
    """A part of the image that needs more samples.

    The ``scene`` with that crop window, and its ``slices`` of rows and columns.
    """

    def __init__(self, job: Job, share, sampler: str):
        self.scene = job.scene.load(job.resolution, sampler)
        if not self.scene.sensors()[0].film().rfilter().is_box_filter():
            raise CommandError(f"scene={job.scene.name!r}: windows need rfilter 'box', or borders differ")
        size = np.array(self.scene.sensors()[0].film().size())
        low, high = np.floor(share[:2] * size).astype(int), np.ceil(share[2:] * size).astype(int)
        self.slices = (slice(low[1], high[1]), slice(low[0], high[0]))
        parameters = mi.traverse(self.scene)
        for name, value in (("crop_size", high - low), ("crop_offset", low)):
            (key,) = (key for key in parameters.keys() if key.endswith(f"film.{name}"))
            parameters[key] = value.tolist()
        parameters.update()

    def is_behind(self, halves: Halves) -> bool:
        """Return whether it has less than `FOCUS_TIMES` the samples of the rest."""
        if not halves.rounds:
            return False
        return halves.counts[self.slices].min() < FOCUS_TIMES * halves.counts.min()


def said(job: Job, made: Reference, reached: bool) -> str:
    text = f"{job.scene.name}: {made.provenance.get('spp', 'known answer')} spp, own relMSE {made.error:.1e}"
    if reached:
        return text
    own = job.project, job.project.called(job.scene), job.resolution, job.depth
    is_short = made.provenance.get("spp_per_render", PASS_SPP) < job.spp_per_render
    why = f"as many as fit into {job.seconds:.3g} s" if is_short else f"not good enough for {job.spp} spp"
    return f"{text}, {why}; to go on: {make_command(*own, '--spp', str(job.spp))}"


def run(options: Namespace) -> int:
    """Make the references that the command-line ``options`` name.

    Returns 1 if one failed or is not good enough.
    """
    if not (options.all or options.scenes):
        raise CommandError("reference: name a scene, or give --all")
    if options.all and options.scenes:
        raise CommandError(
            f"reference: {options.scenes[0]!r} together with --all: leave out one or the other"
        )
    project, status = Project(options.project), 0
    names = project.scene_names() if options.all else options.scenes
    if not names:
        raise CommandError(
            f"reference --all: there is no scene in {str(project.scenes)!r}; name the folder that has "
            "scenes/ by --project, or give the path of an XML file"
        )
    mi.set_variant(VARIANT)
    for name in names:
        try:
            job = requested(project, name, options)
            made, reached = make(job)
        except (ValueError, RuntimeError, NotImplementedError) as error:  # continue with the other scenes
            raise_interrupt(error)
            print(f"{name}: failed: {' '.join(message(error).split())}", flush=True)
            status = 1
            continue
        status |= not reached
        print(said(job, made, reached), flush=True)
    return int(status)
