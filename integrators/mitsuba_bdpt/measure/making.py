"""Makes reference images that include an estimate of their own error.

A reference for renders of n samples per pixel has 100 n; one that another command makes on the way, which
subtracts the reference's own error, 10 n. It is the mean of two halves with different seeds, which differ by
twice the standard error of their mean. `Recipe` names the integrator; windows in which few samples find the
light have more samples.

`reference` describes the files. Each round is stored; a further run continues from the stored image, whose
rounding to half precision is far below its error.
"""

from __future__ import annotations

import datetime
import math
import platform
import time
from argparse import Namespace
from contextlib import suppress
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
from .scenes import SceneFile, path_tracers, samples_taken
from .showing import amount

EVERYTHING = {"type": "bdpt", "skip": "none", "light_paths": 1, "connections": "all", "merging": False}

# Passes of few samples have the most photons. A pilot decides the rest: its tables of emission leave 1/20 of
# the variance of `pool_water`.
MERGING = {"type": "bdpt", "merging": True, "spp_per_pass": 64}

FOCUS_TIMES = 16  # times the samples of the rest, in windows
WINDOW_PASSES = 4  # times the samples of a render of the whole image, in one of a window

# Samplers of `path` (`multijitter` has half the error of `independent` at equal time) and of `volpath` (whose
# images of grids have NaN with `multijitter`, Mitsuba 3.9.1).
SAMPLER = "multijitter"
OF_MEDIA = "independent"

LEAST_SPP, PASS_SPP, TRIAL_SPP = 4, 256, 16
"""Samples per pixel of a render of the whole image, least and most; of one that measures seconds."""

FITTED = 0.8  # share of the time left for which renders are planned
FIRST_SEED = 1_000_000  # far from the seeds of measurements
SHARE, SHARE_ON_THE_WAY = 0.01, 0.1  # samples of the judged renders over the reference's


def recipe_of(project: Project, name: str) -> Recipe:
    file = project.references / "scenes.toml"
    tables = read_toml(file) if file.is_file() else {}
    return checked(Recipe, tables.get(name, {}), f"{file}: [{name}]")


@dataclass(frozen=True)
class Job:
    """A reference to be made.

    ``spp``: of the renders to judge; ``share``: of these in its own samples; ``seconds``: time limit, after
    the first `FEWEST_RUNS` renders; ``max_depth``: None for the project's; ``by``: replaces the recipe's.
    """

    project: Project
    scene: SceneFile
    resolution: int
    max_depth: int | None = None
    spp: int = 64
    seconds: float = REFERENCE_SECONDS
    by: str | None = None
    share: float = SHARE

    @cached_property
    def scene_sha256(self) -> str:
        """SHA-256 of the scene, computed before it is rendered."""
        return self.scene.sha256

    @cached_property
    def depth(self) -> int:
        return self.max_depth or self.project.depth(self.scene)

    @property
    def samples(self) -> int:
        """Samples per pixel that are enough."""
        return round(self.spp / self.share)

    @property
    def spp_per_render(self) -> int:
        """Samples per pixel of a render, by `FEWEST_RUNS`: a power of two to `PASS_SPP`."""
        return min(max(2 ** math.ceil(math.log2(self.samples / FEWEST_RUNS)), LEAST_SPP), PASS_SPP)

    @property
    def path(self) -> Path:
        return reference_path(self.project, self.scene.name, self.resolution, self.depth)

    @cached_property
    def header(self) -> dict[str, Any]:
        """Provenance of the stored reference, before this job."""
        return header_of(self.path)

    @property
    def lack(self) -> str:
        """Why the reference has to be made or refined before this job; empty if it need not.

        Of this version of the scene it is enough with its samples, or if a time limit ended it when as many
        were wanted.
        """
        header, where = self.header, f"{self.resolution} and depth {self.depth}"
        if header.get("scene_sha256", self.scene_sha256) != self.scene_sha256:
            return f"the scene has changed since its reference at {where} was made; making one anew"
        if not self.path.is_file():
            return f"no reference at {where} yet; making one"
        spp = header.get("spp", self.samples)  # a known answer has none
        if header.get("means", True) and max(spp, header.get("ended_for", 0)) >= self.samples:
            return ""
        return f"the reference at {where} has {spp} of {self.samples} samples per pixel; going on"


def requested(project: Project, name: str, options: MakeReference | Namespace) -> Job:
    """Return the job of a scene, a file or a name, by the ``options``."""
    scene = project.scene(name)
    limits = options.max_depth, options.spp, options.seconds, options.by
    return Job(project, scene, fitted(scene, options.resolution), *limits)


def obtained(job: Job) -> Reference:
    """Return the stored reference; makes or refines it first if it lacks samples.

    That is reported on standard output, see `Job.lack`. It ends at 10 times the samples of the renders, or at
    the time limit.
    """
    job = replace(job, share=SHARE_ON_THE_WAY, by=job.by or job.header.get("by"))
    if job.lack:
        print(summary(job, *make(job)), flush=True)
    return load_reference(job.project, job.scene, job.resolution, job.depth)


def check(job: Job, writes: bool = False) -> Recipe:
    """Return the recipe; raises ``CommandError`` if a reference cannot be made.

    ``writes``: it is also rewritten if it lacks nothing.
    """
    recipe = recipe_of(job.project, job.scene.name)
    if (width := fitted(job.scene, job.resolution)) != job.resolution:
        raise CommandError(f"resolution={job.resolution} of {job.scene.name!r} must be {width}")
    try:
        if writes or job.lack:
            job.path.parent.mkdir(parents=True, exist_ok=True)
            check_writable(job.path)
    except OSError as error:
        raise CommandError(
            f"project={str(job.project.root)!r}: the reference of {job.scene.name} cannot be written into "
            f"{str(job.path.parent)!r} ({error.strerror}); name another folder, for references, by --project"
        ) from error
    return recipe


def make(job: Job) -> tuple[Reference, bool]:
    """Render until the reference has enough samples or the time is over, and store it.

    Returns it, and whether it has enough. A reference cut short by time does not replace a better one of
    the same light and version of the scene.
    """
    recipe = check(job, writes=True)
    if recipe.radiance is not None:
        reference = _known(job, recipe.radiance)
        write(job.path, reference)
        return reference, True
    if lack := job.lack:
        print(f"{job.scene.name}: {lack}, for at most about {job.seconds:g} s", flush=True)
    return _rendered(job, recipe)


def fitted(scene: SceneFile, wanted: int) -> int:
    """Return the width nearest to ``wanted`` at which a scene can be measured.

    Prints a message if it differs. Raises ``CommandError`` if there is none near.
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


class Halves:
    """Sums of two independent halves of the renders, with samples per pixel.

    ``spp`` (height, width, 1) of each half; ``columns``: the tile means of each whole render, of those with
    the most samples; ``sources``: digests of the plugin's sources.
    """

    def __init__(self, name: str):
        self.name, self.rounds, self.columns, self.most = name, 0, [], 0
        self.sums = self.spp = np.zeros(0)  # allocated in the first round
        self.sources = {source_digest()}
        self.earlier: Means | None = None

    def go_on_from(self, stored: Reference, windows: list):
        """Use a stored reference in place of earlier renders.

        Its seeds are not used again. ``windows``: slices of rows and columns.
        """
        kept = stored.provenance
        most = kept.get("spp_in_windows", kept["spp"])
        self.spp = np.full((*stored.image.shape[:2], 1), kept["spp"] / 2)
        for window in windows:
            self.spp[window] = most / 2
        self.sums = np.stack([stored.image + stored.difference, stored.image - stored.difference]) * self.spp
        # Older files have neither: an upper bound of rounds.
        self.rounds = kept.get("rounds", math.ceil((1 + len(windows)) * most / (2 * PASS_SPP)))
        self.sources |= set(kept.get("sources", ()))
        self.earlier = stored.means

    def means(self) -> Means | None:
        """Means of all renders of the whole image; None if there are too few."""
        if len(self.columns) < FEWEST_RUNS:
            return self.earlier
        made = Means.of(self.columns)
        # Earlier renders may have had far more or far fewer samples.
        found = [made, self.earlier, self.earlier.joined(made)] if self.earlier else [made]
        return min(found, key=lambda means: float(np.max(means.whole.error)))

    def is_enough(self, job: Job) -> bool:
        return self.means() is not None and 2 * self.spp.min() >= job.samples

    def add(self, images, spp: int, window=None):
        """Add an image of ``spp`` samples per pixel to each half.

        ``window`` (slices of rows and columns): part of the image that was rendered. Raises ``CommandError``
        for non-finite values, without changing the sums.
        """
        if not all(np.isfinite(image).all() for image in images):
            raise CommandError(f"{self.name}: round {self.rounds} has values that are not finite")
        if not self.rounds:
            self.sums, self.spp = np.zeros((2, *images[0].shape)), np.zeros((*images[0].shape[:2], 1))
        self.sums[:, *(window or ())] += spp * np.stack(images)
        self.spp[window or ...] += spp
        if window is None and spp > self.most:
            self.earlier, self.columns, self.most = self.means(), [], spp
        if window is None and spp == self.most:
            self.columns += [tile_columns(image) for image in images]
        self.rounds += 1

    def render(self, scene, integrator, spp: int, window=None):
        """Render, and `add`, two images of at least ``spp`` samples per pixel."""
        spp, seed = samples_taken(scene, integrator, spp), FIRST_SEED + 2 * self.rounds
        films = [mi.render(scene, integrator=integrator, spp=spp, seed=seed + i) for i in (0, 1)]
        self.add([np.array(film, dtype=np.float64)[..., :3] for film in films], spp, window)

    def reference(self, provenance: dict) -> Reference:
        a, b = self.sums / self.spp
        return Reference((a + b) / 2, (a - b) / 2, self.means(), provenance)


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


def _maker(job: Job, recipe: Recipe) -> tuple[mi.Integrator, dict[str, Any]]:
    """Return what renders a reference, and its parameters with ``merging_radius``."""
    by = job.by or recipe.by
    tracer = {"type": path_tracers(job.scene.has_media)[0]}
    parameters = {"path": tracer, "bdpt": EVERYTHING, "merging": MERGING}[by] | {"max_depth": job.depth}
    integrator = mi.load_dict(parameters)
    if by == "merging":
        integrator.settings = integrator.settings.varied(merging_radius=recipe.merging_radius)
        parameters["merging_radius"] = recipe.merging_radius
    return integrator, parameters


def _rendered(job: Job, recipe: Recipe) -> tuple[Reference, bool]:
    """Render and store a reference, or return the better one that is stored.

    With False if time was over first.
    """
    started = time.perf_counter()
    integrator, parameters = _maker(job, recipe)
    sampler = OF_MEDIA if parameters["type"] == path_tracers(True)[0] else SAMPLER
    made_by = {"integrator": parameters, "sampler": sampler}
    scene = job.scene.load(job.resolution, sampler)
    windows = [Window(job, share, sampler) for share in recipe.windows]
    halves, stored = Halves(job.scene.name), None
    with suppress(ValueError):  # there is none, or it is of another scene
        stored = load_reference(job.project, job.scene, job.resolution, job.depth)
    if stored is not None and made_by.items() <= stored.provenance.items():
        halves.go_on_from(stored, [window.slices for window in windows])
        if halves.is_enough(job):
            return stored, True
        stored = None
    spp = _fitting(job, scene, integrator, started)
    with amount(f"{job.scene.name}: seconds of the reference", job.seconds) as show:
        is_over = False
        while not is_over:
            began = time.perf_counter()
            behind = [window for window in windows if window.is_behind(halves)]
            for window in behind:
                halves.render(window.scene, integrator, WINDOW_PASSES * spp, window.slices)
            if not behind:
                halves.render(scene, integrator, spp)
            if not halves.sums.any():
                raise CommandError(
                    f"scene={job.scene.name!r} is black: the samples of its reference found no light; check "
                    f"its lamps, its sensor and max_depth={job.depth}, or leave it out"
                )
            spent, last = time.perf_counter() - started, time.perf_counter() - began
            # A round that would end too late does not begin.
            is_over = halves.means() is not None and (halves.is_enough(job) or spent + last > job.seconds)
            if stored is None:
                write(job.path, _made(job, halves, spp, made_by, is_over))
            show(spent)
    found, reached = _made(job, halves, spp, made_by, True), halves.is_enough(job)
    if stored is None:
        return found, reached
    if not reached and stored.merged == found.merged and stored.error < found.error:
        print(f"{job.scene.name}: the stored reference is better than what the time allowed, and stays")
        found = replace(stored, provenance=stored.provenance | {"ended_for": job.samples})
    write(job.path, found)
    return found, reached


def _made(job: Job, halves: Halves, spp: int, made_by: dict[str, Any], is_over: bool) -> Reference:
    return halves.reference(
        provenance_of(
            job,
            **made_by,
            by=job.by,
            ended_for=job.samples if is_over else 0,
            spp=round(2 * float(halves.spp.min())),
            spp_in_windows=round(2 * float(halves.spp.max())),
            spp_per_render=spp,
            rounds=halves.rounds,
            first_seed=FIRST_SEED,
            sources=sorted(halves.sources),
            judges_spp=job.spp,
            share=job.share,
        )
    )


def _fitting(job: Job, scene, integrator, started: float) -> int:
    """Return the samples per pixel of which `FEWEST_RUNS` renders fit into the time.

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
        return halves.rounds > 0 and halves.spp[self.slices].min() < FOCUS_TIMES * halves.spp.min()


def summary(job: Job, made: Reference, reached: bool) -> str:
    spp = made.provenance.get("spp", "known answer")
    text = f"{job.scene.name}: {spp} spp, own relMSE {made.error:.1e}"
    if reached:
        return text
    own = job.project, job.scene, job.resolution, job.depth
    short = f"as many as fit into {job.seconds:.3g} s, of {job.samples} to judge {job.spp} spp"
    return f"{text}, {short}; to go on: {make_command(*own, '--spp', str(job.spp))}"


def run(options: Namespace) -> int:
    """Make the references that the command-line ``options`` name.

    Returns 1 if one failed or has too few samples.
    """
    if options.all == bool(options.scenes):
        raise CommandError("reference: name a scene, or give --all, not both")
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
        print(summary(job, made, reached), flush=True)
    return int(status)
