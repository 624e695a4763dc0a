"""Reference images with an error estimate of their own.

    python scripts/reference.py cornell_box uplight_room --error 3e-5
    python scripts/reference.py --all --seconds 300

Each reference is the mean of two halves with seeds of their own, rendered in turn until the mean carries less
than ``--error`` (relMSE; the halves differ by twice the standard error of their mean) or the time is over.
A scene is rendered by `path` where that converges, so that `bdpt` is judged by another integrator, else by
`bdpt` with everything switched on. Files lie in references/: EXR in half precision with the image (R, G, B),
half the difference of the halves (difference.R …), and the provenance as JSON in the header. Sums in double
precision are kept in renders/, so that a further run improves a reference instead of starting anew.
"""

from __future__ import annotations

import argparse
import datetime
import hashlib
import json
import os
import platform
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path

import mitsuba_bdpt  # noqa: F401  (chooses LLVM before Dr.Jit is imported)
import numpy as np
import OpenEXR
from metrics import rel_mse

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

FIRST_SEED = 1_000_000  # far from the seeds of measurements
PASS_SPP = 256


@dataclass(frozen=True)
class Reference:
    """``image`` (height, width, 3); ``error`` its own relMSE; ``provenance`` what made it."""

    image: np.ndarray
    error: float
    provenance: dict


def scene_file(name: str) -> Path:
    """The XML file of a scene of scenes/; raises ``ValueError`` if there is none."""
    path = ROOT / "scenes" / f"{name}.xml"
    if not path.is_file():
        known = ", ".join(sorted(p.stem for p in path.parent.glob("*.xml")))
        raise ValueError(f"scene={name!r} is not in scenes/; there are {known}")
    return path


def load_scene(name: str, **definitions):
    """A scene of scenes/ with its ``<default>``s replaced."""
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
    return Reference(image, rel_mse(image + difference, image), provenance)


def digest(path: Path) -> str:
    """SHA-256 of a file."""
    return hashlib.sha256(path.read_bytes()).hexdigest()


class Halves:
    """Sums of two independent halves, kept in a file between runs."""

    def __init__(self, path: Path, key: str):
        self.path, self.key, self.rounds, self.sums = path, key, 0, [0.0, 0.0]
        if path.is_file():
            kept = np.load(path)
            if str(kept["key"]) == key:
                self.rounds, self.sums = int(kept["rounds"]), list(kept["sums"])

    def add(self, images):
        """Add an image to each half, and keep the sums."""
        self.sums = [a + b for a, b in zip(self.sums, images, strict=True)]
        self.rounds += 1
        self.path.parent.mkdir(parents=True, exist_ok=True)
        with tempfile.NamedTemporaryFile(dir=self.path.parent, suffix=".npz", delete=False) as file:
            np.savez(file, key=self.key, rounds=self.rounds, sums=np.array(self.sums))
        os.replace(file.name, self.path)

    def mean(self):
        """Image, and half the difference of the halves: one sample of the image's own error."""
        a, b = (s / self.rounds for s in self.sums)
        return (a + b) / 2, (a - b) / 2

    def error(self) -> float:
        """The image's own relMSE; infinite before the first round."""
        if self.rounds == 0:
            return np.inf
        image, difference = self.mean()
        return rel_mse(image + difference, image)


def make(name: str, resolution: int, max_depth: int | None, error: float, seconds: float) -> Reference:
    """Render until the reference is good enough or the time is over, and store it."""
    definitions = {"resolution": resolution} | ({"max_depth": max_depth} if max_depth else {})
    scene = load_scene(name, **definitions)
    depth = scene.integrator().max_depth
    parameters = dict(BY_BDPT if name in NOT_BY_PATH else BY_PATH, max_depth=depth)
    integrator = mi.load_dict(parameters)
    key = json.dumps([digest(scene_file(name)), resolution, parameters, PASS_SPP])
    halves = Halves(SUMS / f"reference_{name}_{resolution}_{depth}.npz", key)
    started = time.perf_counter()
    while halves.error() > error and time.perf_counter() - started < seconds:
        seeds = (FIRST_SEED + 2 * halves.rounds, FIRST_SEED + 2 * halves.rounds + 1)
        images = [mi.render(scene, integrator=integrator, spp=PASS_SPP, seed=s) for s in seeds]
        halves.add([np.array(image, dtype=np.float64)[..., :3] for image in images])
    if halves.rounds == 0:
        raise ValueError(f"seconds={seconds} leaves no time for a single round; give more")
    provenance = {
        "scene": name,
        "scene_sha256": digest(scene_file(name)),
        "resolution": resolution,
        "max_depth": depth,
        "integrator": parameters,
        "spp": 2 * halves.rounds * PASS_SPP,
        "first_seed": FIRST_SEED,
        "rel_mse": halves.error(),
        "date": datetime.date.today().isoformat(),
        "machine": platform.machine(),
        "versions": render.versions(),
    }
    write(reference_path(name, resolution, depth), *halves.mean(), provenance)
    return Reference(halves.mean()[0], halves.error(), provenance)


def write(path: Path, image, difference, provenance: dict):
    """Write a reference; whoever looks at ``path`` never sees half a file."""
    layers = {"": image, "difference.": difference}
    channels = {
        f"{layer}{c}": np.ascontiguousarray(pixels[..., i]).astype(np.float16)
        for layer, pixels in layers.items()
        for i, c in enumerate("RGB")
    }
    header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
    header["provenance"] = json.dumps(provenance)
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
    parser.add_argument("--error", type=float, default=3e-5, help="relMSE to reach; default %(default)s")
    parser.add_argument("--seconds", type=float, default=600, help="per scene; default %(default)s")
    parser.add_argument("--resolution", type=int, default=128)
    parser.add_argument("--max-depth", type=int, help="default: the scene's own")
    args = parser.parse_args()
    names = sorted(p.stem for p in (ROOT / "scenes").glob("*.xml")) if args.all else args.scenes
    if not names:
        parser.error("name a scene, or give --all")
    mi.set_variant("llvm_ad_rgb")
    for name in names:
        made = make(name, args.resolution, args.max_depth, args.error, args.seconds)
        reached = (
            "" if made.error <= args.error else f", more than {args.error:.1e}: go on with the same command"
        )
        print(f"{name}: {made.provenance['spp']} spp, own relMSE {made.error:.1e}{reached}", flush=True)


if __name__ == "__main__":
    main()
