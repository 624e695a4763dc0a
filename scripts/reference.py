"""Reference images with an error estimate of their own.

    python scripts/reference.py --all                       # every scene, good enough to judge 64 spp
    python scripts/reference.py glass_caustics --spp 256 --seconds 3000

A reference is good enough if its own relMSE, raw and trimmed, is at most 1 % of that of `bdpt` with ``--spp``
samples per pixel (with a margin, for integrators that are better). It is the mean of two halves with seeds of
their own, rendered in turn until that is reached or the time is over; the halves differ by twice the standard
error of their mean. A scene is rendered by `path` where that converges, so that `bdpt` is judged by another
integrator, else by `bdpt` with everything switched on; furnaces are known exactly. Files lie in references/:
EXR in half precision with the image (R, G, B), half the difference of the halves (difference.R ...), and the
provenance as JSON in the header, with what a bias check needs. Sums in double precision are kept in renders/,
so that a further run improves a reference instead of starting anew.
"""

from __future__ import annotations

import argparse
import datetime
import hashlib
import json
import os
import platform
import re
import tempfile
import time
from dataclasses import asdict, dataclass
from pathlib import Path

import mitsuba_bdpt  # noqa: F401  (chooses LLVM before Dr.Jit is imported)
import numpy as np
import OpenEXR
from metrics import FEWEST_RUNS, REFERENCE_SHARE, TRIM, Means, Sample, rel_mse, tile_columns

import mitsuba as mi  # isort: skip
from mitsuba_bdpt import render  # isort: skip

ROOT = Path(__file__).resolve().parents[1]
REFERENCES = ROOT / "references"
SUMS = ROOT / "renders"

# Where `path` is black, or would take hours: light through glass, small lamps seen by reflection only.
NOT_BY_PATH = {
    "glass_caustics",
    "headlight",
    "lamp_behind_glass",
    "pool",
    "ring_caustic",
    "smallvcm_cornell_point",
    "smallvcm_cornell_sun",
    "uplight_room",
    "veach_bidir",
}
BY_PATH = {"type": "path"}
BY_BDPT = {"type": "bdpt", "skip": "none", "light_paths": 1, "connections": "all"}
SAMPLER = "multijitter"  # of `path`: half the error of `independent` at equal time; `bdpt` has its own points

# The radiance of every pixel by ``max_depth`` D > 0, and without a limit (scenes.md: sums of 2^-k).
KNOWN = {
    "furnace_emission": lambda depth: 1 - 2.0**-depth if depth > 0 else 1.0,
    "furnace_point": lambda depth: 1 - 2.0 ** (1 - depth) if depth > 0 else 1.0,
    "furnace_white": lambda depth: 1.0,
}

FIRST_SEED = 1_000_000  # far from the seeds of measurements
PASS_SPP = 256
TRIALS = 3  # renders of bdpt that say what it has to judge
MARGIN_BY_PATH = (
    0.6  # of the share that a reference may carry: where `path` is used, it may be the better one
)
MARGIN_BY_BDPT = 0.9
HALF_MAX = 65504.0  # largest number in half precision


@dataclass(frozen=True)
class Reference:
    """``image`` (height, width, 3); its own relMSE, ``error`` and ``error_trimmed``; ``means`` for bias
    checks, None if too few renders made it; ``provenance`` what made it."""

    image: np.ndarray
    error: float
    error_trimmed: float
    means: Means | None
    provenance: dict


def scene_file(name: str) -> Path:
    """The XML file of a scene of scenes/; raises ``ValueError`` if there is none."""
    path = ROOT / "scenes" / f"{name}.xml"
    if not path.is_file():
        known = ", ".join(sorted(p.stem for p in path.parent.glob("*.xml")))
        raise ValueError(f"scene={name!r} is not in scenes/; there are {known}")
    return path


def load_scene(name: str, **definitions):
    """A scene of scenes/ with its ``<default>``s replaced; ``resolution`` keeps the image's proportions."""
    text = scene_file(name).read_text()
    width, height = (
        re.search(rf'<default name="{key}" value="(\d+)"', text) for key in ("resolution", "resolution_y")
    )
    if height and "resolution" in definitions:
        proportion = int(height[1]) / int(width[1])
        definitions["resolution_y"] = max(round(definitions["resolution"] * proportion), 1)
    return mi.load_file(str(scene_file(name)), parallel=False, **definitions)


def default_depth(name: str) -> int:
    """The ``max_depth`` of a scene's file."""
    return load_scene(name, resolution=1).integrator().max_depth


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
    with OpenEXR.File(str(path), separate_channels=True) as file:
        channels = file.channels()
        image, difference = (
            np.stack([channels[f"{layer}{c}"].pixels for c in "RGB"], axis=-1).astype(np.float64)
            for layer in ("", "difference.")
        )
        provenance = json.loads(file.header()["provenance"])
    if provenance["scene_sha256"] != digest(scene_file(name)):
        raise ValueError(f"the reference {path.name} was made of another {name}.xml; {remedy}")
    return Reference(image, *own_errors(image, difference), _means(provenance["means"]), provenance)


def own_errors(image, difference):
    """A reference's own relMSE, raw and trimmed, from half the difference of its halves."""
    return tuple(rel_mse(image + difference, image, trim) for trim in (0.0, TRIM))


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


def digest(path: Path) -> str:
    """SHA-256 of a file."""
    return hashlib.sha256(path.read_bytes()).hexdigest()


class Halves:
    """Sums of two independent halves and the tile means of each render, kept in a file between runs."""

    def __init__(self, path: Path, key: str):
        self.path, self.key, self.rounds, self.sums, self.columns = path, key, 0, [0.0, 0.0], []
        if path.is_file():
            kept = np.load(path)
            if str(kept["key"]) == key:
                self.rounds, self.sums = int(kept["rounds"]), list(kept["sums"])
                self.columns = list(kept["columns"])

    def add(self, images):
        """Add an image to each half, and keep the sums."""
        self.sums = [a + b for a, b in zip(self.sums, images, strict=True)]
        self.columns += [tile_columns(image) for image in images]
        self.rounds += 1
        self.path.parent.mkdir(parents=True, exist_ok=True)
        with tempfile.NamedTemporaryFile(dir=self.path.parent, suffix=".npz", delete=False) as file:
            kept = {"rounds": self.rounds, "sums": np.array(self.sums), "columns": np.array(self.columns)}
            np.savez(file, key=self.key, **kept)
        os.replace(file.name, self.path)

    def mean(self):
        """Image, and half the difference of the halves: one sample of the image's own error."""
        a, b = (s / self.rounds for s in self.sums)
        return (a + b) / 2, (a - b) / 2

    def reference(self, provenance: dict) -> Reference:
        """What there is after at least one round."""
        image, difference = self.mean()
        means = Means.of(self.columns) if len(self.columns) >= FEWEST_RUNS else None
        return Reference(image, *own_errors(image, difference), means, provenance)


def _pixels(image):
    return np.array(image, dtype=np.float64)[..., :3]


class Aim:
    """What a reference has to judge: renders of default `bdpt` with ``spp`` samples per pixel."""

    def __init__(self, scene, depth: int, spp: int, margin: float):
        self.margin = margin
        ours = mi.load_dict({"type": "bdpt", "max_depth": depth})
        self.images = [_pixels(mi.render(scene, integrator=ours, spp=spp, seed=s)) for s in range(TRIALS)]

    def reached(self, reference: Reference) -> bool:
        """Whether the reference carries little enough of their errors, and can serve in a bias check."""
        if reference.means is None:
            return False
        for own, trim in ((reference.error, 0.0), (reference.error_trimmed, TRIM)):
            measured = np.median([rel_mse(image, reference.image, trim) for image in self.images])
            if own > self.margin * REFERENCE_SHARE * measured:
                return False
        return True


@dataclass(frozen=True)
class Job:
    """A reference to be made: ``spp`` of the renders it has to judge, ``seconds`` that it may take."""

    scene: str
    resolution: int
    max_depth: int | None = None
    spp: int = 64
    seconds: float = 600.0


def make(job: Job) -> tuple[Reference, bool]:
    """Render until the reference is good enough or the time is over, and store it; also whether it is."""
    depth = job.max_depth or default_depth(job.scene)
    reference, difference, reached = (_known if job.scene in KNOWN else _rendered)(job, depth)
    write(reference_path(job.scene, job.resolution, depth), reference, difference)
    return reference, reached


def _provenance(job: Job, depth: int, **more) -> dict:
    return {
        "scene": job.scene,
        "scene_sha256": digest(scene_file(job.scene)),
        "resolution": job.resolution,
        "max_depth": depth,
        "date": datetime.date.today().isoformat(),
        "machine": platform.machine(),
        "versions": render.versions(),
        **more,
    }


def _known(job: Job, depth: int):
    """The same radiance everywhere, without error: reference, half the difference of its halves, True."""
    width, height = load_scene(job.scene, resolution=job.resolution).sensors()[0].film().size()
    image = np.full((int(height), int(width), 3), KNOWN[job.scene](depth))
    provenance = _provenance(job, depth, integrator="known answer")
    return Reference(image, 0.0, 0.0, Means.known(image), provenance), 0 * image, True


def _rendered(job: Job, depth: int):
    """As `_known`, by an integrator; False if the time was over first."""
    scene = load_scene(job.scene, resolution=job.resolution, sampler=SAMPLER)
    by_path = job.scene not in NOT_BY_PATH
    parameters = dict(BY_PATH if by_path else BY_BDPT, max_depth=depth)
    integrator = mi.load_dict(parameters)
    key = json.dumps([digest(scene_file(job.scene)), job.resolution, parameters, PASS_SPP, SAMPLER])
    halves = Halves(SUMS / f"reference_{job.scene}_{job.resolution}_{depth}.npz", key)
    aim = Aim(scene, depth, job.spp, MARGIN_BY_PATH if by_path else MARGIN_BY_BDPT)
    started, seed = time.perf_counter(), FIRST_SEED + 2 * halves.rounds
    reached = halves.rounds > 0 and aim.reached(halves.reference({}))
    while halves.rounds == 0 or not (reached or time.perf_counter() - started > job.seconds):
        halves.add(
            [_pixels(mi.render(scene, integrator=integrator, spp=PASS_SPP, seed=seed + i)) for i in (0, 1)]
        )
        seed += 2
        reached = aim.reached(halves.reference({}))
    provenance = _provenance(
        job,
        depth,
        integrator=parameters,
        sampler=SAMPLER,
        spp=2 * halves.rounds * PASS_SPP,
        first_seed=FIRST_SEED,
        judges_spp=job.spp,
    )
    return halves.reference(provenance), halves.mean()[1], reached


def write(path: Path, reference: Reference, difference):
    """Write a reference; whoever looks at ``path`` never sees half a file."""
    brightest = float(reference.image.max())
    if brightest > HALF_MAX:
        raise ValueError(
            f"{path.name}: radiance {brightest:g} does not fit into half precision; scale the lamps"
        )
    layers = {"": reference.image, "difference.": difference}
    header = reference.provenance | {
        "rel_mse": reference.error,
        "rel_mse_trimmed": reference.error_trimmed,
        "means": _kept(reference.means),
    }
    write_exr(path, layers, {"provenance": json.dumps(header)})


def write_exr(path: Path, layers: dict, header: dict, dtype=np.float16):
    """An EXR of layers {prefix: (height, width, 3)}, written aside and renamed."""
    channels = {
        f"{layer}{c}": np.ascontiguousarray(pixels[..., i]).astype(dtype)
        for layer, pixels in layers.items()
        for i, c in enumerate("RGB")
    }
    header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage} | header
    path.parent.mkdir(parents=True, exist_ok=True)
    temporary = path.with_name(f".{path.name}.{os.getpid()}.exr")
    try:
        with OpenEXR.File(header, channels) as file:
            file.write(str(temporary))
        os.replace(temporary, path)
    finally:
        temporary.unlink(missing_ok=True)


def main():
    """Run the command line."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("scenes", nargs="*", help="names in scenes/")
    parser.add_argument("--all", action="store_true", help="all scenes")
    parser.add_argument("--spp", type=int, default=64, help="of the renders to judge; default %(default)s")
    parser.add_argument("--seconds", type=float, default=600, help="per scene; default %(default)s")
    parser.add_argument("--resolution", type=int, default=128, help="width; default %(default)s")
    parser.add_argument("--max-depth", type=int, help="default: the scene's own")
    args = parser.parse_args()
    names = sorted(p.stem for p in (ROOT / "scenes").glob("*.xml")) if args.all else args.scenes
    if not names:
        parser.error("name a scene, or give --all")
    mi.set_variant("llvm_ad_rgb")
    for name in names:
        job = Job(name, args.resolution, args.max_depth, args.spp, args.seconds)
        made, reached = make(job)
        print(
            f"{name}: {made.provenance.get('spp', 'known answer')} spp, own relMSE {made.error:.1e} "
            f"(trimmed {made.error_trimmed:.1e})"
            + ("" if reached else f", not good enough for {job.spp} spp: go on with the same command"),
            flush=True,
        )


if __name__ == "__main__":
    main()
