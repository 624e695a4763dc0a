"""Measure cost per sample, efficiency and cold start against Mitsuba's `path`.

    python scripts/benchmark.py cost                    # Cornell box, depth 6, 256x256, 64 spp
    python scripts/benchmark.py efficiency cornell_box  # also uplight_room, glass_caustics, ...
    python scripts/benchmark.py coldstart               # empty kernel cache to the first image
    python scripts/benchmark.py points cornell_box      # point sets against independent numbers
    python scripts/benchmark.py memory                  # peak of a process, 1920x1080, depth 8

All figures are ratios; the two sides alternate in one run. Rules: warm kernels, medians over seeds;
relMSE = mean of (x - r)^2 / (r^2 + 0.01 mean(r)^2) over pixels and channels, *trimmed* without the
worst 0.1 % of values; efficiency = 1 / (seconds * relMSE). The reference is rendered by `bdpt` with
seeds of its own until it carries less than 1 % of the error measured, and kept in renders/.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import mitsuba_bdpt  # noqa: F401  (chooses LLVM before Dr.Jit is imported)
import numpy as np
from metrics import rel_mse
from reference import FIRST_SEED, PASS_SPP, SUMS, Halves, default_depth, digest, load_scene, scene_file

import mitsuba as mi  # isort: skip
import drjit as dr  # isort: skip
from mitsuba_bdpt import render  # isort: skip

CORNELL_DEPTH = 6  # where the others have a depth of their own in the file


def timed(scene, integrator, spp, seed):
    """Image and wall seconds of one render."""
    start = time.perf_counter()
    image = mi.render(scene, integrator=integrator, spp=spp, seed=seed)
    dr.eval(image)
    dr.sync_thread()
    return np.array(image)[..., :3], time.perf_counter() - start


def load(name, resolution, max_depth):
    """A scene of scenes/ and its depth."""
    depth = max_depth or (CORNELL_DEPTH if name == "cornell_box" else default_depth(name))
    return load_scene(name, resolution=resolution, max_depth=depth), depth


def integrators(depth):
    """What is compared, by name; `path` first."""
    return {
        "path": mi.load_dict({"type": "path", "max_depth": depth}),
        "bdpt skip=none": mi.load_dict({"type": "bdpt", "max_depth": depth, "skip": "none"}),
        "bdpt skip=impossible": mi.load_dict({"type": "bdpt", "max_depth": depth, "skip": "impossible"}),
    }


def cost(args):
    """Seconds per sample as a ratio to `path`'s."""
    scene, depth = load("cornell_box", args.resolution or 256, args.max_depth)
    sides = integrators(depth)
    seconds = {name: [] for name in sides}
    for seed in range(args.seeds + 1):
        for name, integrator in sides.items():
            _, t = timed(scene, integrator, args.spp, seed)
            if seed:  # the first round compiles
                seconds[name].append(t)
    ratios = {n: np.array(t) / np.array(seconds["path"]) for n, t in seconds.items()}
    print(f"cost per sample, cornell_box, depth {depth}, {args.spp} spp, {args.seeds} rounds")
    for name, r in ratios.items():
        print(f"  {name:22} {np.median(r):.2f}x  (min {r.min():.2f}, max {r.max():.2f})")
    result = {name: float(np.median(r)) for name, r in ratios.items()}
    return result | {"depth": depth, "resolution": args.resolution or 256}


def reference(scene, name, resolution, depth, error):
    """Reference image whose own relMSE is below ``error``, and that relMSE."""
    parameters = {"type": "bdpt", "max_depth": depth, "light_paths": "1/4"}
    integrator = mi.load_dict(parameters)
    key = json.dumps([digest(scene_file(name)), resolution, parameters])
    halves = Halves(SUMS / f"benchmark_{name}_{resolution}_{depth}.npz", key)
    while halves.error() >= error:
        seeds = (FIRST_SEED + 2 * halves.rounds, FIRST_SEED + 2 * halves.rounds + 1)
        halves.add([timed(scene, integrator, PASS_SPP, s)[0].astype(np.float64) for s in seeds])
    return halves.mean()[0], halves.error()


def efficiency(args):
    """Efficiency of default `bdpt` over `path` with independent and multijitter samplers."""
    resolution = args.resolution or 128
    scene, depth = load(args.scene, resolution, args.max_depth)
    sides = integrators(depth)
    ours, path = sides["bdpt skip=impossible"], sides["path"]
    trial, _ = timed(scene, ours, args.spp, 1)
    timed(scene, path, args.spp, 1)
    ratios = [timed(scene, ours, args.spp, s)[1] / timed(scene, path, args.spp, s)[1] for s in (2, 3, 4)]
    spp_path = max(round(args.spp * float(np.median(ratios))), 1)
    ref, own = reference(scene, args.scene, resolution, depth, 1.0)
    ref, own = reference(scene, args.scene, resolution, depth, 0.01 * rel_mse(trial, ref, 0.001))
    rows = {"independent": [], "multijitter": []}
    scenes = {"independent": scene}
    scenes["multijitter"] = load_scene(
        args.scene, resolution=resolution, max_depth=depth, sampler="multijitter"
    )
    for sampler in rows:
        for seed in range(args.seeds + 1):
            a, ta = timed(scene, ours, args.spp, seed)
            b, tb = timed(scenes[sampler], path, spp_path, seed)
            if seed:
                rows[sampler].append(
                    [tb * rel_mse(b, ref, trim) / (ta * rel_mse(a, ref, trim)) for trim in (0.001, 0.0)]
                )
    print(
        f"efficiency of bdpt over path, {args.scene}, {resolution}x{resolution}, depth {depth}, "
        f"{args.spp} spp against {spp_path} spp, {args.seeds} seeds; relMSE trimmed "
        f"{rel_mse(a, ref, 0.001):.5f}, reference {own:.1e}"
    )
    result = {}
    for sampler, r in rows.items():
        r = np.array(r)
        print(
            f"  path {sampler:12} trimmed {np.median(r[:, 0]):.2f}x "
            f"({r[:, 0].min():.2f}..{r[:, 0].max():.2f}), raw {np.median(r[:, 1]):.2f}x "
            f"({r[:, 1].min():.2f}..{r[:, 1].max():.2f})"
        )
        result[sampler] = {
            name: dict(zip(("min", "median", "max"), np.quantile(column, (0, 0.5, 1)).tolist(), strict=True))
            for name, column in zip(("trimmed", "raw"), r.T, strict=True)
        }
    return result | {"depth": depth, "resolution": resolution, "spp of path": spp_path}


def points(args):
    """Error of each point set against independent numbers, at equal samples."""
    resolution = args.resolution or 128
    scene, depth = load(args.scene, resolution, args.max_depth)
    jittered = load_scene(args.scene, resolution=resolution, max_depth=depth, sampler="multijitter")
    ref, _ = reference(scene, args.scene, resolution, depth, 1.0)
    errors = {}
    for name in ("independent", "sobol", "sampler"):
        integrator = mi.load_dict({"type": "bdpt", "max_depth": depth, "points": name})
        used = jittered if name == "sampler" else scene
        images = [timed(used, integrator, args.spp, seed)[0] for seed in range(args.seeds)]
        errors[name] = float(np.median([rel_mse(image, ref, 0.001) for image in images]))
    gains = {name: errors["independent"] / error for name, error in errors.items()}
    print(
        f"relMSE of bdpt, {args.scene}, {resolution}x{resolution}, depth {depth}, {args.spp} spp, trimmed: "
        + ", ".join(f"{n} {errors[n]:.5f} ({g:.2f}x)" for n, g in gains.items())
        + " (sampler: multijitter)"
    )
    return gains | {"depth": depth, "resolution": resolution}


MEMORY = """
import resource
import mitsuba_bdpt, mitsuba as mi
mi.set_variant('llvm_ad_rgb')
d = mi.cornell_box()
d['sensor']['film']['width'], d['sensor']['film']['height'] = 1920, 1080
mi.render(mi.load_dict(d), integrator=mi.load_dict({'type': 'bdpt', 'max_depth': 8}), spp=%d)
print(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20)
"""


def memory(args):
    """Peak of a process in GiB at 1920x1080, for few and for more samples."""
    result = {}
    for spp in (2, 8):
        code = [sys.executable, "-c", MEMORY % spp]
        out = subprocess.run(code, check=True, capture_output=True, text=True).stdout
        result[f"{spp} spp"] = float(out.split()[-1])
    print("peak memory at 1920x1080: " + ", ".join(f"{n} {x:.2f} GiB" for n, x in result.items()))
    return result


COLD = """
import time; start = time.perf_counter()
import mitsuba_bdpt, mitsuba as mi, drjit as dr
mi.set_variant('llvm_ad_rgb')
scene = mi.load_dict(mi.cornell_box())
integrator = mi.load_dict({'type': '%s', 'max_depth': 6})
loaded = time.perf_counter()
image = mi.render(scene, integrator=integrator, spp=16); dr.eval(image); dr.sync_thread()
print(time.perf_counter() - loaded)
"""


def coldstart(args):
    """Seconds from an empty kernel cache to the first Cornell image (imports and loading apart)."""
    seconds = {"path": [], "bdpt": []}
    for _ in range(args.seeds):
        for name, rows in seconds.items():
            with tempfile.TemporaryDirectory() as cache:
                env = os.environ | {"DRJIT_CACHE_DIR": cache, "HOME": cache}
                out = subprocess.run(
                    [sys.executable, "-c", COLD % name],
                    env=env,
                    check=True,
                    capture_output=True,
                    text=True,
                )
            rows.append(float(out.stdout.split()[-1]))
    result = {name: float(np.median(rows)) for name, rows in seconds.items()}
    print(
        "cold start to the first Cornell image: "
        + ", ".join(f"{n} {t:.2f} s" for n, t in result.items())
        + f", ratio {result['bdpt'] / result['path']:.2f}x"
    )
    return result


COMMANDS = {
    "cost": cost,
    "efficiency": efficiency,
    "coldstart": coldstart,
    "points": points,
    "memory": memory,
}


def main():
    """Run the command line."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("what", choices=COMMANDS)
    parser.add_argument("scene", nargs="?", default="cornell_box", help="name in scenes/")
    parser.add_argument("--spp", type=int, default=64)
    parser.add_argument("--seeds", type=int, default=5)
    parser.add_argument("--resolution", type=int)
    parser.add_argument("--max-depth", type=int)
    parser.add_argument("--json", type=Path, help="also add the result to this file")
    args = parser.parse_args()
    mi.set_variant("llvm_ad_rgb")
    result = COMMANDS[args.what](args)
    if args.json:
        result |= {"spp": args.spp, "seeds": args.seeds, "versions": render.versions()}
        kept = json.loads(args.json.read_text()) if args.json.exists() else {}
        key = f"{args.what} {args.scene}" if args.what in ("efficiency", "points") else args.what
        kept[key] = result
        args.json.write_text(json.dumps(kept, indent=2) + "\n")


if __name__ == "__main__":
    main()
