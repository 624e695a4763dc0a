"""Reference images with an error estimate of their own.

    python scripts/reference.py --all                       # every scene, good enough to judge 64 spp
    python scripts/reference.py glass_caustics --spp 256 --seconds 3000

A reference is good enough if its own error adds at most 1 % to the relMSE, raw and trimmed, of `bdpt` with
``--spp`` samples per pixel, and of `path` in the same time where that converges. It is the mean of two
halves with seeds of their own, rendered in turn until that is reached or the time is over; the halves
differ by twice the standard error of their mean. A scene is rendered by `path` where that converges, so
that `bdpt` is judged by another integrator, else by `bdpt` with everything switched on; windows of it in
which few samples find the light have more of them; furnaces are known exactly. Files lie in references/:
EXR in half precision with the image (R, G, B), half the difference of the halves (difference.R ...), and
the provenance as JSON in the header, with what a bias check needs. Sums in double precision are kept in
renders/, so that a further run improves a reference instead of starting anew; where they are gone, it goes
on from the stored image, whose rounding to half precision is far below its own error.
"""

from __future__ import annotations

import argparse
import datetime
import hashlib
import json
import math
import platform
import re
import time
import tomllib
from dataclasses import asdict, dataclass
from functools import cached_property
from pathlib import Path

import mitsuba as mi
import numpy as np
import OpenEXR

import mitsuba_bdpt  # chooses LLVM before Dr.Jit is imported

from ..cli.arguments import number, property_
from ..files import whole
from ..files.loading import in_proportion
from ..files.named import named_files
from ..files.whole import replacing
from ..host.versions import versions
from ..run.rendering import raise_interrupt
from .metrics import (
    FEWEST_RUNS,
    REFERENCE_SHARE,
    TILES,
    TRIM,
    Means,
    Sample,
    reference_rel_mse,
    rel_mse,
    tile_columns,
)

ROOT = Path(__file__).resolve().parents[3]
REFERENCES = ROOT / "references"
SUMS = ROOT / "renders"
SCENES = ROOT / "scenes"
BENCHMARK = ROOT / "presets" / "benchmark.toml"

RESOLUTION = 128  # width of the references, and of what scripts render to be judged by them

# Where `path` is black, or would take hours: light through glass, small lamps seen by reflection only.
NOT_BY_PATH = {
    "glass_caustics",
    "headlight",
    "lamp_behind_glass",
    "pool",
    "projector_through_glass",
    "ring_caustic",
    "smallvcm_cornell_lamp",
    "smallvcm_cornell_point",
    "smallvcm_cornell_sun",
    "thin_lens",
    "uplight_room",
    "veach_bidir",
}
BY_PATH = {"type": "path"}
BY_BDPT = {"type": "bdpt", "skip": "none", "light_paths": 1, "connections": "all"}

# Windows (left, top, right, bottom; shares of the image) with `FOCUS_TIMES` the samples: the glass and the
# mirror ball, where s = 0 alone finds the light that other glass has focused. Chosen by what a scene shows,
# not by the noise found, which would bias the image. (The balls had 98 % of the image's squared error. A
# window has fewer light subpaths than as many samples of the whole image, so that t = 1 gains less from it.)
FOCUS = {"glass_caustics": ((0.17, 0.57, 0.49, 0.89), (0.54, 0.59, 0.79, 0.84))}
FOCUS_TIMES = 16

SAMPLER = "multijitter"  # of `path`: half the error of `independent` at equal time; `bdpt` has its own points

# The radiance of every pixel by ``max_depth`` D > 0, and without a limit (scenes.md: sums of 2^-k).
KNOWN = {
    "furnace_emission": lambda depth: 1 - 2.0**-depth if depth > 0 else 1.0,
    "furnace_point": lambda depth: 1 - 2.0 ** (1 - depth) if depth > 0 else 1.0,
    "furnace_white": lambda depth: 1.0,
}

FIRST_SEED = 1_000_000  # far from the seeds of measurements
PASS_SPP = 256
WINDOW_PASSES = 4  # in one render of a window
TRIALS = 3  # renders of bdpt that say what it has to judge
TWICE = 2  # samples of `path` in the time of one of `bdpt`, roughly
MARGIN = 0.9  # of the share that a reference may carry
HALF_MAX = 65504.0  # largest number in half precision


@dataclass(frozen=True)
class Reference:
    """``image`` and ``difference`` (height, width, 3), half the difference of the halves; ``means`` for bias
    checks, None if too few renders made it; ``provenance`` what made it."""

    image: np.ndarray
    difference: np.ndarray
    means: Means | None
    provenance: dict

    @property
    def error(self) -> float:
        """Its own relMSE."""
        return rel_mse(self.image + self.difference, self.image)

    def share_of(self, image, trim: float) -> float:
        """What its own error adds to ``rel_mse(image, self.image, trim)``."""
        return reference_rel_mse(self.difference, image, self.image, trim)


def scene_names() -> list[str]:
    """The scenes of scenes/."""
    return sorted(path.stem for path in SCENES.glob("*.xml"))


def scene_file(name: str) -> Path:
    """The XML file of a scene of scenes/; raises ``ValueError`` if there is none."""
    if name not in scene_names():
        raise ValueError(f"scene={name!r} is not in scenes/; there are {', '.join(scene_names())}")
    return SCENES / f"{name}.xml"


def find_scene(name: str) -> Path:
    """A scene's file, given itself or by its name in scenes/; raises ``ValueError`` if there is none."""
    if Path(name).is_file():
        return Path(name)
    if name not in scene_names():
        raise ValueError(
            f"scene={name!r} is neither a file nor the name of one in scenes/; there are "
            f"{', '.join(scene_names())}"
        )
    return scene_file(name)


def load_scene(name: str, **definitions):
    """A scene of scenes/ with its ``<default>``s replaced, see `load_file`."""
    return load_file(scene_file(name), **definitions)


def load_file(path: Path, **definitions):
    """A scene with its ``<default>``s replaced; ``resolution`` keeps the image's proportions."""
    return mi.load_file(str(path), parallel=False, **in_proportion(path, definitions))


def default_depth(name: str) -> int:
    """The ``max_depth`` of a scene's file."""
    return load_scene(name, resolution=1).integrator().max_depth


def read_toml(path: Path) -> dict:
    """A TOML file; raises ``ValueError`` naming it if it is none."""
    try:
        return tomllib.loads(path.read_text())
    except ValueError as error:  # of TOML, or of text that is not UTF-8
        raise ValueError(f"{path} is not TOML: {error}") from error


def write_json(path: Path, value) -> None:
    """Write at once: a process that is killed leaves the whole file or none. Lists of numbers take a line."""
    path.parent.mkdir(parents=True, exist_ok=True)
    text = json.dumps(value, indent=1)
    text = re.sub(r'\[\n[^][{}"]*\]', lambda found: re.sub(r"\n\s*", " ", found[0]), text)
    with replacing(path) as temporary:
        temporary.write_text(text + "\n")


def integrator_of(words: str, depth: int):
    """The plugin ``TYPE KEY=VALUE …``."""
    kind, *properties = words.split()
    return mi.load_dict({"type": kind, "max_depth": depth} | dict(property_(text) for text in properties))


def depth_in(preset: dict, name: str) -> int:
    """The ``max_depth`` at which a preset, as read from TOML, renders a scene: its own, else that of all
    scenes, else that of the scene's file."""
    own = preset.get("scene", {}).get(name, {})
    return (preset | own).get("max_depth") or default_depth(name)


def benchmark_depth(name: str) -> int:
    """The ``max_depth`` at which the benchmark renders a scene."""
    return depth_in(read_toml(BENCHMARK), name)


def reference_path(name: str, resolution: int, max_depth: int) -> Path:
    """Where the reference lies."""
    return REFERENCES / f"{name}_{resolution}_{max_depth}.exr"


def load_reference(name: str, resolution: int, max_depth: int) -> Reference:
    """The stored reference; raises ``ValueError`` with the command that makes it, if there is none, and
    if it was made of another version of the scene's file."""
    path = reference_path(name, resolution, max_depth)
    remedy = f"python scripts/reference.py {name} --resolution {resolution} --max-depth {max_depth}"
    if not path.is_file():
        raise ValueError(f"no reference for scene={name!r} at {resolution} and depth {max_depth}; {remedy}")
    (image, difference), header = read_exr(path, "", "difference.")
    provenance = json.loads(header["provenance"])
    if provenance["scene_sha256"] != scene_digest(name):
        raise ValueError(
            f"the reference {path.name} was made of another {name}.xml, mesh or texture; {remedy}"
        )
    return Reference(image, difference, _means(provenance["means"]), provenance)


def _means(kept) -> Means | None:
    """`Means` of what the provenance keeps of them: those of an exact image have no end of freedom."""
    if kept is None:
        return None
    return Means(
        **{
            name: Sample(
                np.array(sample["mean"]),
                np.array(sample["error"]),
                np.inf if sample["freedom"] is None else sample["freedom"],
                np.array(sample["nonzero"]),
            )
            for name, sample in kept.items()
        }
    )


def _kept(means: Means | None):
    """The reverse of `_means`, for JSON."""
    if means is None:
        return None
    plain = {name: asdict(getattr(means, name)) for name in ("columns", "whole")}
    for sample in plain.values():
        for key in ("mean", "error", "nonzero"):
            sample[key] = [float(f"{x:.9g}") for x in sample[key]]
        sample["freedom"] = None if np.isinf(sample["freedom"]) else sample["freedom"]
    return plain


def digest(*paths: Path) -> str:
    """SHA-256 of files, one after the other."""
    return hashlib.sha256(b"".join(path.read_bytes() for path in paths)).hexdigest()


def scene_digest(name: str) -> str:
    """SHA-256 of a scene's file and of the meshes and textures that it names."""
    file = scene_file(name)
    return digest(file, *named_files(file))


def source_digest() -> str:
    """SHA-256 of the plugin's source files, shortened."""
    return digest(*sorted(Path(mitsuba_bdpt.__file__).parent.rglob("*.py")))[:12]


class Halves:
    """Sums of two independent halves and how many renders are in each pixel (``counts``), the tile means of
    each render of the whole image, and the digests of the plugin's source that made them, kept in a file
    between runs."""

    def __init__(self, path: Path, key: str):
        self.path, self.key, self.rounds, self.sums, self.columns = path, key, 0, None, []
        self.sources, self.counts, self.earlier = set(), None, None
        if path.is_file():
            kept = np.load(path)
            if str(kept["key"]) != key:
                print(f"{path}: of another scene, integrator or number of samples; begun anew")
            else:
                self.rounds, self.sums = int(kept["rounds"]), kept["sums"]
                self.columns = list(kept["columns"])
                whole = np.full((*self.sums.shape[1:3], 1), float(self.rounds))
                self.counts = kept["counts"] if "counts" in kept else whole
                self.sources = set(kept["sources"].tolist())
                self.earlier = _means(json.loads(str(kept["earlier"]))) if "earlier" in kept else None
        self.sources.add(source_digest())

    def go_on_from(self, stored: Reference, windows: list):
        """Take a stored reference for the renders before the first; ``windows`` are slices of rows and
        columns. Its seeds are not used again."""
        spp = stored.provenance["spp"]
        whole, most = spp / (2 * PASS_SPP), stored.provenance.get("spp_in_windows", spp) / (2 * PASS_SPP)
        self.counts = np.full((*stored.image.shape[:2], 1), whole)
        for window in windows:
            self.counts[window] = most
        self.sums = np.stack([stored.image + stored.difference, stored.image - stored.difference])
        self.sums *= self.counts
        self.rounds = math.ceil((1 + len(windows)) * most)  # no less than were rendered
        self.sources |= set(stored.provenance.get("sources", ()))  # older ones do not say
        self.earlier = stored.means

    def means(self) -> Means | None:
        """Of all renders of the whole image; None if there are too few."""
        if len(self.columns) < FEWEST_RUNS:
            return self.earlier
        made = Means.of(self.columns)
        return self.earlier.joined(made) if self.earlier else made

    def add(self, images, window=None, times: float = 1.0):
        """Add an image to each half, and keep the sums. ``window`` (slices of rows and columns): the images
        are of that part alone; ``times``: they have so many times the samples of a whole one. Raises
        ``ValueError`` for values that are not finite, and leaves the sums as they are."""
        if not all(np.isfinite(image).all() for image in images):
            raise ValueError(f"{self.path.name}: round {self.rounds} has values that are not finite")
        if self.sums is None:
            self.sums, self.counts = np.zeros((2, *images[0].shape)), np.zeros((*images[0].shape[:2], 1))
        self.sums[:, *(window or ())] += times * np.stack(images)
        self.counts[window or ...] += times
        if window is None:
            self.columns += [tile_columns(image) for image in images]
        self.rounds += 1
        self.path.parent.mkdir(parents=True, exist_ok=True)
        kept = {"sums": self.sums, "counts": self.counts, "columns": np.array(self.columns)}
        kept |= {"earlier": json.dumps(_kept(self.earlier))} if self.earlier else {}
        with replacing(self.path) as temporary, temporary.open("wb") as file:
            np.savez(file, key=self.key, rounds=self.rounds, sources=sorted(self.sources), **kept)

    def mean(self):
        """Image, and half the difference of the halves: one sample of the image's own error."""
        a, b = self.sums / self.counts
        return (a + b) / 2, (a - b) / 2

    def reference(self, provenance: dict) -> Reference:
        """What there is after at least one round."""
        image, difference = self.mean()
        return Reference(image, difference, self.means(), provenance)


def _pixels(image):
    return np.array(image, dtype=np.float64)[..., :3]


class Aim:
    """What a reference has to judge: renders of default `bdpt` with ``spp`` samples per pixel, and of `path`
    in the same time where that converges."""

    def __init__(self, scene, depth: int, spp: int, by_path: bool):
        rivals = [({"type": "bdpt"}, spp)] + [(BY_PATH, TWICE * spp)] * by_path
        self.images = []
        for parameters, samples in rivals:
            rival = mi.load_dict(parameters | {"max_depth": depth})
            for seed in range(TRIALS):
                self.images.append(_pixels(mi.render(scene, integrator=rival, spp=samples, seed=seed)))

    def reached(self, reference: Reference) -> bool:
        """Whether the reference carries little enough of their errors, and can serve in a bias check."""
        if reference.means is None:
            return False
        return all(
            reference.share_of(image, trim)
            <= MARGIN * REFERENCE_SHARE * rel_mse(image, reference.image, trim)
            for image in self.images
            for trim in (0.0, TRIM)
        )


@dataclass(frozen=True)
class Job:
    """A reference to be made: ``spp`` of the renders it has to judge, ``seconds`` that it may take."""

    scene: str
    resolution: int
    max_depth: int | None = None
    spp: int = 64
    seconds: float = 600.0

    @cached_property
    def scene_sha256(self) -> str:
        """`scene_digest`, taken before the scene is rendered."""
        return scene_digest(self.scene)


def make(job: Job) -> tuple[Reference, bool]:
    """Render until the reference is good enough or the time is over, and store it; also whether it is good
    enough. One that the time has cut short does not replace a better one."""
    depth = job.max_depth or benchmark_depth(job.scene)
    reference, reached = (_known if job.scene in KNOWN else _rendered)(job, depth)
    stored = None if reached else _stored(job, depth)
    if stored is not None and stored.error < reference.error:
        print(f"{job.scene}: the stored reference is better than what the time was enough for, and stays")
        return stored, False
    write(reference_path(job.scene, job.resolution, depth), reference)
    return reference, reached


def _stored(job: Job, depth: int) -> Reference | None:
    try:
        return load_reference(job.scene, job.resolution, depth)
    except ValueError:  # none, or of another scene
        return None


def _same(stored: Reference, **wanted) -> bool:
    return all(stored.provenance.get(key) == value for key, value in wanted.items())


def _provenance(job: Job, depth: int, **more) -> dict:
    return {
        "scene": job.scene,
        "scene_sha256": job.scene_sha256,
        "resolution": job.resolution,
        "max_depth": depth,
        "date": datetime.date.today().isoformat(),
        "machine": platform.machine(),
        "versions": versions(),
        **more,
    }


def _known(job: Job, depth: int):
    """The same radiance everywhere, without error, and True."""
    width, height = load_scene(job.scene, resolution=job.resolution).sensors()[0].film().size()
    image = np.full((int(height), int(width), 3), KNOWN[job.scene](depth))
    provenance = _provenance(job, depth, integrator="known answer")
    return Reference(image, 0 * image, Means.known(image), provenance), True


def _rendered(job: Job, depth: int):
    """As `_known`, by an integrator; False if the time was over first."""
    by_path = job.scene not in NOT_BY_PATH
    parameters = dict(BY_PATH if by_path else BY_BDPT, max_depth=depth)
    integrator = mi.load_dict(parameters)
    key = json.dumps([job.scene_sha256, job.resolution, parameters, PASS_SPP, SAMPLER])
    scene = load_scene(job.scene, resolution=job.resolution, sampler=SAMPLER)
    halves = Halves(SUMS / f"reference_{job.scene}_{job.resolution}_{depth}.npz", key)
    aim = Aim(scene, depth, job.spp, by_path)
    windows = [Window(job, share) for share in FOCUS.get(job.scene, ())]
    stored = _stored(job, depth) if halves.rounds == 0 else None
    if stored is not None and _same(stored, integrator=parameters, sampler=SAMPLER):
        halves.go_on_from(stored, [window.slices for window in windows])
    started = time.perf_counter()
    reached = halves.rounds > 0 and aim.reached(halves.reference({}))
    while halves.rounds == 0 or not (reached or time.perf_counter() - started > job.seconds):
        behind = [w for w in windows if w.is_behind(halves)]
        for window in behind:
            halves.add(_pair(window.scene, integrator, halves, WINDOW_PASSES), window.slices, WINDOW_PASSES)
        if not behind:
            halves.add(_pair(scene, integrator, halves))
        reached = aim.reached(halves.reference({}))
    provenance = _provenance(
        job,
        depth,
        integrator=parameters,
        sampler=SAMPLER,
        spp=round(2 * float(halves.counts.min()) * PASS_SPP),
        spp_in_windows=round(2 * float(halves.counts.max()) * PASS_SPP),
        first_seed=FIRST_SEED,
        sources=sorted(halves.sources),
        judges_spp=job.spp,
    )
    return halves.reference(provenance), reached


def _pair(scene, integrator, halves: Halves, times: int = 1):
    """Two images with seeds of their own."""
    seed = FIRST_SEED + 2 * halves.rounds
    spp = times * PASS_SPP
    return [_pixels(mi.render(scene, integrator=integrator, spp=spp, seed=seed + i)) for i in (0, 1)]


class Window:
    """A part of the image that needs more samples: the ``scene`` with that crop window, and the ``slices`` of
    rows and columns."""

    def __init__(self, job: Job, share):
        self.scene = load_scene(job.scene, resolution=job.resolution, sampler=SAMPLER)
        if not self.scene.sensors()[0].film().rfilter().is_box_filter():
            raise ValueError(f"scene={job.scene!r}: windows need rfilter 'box', or their borders differ")
        size = np.array(self.scene.sensors()[0].film().size())
        low, high = np.floor(share[:2] * size).astype(int), np.ceil(share[2:] * size).astype(int)
        self.slices = (slice(low[1], high[1]), slice(low[0], high[0]))
        parameters = mi.traverse(self.scene)
        for name, value in (("crop_size", high - low), ("crop_offset", low)):
            (key,) = (key for key in parameters.keys() if key.endswith(f"film.{name}"))
            parameters[key] = value.tolist()
        parameters.update()

    def is_behind(self, halves: Halves) -> bool:
        """Whether it has fewer than `FOCUS_TIMES` the samples of the rest."""
        if halves.counts is None:
            return False
        return halves.counts[self.slices].min() < FOCUS_TIMES * halves.counts.min()


def write(path: Path, reference: Reference):
    """Write a reference; whoever looks at ``path`` never sees half a file."""
    brightest = float(reference.image.max())
    if brightest > HALF_MAX:
        raise ValueError(
            f"{path.name}: radiance {brightest:g} does not fit into half precision; scale the lamps"
        )
    layers = {"": reference.image, "difference.": reference.difference}
    header = reference.provenance | {"rel_mse": reference.error, "means": _kept(reference.means)}
    write_exr(path, layers, {"provenance": json.dumps(header)})


def write_exr(path: Path, layers: dict, header: dict, dtype=np.float16):
    """An EXR of layers {prefix: (height, width, 3)}, written by `replacing`."""
    channels = {
        f"{layer}{c}": np.ascontiguousarray(pixels[..., i]).astype(dtype)
        for layer, pixels in layers.items()
        for i, c in enumerate("RGB")
    }
    header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage} | header
    path.parent.mkdir(parents=True, exist_ok=True)
    with replacing(path) as temporary, OpenEXR.File(header, channels) as file:
        file.write(str(temporary))


def read_exr(path: Path, *layers: str):
    """Images (height, width, 3) of an EXR's layers, by the prefixes of `write_exr`, and its header; raises
    ``ValueError`` for another file."""
    with path.open("rb") as file:  # OpenEXR does not say what hinders it
        start = file.read(4)
    if start != whole.MAGIC[".exr"]:
        raise ValueError(f"{str(path)!r} is not an EXR")
    with OpenEXR.File(str(path), separate_channels=True) as file:
        channels, header = file.channels(), dict(file.header())
        missing = [f"{layer}{c}" for layer in layers for c in "RGB" if f"{layer}{c}" not in channels]
        if missing:
            raise ValueError(f"{str(path)!r} has no channel {missing[0]}; there are {sorted(channels)}")
        images = [np.stack([channels[f"{layer}{c}"].pixels for c in "RGB"], axis=-1) for layer in layers]
    return [image.astype(np.float64) for image in images], header


def main() -> int:
    """Run the command line; the exit status is 1 if a reference failed or is not good enough."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("scenes", nargs="*", help="names in scenes/")
    parser.add_argument("--all", action="store_true", help="all scenes")
    whole, text = number(int, 1), "of the renders to judge; default %(default)s"
    parser.add_argument("--spp", type=whole, default=64, help=text)
    text = "per scene; default %(default)s"
    parser.add_argument("--seconds", type=number(float, 0), default=600, help=text)
    parser.add_argument("--resolution", type=whole, default=RESOLUTION, help="width; default %(default)s")
    parser.add_argument("--max-depth", type=int, help="default: that of the benchmark")
    args = parser.parse_args()
    if args.resolution % TILES:
        parser.error(f"--resolution {args.resolution} must be divisible by {TILES}")
    if args.max_depth == 0 or (args.max_depth or 1) < -1:
        parser.error(f"--max-depth {args.max_depth} must be at least 1, or -1 for no limit")
    names = scene_names() if args.all else args.scenes
    if not names:
        parser.error("name a scene, or give --all")
    mi.set_variant("llvm_ad_rgb")
    status = 0
    for name in names:
        job = Job(name, args.resolution, args.max_depth, args.spp, args.seconds)
        try:
            made, reached = make(job)
        except (ValueError, RuntimeError, NotImplementedError) as error:  # go on with the other scenes
            raise_interrupt(error)
            print(f"{name}: failed: {error}", flush=True)
            status = 1
            continue
        status |= not reached
        print(
            f"{name}: {made.provenance.get('spp', 'known answer')} spp, own relMSE {made.error:.1e}"
            + ("" if reached else f", not good enough for {job.spp} spp: go on with the same command"),
            flush=True,
        )
    return int(status)
