"""`bdpt` beside other renderers at equal time: docs/reports/peers.json and its tables.

    python scripts/peers.py --peers /opt/peers/bin/python --smallvcm /opt/SmallVCM/smallvcm
    python scripts/peers.py cornell_box --methods bdpt PATHCPU --seconds 5 --peers /opt/peers/bin/python

Scenes are Mitsuba's; other renderers get their triangles, materials, lamps and camera. Each render is a
process of its own, scripts/peers_adapters.py in the renderer's own Python. docs/reports/peers.md tells how to
install them.
"""

from __future__ import annotations

import json
import re
import subprocess
import sys

import command_line
import numpy as np
import repository
from mitsuba_bdpt.files.texts import write_text
from mitsuba_bdpt.measure.metrics import TRIM, reference_rel_mse, rel_mse
from mitsuba_bdpt.measure.tables import table
from peers_adapters import ARRAYS, SIZE

import mitsuba as mi  # isort: skip

RECORD = repository.ROOT / "docs" / "reports" / "peers.json"
ADAPTERS = repository.ROOT / "scripts" / "peers_adapters.py"
IMAGES = repository.ROOT / "results" / "peers"

# Scenes, and their numbers among SmallVCM's.
SCENES = {
    "cornell_box": None,
    "glass_caustics": None,
    "smallvcm_cornell_lamp": 1,
    "smallvcm_cornell_point": 2,
    "veach_bidir": None,
    "ajar_door": None,
}
METHODS = {
    "mitsuba": {name: {"type": name} for name in ("bdpt", "path", "ptracer")},
    "cycles": {
        "path tracing": {},
        "path guiding": {"use_guiding": True},
        "shadow caustics": {"caustics": True},
    },
    "luxcore": {
        "PATHCPU": {"renderengine.type": "PATHCPU"},
        "PATHCPU, light tracing": {"renderengine.type": "PATHCPU", "path.hybridbackforward.enable": 1},
        "PATHCPU, caustic cache": {"renderengine.type": "PATHCPU", "path.photongi.caustic.enabled": 1}
        | {"path.photongi.photon.maxcount": 1_000_000, "path.photongi.caustic.updatespp": 0},
        "BIDIRCPU": {"renderengine.type": "BIDIRCPU", "path.russianroulette.depth": 100},
        "BIDIRVMCPU": {"renderengine.type": "BIDIRVMCPU"},
    },
    "smallvcm": {name: {"type": name.lower()} for name in ("VCM", "BPT", "PPM")},
}
# Surfaces of which a scene must have one.
NEEDS = {"shadow caustics": {"glass"}, "PATHCPU, caustic cache": {"glass", "mirror"}}
# A reference that is made here is two halves. How long a half takes, in times of an image.
HALVES = {"ajar_door": 10, "veach_bidir": 2}
SEEDS = 1, 2, 3  # the samples of the first take the seconds; SmallVCM has one built in
HEAD = "renderer|method|samples per pixel|error|efficiency over `bdpt`|raw error|raw efficiency|mean"
METALS = re.compile(r'<bsdf type="roughconductor"([^>]*)>.*?</bsdf>', re.DOTALL)
GREY = r'<bsdf type="diffuse"\1><rgb name="reflectance" value="0.5"/></bsdf>'


def described(name: str) -> dict:
    """A scene for the adapters: its XML; triangles with materials, lamps, camera.

    Rough metals become diffuse. Raises ``ValueError`` for emitters that are not translated.
    """
    file = repository.scene_file(name)
    text = METALS.sub(GREY, file.read_text())
    mi.file_resolver().append(str(file.parent))
    scene = mi.load_string(text, parallel=False, optimize=False)
    sensor = mi.traverse(scene.sensors()[0])
    made = {"folder": str(file.parent), "xml": text, "max_depth": repository.benchmark_depth(name)}
    made |= {"camera": matrix(sensor["to_world"]).tolist(), "fov": float(sensor["x_fov"][0])}
    made |= {"smallvcm": SCENES[name], "lamps": [], "shapes": []}
    for shape in scene.shapes():
        values = dict(mi.traverse(shape))
        glass, mirror = "bsdf.eta" in values, "bsdf.eta.value" in values
        colour = next((rgb(x) for key, x in values.items() if key.endswith("reflectance.value")), [1.0] * 3)
        material = {"kind": "glass" if glass else "mirror" if mirror else "diffuse", "colour": colour}
        material |= {"ior": values.get("bsdf.eta"), "radiance": None}
        if shape.is_emitter():
            material["radiance"] = rgb(values["emitter.radiance.value"])
            lamp = {"kind": shape.class_name(), "colour": material["radiance"]}
            made["lamps"].append(lamp | {"to_world": matrix(values["to_world"]).tolist()})
        made["shapes"].append(material | triangles(shape.class_name(), values))
    for emitter in scene.emitters():
        values, kind = dict(mi.traverse(emitter)), emitter.class_name()
        if kind == "PointLight":
            to_world = np.eye(4)
            to_world[:3, 3] = np.ravel(values["position"])
            lamp = {"kind": kind, "colour": rgb(values["intensity.value"])}
            made["lamps"].append(lamp | {"to_world": to_world.tolist()})
        elif kind != "AreaLight":
            raise ValueError(f"{name}: a {kind} is not translated")
    return made


def rgb(value) -> list[float]:
    return np.broadcast_to(np.ravel(value), 3).tolist()


def matrix(transform) -> np.ndarray:
    return np.array(transform.matrix, float).reshape(4, 4)


def triangles(kind: str, values: dict) -> dict:
    """Points, normals (n, 3) and faces (m, 3) of a mesh, rectangle, disk, cylinder or sphere."""
    if "faces" in values:
        arrays = {"points": "vertex_positions", "normals": "vertex_normals", "faces": "faces"}
        mesh = {name: np.array(values[key]).reshape(-1, 3) for name, key in arrays.items()}
        return mesh | {"smooth": len(mesh["normals"]) > 0}
    across, along = {"Rectangle": (1, 1), "Disk": (256, 1), "Cylinder": (256, 1), "Sphere": (256, 128)}[kind]
    u, v = np.meshgrid(np.arange(across + 1) / across, np.arange(along + 1) / along, indexing="ij")
    turn, zero = np.exp(2j * np.pi * u), np.zeros_like(u)
    points = {
        "Rectangle": (2 * u - 1, 2 * v - 1, zero),
        "Disk": (turn.imag * v, turn.real * v, zero),
        "Cylinder": (turn.real, turn.imag, v),
        "Sphere": (turn.real * np.sin(np.pi * v), -turn.imag * np.sin(np.pi * v), np.cos(np.pi * v)),
    }[kind]
    normals = {"Cylinder": (turn.real, turn.imag, zero), "Sphere": points}.get(kind, (zero, zero, zero + 1))
    points, normals = (np.stack(x, axis=-1).reshape(-1, 3) for x in (points, normals))
    i, j = (x.ravel() for x in np.mgrid[:across, :along])
    a, b, c, d = (x * (along + 1) + y for x, y in ((i, j), (i + 1, j), (i + 1, j + 1), (i, j + 1)))
    faces = np.concatenate([np.stack([a, b, c], axis=-1), np.stack([a, c, d], axis=-1)])
    to_world = matrix(values["to_world"])
    linear = to_world[:3, :3]
    normals = normals @ np.linalg.inv(linear)
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    if np.linalg.det(linear) < 0:
        faces = faces[:, ::-1]
    points = points @ linear.T + to_world[:3, 3]
    p = points[faces]
    areas = np.linalg.norm(np.cross(p[:, 1] - p[:, 0], p[:, 2] - p[:, 0]), axis=1)
    faces = faces[areas > 1e-9 * areas.max()]  # none without extent, at poles
    return {"points": points, "normals": normals, "faces": faces, "smooth": kind in ("Cylinder", "Sphere")}


class Renders:
    """Renders a scene by methods of renderers; keeps images and figures in results/peers."""

    def __init__(self, name: str, programs: dict[str, str], seconds: float):
        scene, self.programs, self.seconds = described(name), programs, seconds
        self.changed = scene["xml"] != repository.scene_file(name).read_text()
        self.depth, self.folder = scene["max_depth"], IMAGES / f"{name}_{seconds:g}"
        self.kinds = {shape["kind"] for shape in scene["shapes"]}
        self.folder.mkdir(parents=True, exist_ok=True)
        shapes = enumerate(scene["shapes"])
        arrays = {f"{key}{i}": shape.pop(key) for i, shape in shapes for key in ARRAYS}
        np.savez(self.folder / "scene.npz", scene=json.dumps(scene), **arrays)

    def __call__(
        self, renderer: str, method: str, seed: int = 1, times: float = 1, spp: int | None = None
    ) -> tuple[np.ndarray, dict]:
        """An image of ``spp`` samples or of ``times`` the seconds, (SIZE, SIZE, 3), and its figures."""
        kept = self.folder / re.sub(r"\W+", "_", f"{renderer} {method} {seed}")
        image, figures = kept.with_suffix(".npy"), kept.with_suffix(".json")
        if not figures.exists():
            job = {"renderer": renderer, "method": METHODS[renderer][method], "seconds": times * self.seconds}
            job |= {"seed": seed, "spp": spp, "program": self.programs[renderer]}
            python = sys.executable if renderer in ("mitsuba", "smallvcm") else self.programs[renderer]
            words = [python, ADAPTERS, self.folder / "scene.npz", json.dumps(job), image]
            said = subprocess.run(words, check=True, stdout=subprocess.PIPE, text=True).stdout
            figures.write_text(re.findall("^ANSWER (.*)$", said, re.MULTILINE)[-1])
        return np.load(image), json.loads(figures.read_text())

    def reference(self, name: str) -> tuple[np.ndarray, np.ndarray]:
        """A reference and half the difference of its halves."""
        if self.changed:
            a, b = (self("mitsuba", "bdpt", seed, HALVES[name])[0] for seed in (8, 9))
            return (a + b) / 2, (a - b) / 2
        stored = repository.load_reference(name, SIZE, self.depth)
        return stored.image, stored.difference


def measured(name: str, renders: Renders, wanted: list[str]) -> list[dict]:
    """The rows of a scene, means over seeds. The reference's own noise is taken off the errors."""
    rows = []
    reference, difference = renders.reference(name)
    jobs = [(renderer, m) for renderer in renders.programs for m in METHODS[renderer]]
    for renderer, method in sorted(jobs, key=lambda job: [*METHODS[job[0]]].index(job[1])):
        if (wanted and method not in wanted) or (renderer == "smallvcm" and SCENES[name] is None):
            continue
        if NEEDS.get(method, renders.kinds).isdisjoint(renders.kinds):
            continue
        found, spp = [], None
        for seed in SEEDS[: 1 if renderer == "smallvcm" else None]:
            image, figures = renders(renderer, method, seed, spp=spp)
            spp, figures["mean"] = figures["spp"], image.mean() / reference.mean()
            for key, trim in (("trimmed", TRIM), ("raw", 0.0)):
                own = reference_rel_mse(difference, image, reference, trim)
                figures[key] = rel_mse(image, reference, trim) - own
            found.append(figures)
        row = {"scene": name, "renderer": renderer, "method": method, "spp": spp}
        row |= {key: float(np.mean([f[key] for f in found])) for key in found[0] if key != "spp"}
        rows.append(row)
        print(json.dumps(row), flush=True)
    return rows


def tables(record: dict) -> str:
    """A table per scene, as Markdown, the most efficient first."""
    texts = []
    for name in dict.fromkeys(row["scene"] for row in record["rows"]):
        rows = [row for row in record["rows"] if row["scene"] == name]
        (ours,) = [row for row in rows if row["method"] == "bdpt"]
        cells = []
        for row in sorted(rows, key=lambda row: row["wall"] * row["trimmed"]):
            cells.append([row["renderer"], f"`{row['method']}`", f"{row['spp']}"])
            for key in ("trimmed", "raw"):
                gain = ours["wall"] * ours[key] / (row["wall"] * row[key])
                cells[-1] += [f"{row[key]:.2g}", f"{gain:.2g}"]
            cells[-1] += [f"{row['mean']:.3f}", f"{row['first']:.1f} s", f"{row['prepared']:.1f} s"]
        texts.append(f"### `{name}`\n\n" + table([*HEAD.split("|"), "first image", "preparation"], cells))
    return "\n\n".join(texts)


def main() -> int:
    parser = command_line.parser(__doc__)
    parser.add_argument("scenes", nargs="*", default=[*SCENES])
    parser.add_argument("--peers", help="Python with bpy and pyluxcore")
    parser.add_argument("--smallvcm", help="program of SmallVCM")
    parser.add_argument("--methods", nargs="+", default=[], metavar="METHOD")
    parser.add_argument("--seconds", type=float, default=3.0, help="of an image")
    options = parser.parse_args()
    mi.set_variant("llvm_ad_rgb")
    programs = {"mitsuba": sys.executable, "cycles": options.peers, "luxcore": options.peers}
    programs = {name: x for name, x in (programs | {"smallvcm": options.smallvcm}).items() if x}
    for name in options.scenes:
        rows = measured(name, Renders(name, programs, options.seconds), options.methods)
        if not options.methods:
            known = json.loads(RECORD.read_text())["rows"] if RECORD.exists() else []
            rows = [row for row in known if row["scene"] != name] + rows
            rows.sort(key=lambda row: [*SCENES].index(row["scene"]))
            write_text(RECORD, json.dumps({"seconds": options.seconds, "rows": rows}, indent=1) + "\n")
    return 0


if __name__ == "__main__":
    sys.exit(main())
