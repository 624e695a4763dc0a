"""Scene files that are wrong by chance, or hold numbers that are none, rendered in another process."""

import copy
import json
import os
import re
import subprocess
import sys
import xml.etree.ElementTree as ElementTree
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import mitsuba as mi
import numpy as np
import pytest
import repository
from hypothesis import strategies as st

from .chance import by_chance

ATTEMPT = [sys.executable, "-m", "stress_cases.attempt"]


class Made(NamedTuple):
    """A scene file, what is wrong with it, and names of that, one of which an error has to name."""

    path: Path
    words: str
    names: Sequence[str]


def attempts(files: list[Made], integrator: str) -> list[dict]:
    """What `attempt.attempt` finds of each file; of one where the process dies or hangs, the ``stage``
    ``dies``."""
    found, environment = [], os.environ | {"PYTHONPATH": os.pathsep.join(sys.path)}
    while len(found) < len(files):
        rest = [str(file.path) for file in files[len(found) :]]
        done = subprocess.run([*ATTEMPT, integrator, *rest], stdout=subprocess.PIPE, env=environment)
        found += [json.loads(line) for line in done.stdout.splitlines()]
        if len(found) < len(files):
            found.append({"stage": "dies", "text": f"status {done.returncode}"})
    return found


# What Mitsuba says of an element before what is wrong with it.
PLACE = re.compile(r"\(line \d+, col \d+\): \w+")


def is_named(text: str, names) -> bool:
    """Whether one of ``names`` stands in ``text`` as a word. (Of long ones the beginning will do.)"""
    parts = (re.escape(name[:40]) + ("" if len(name) > 40 else r"(?!\w)") for name in names if name)
    return any(re.search(r"(?<![\w.])" + part, text) for part in parts)


def is_clear(result: dict, made: Made) -> bool:
    """Whether there is a finite image, a mistake found while loading and named, or one that our own words
    say."""
    if result["stage"] == "image":
        return not result["bad"]
    text = result["text"]
    if result["stage"] == "load":
        named = bool(PLACE.search(text)) or is_named(text, made.names)
        return named and ("Traceback" not in text or "bdpt: " in text)
    return result["stage"] == "render" and "bdpt: " in text


def differ(ours: dict, theirs: dict) -> bool:
    """Whether means of images differ by more than ten of their standard errors and 2 %."""
    a, b = np.array(ours["means"]), np.array(theirs["means"])
    error = np.sqrt((a.var(ddof=1) + b.var(ddof=1)) / len(a))
    return ours["bounded"] and abs(a.mean() - b.mean()) > 10 * error + 0.02 * abs(b.mean()) + 1e-6


def survey(files: list[Made], compared: bool) -> None:
    """Render files, by `path` too where something needs an excuse, or all images if ``compared``."""
    ours, wrong = attempts(files, "bdpt"), []
    clear = [is_clear(result, file) for result, file in zip(ours, files, strict=True)]
    asked = [i for i, r in enumerate(ours) if not clear[i] or (compared and r["stage"] == "image")]
    theirs = dict(zip(asked, attempts([files[i] for i in asked], "path"), strict=True))
    for index, (file, result) in enumerate(zip(files, ours, strict=True)):
        stage, other = result["stage"], theirs.get(index, {"stage": "not tried"})
        if clear[index]:
            if other["stage"] == stage == "image" and not other["bad"] and differ(result, other):
                wrong.append(f"{file.words}: means {result['means']}, of `path` {other['means']}")
        elif not (other["stage"] == stage and (stage == "dies" or other.get("bad"))):
            wrong.append(f"{file.words}: {stage}: {result.get('text', 'not finite')[:200]}")
    images = sum(result["stage"] == "image" for result in ours)
    print(
        f"{images} images, {len(files) - images} errors, {len(files) - sum(clear)} as little sense in `path`"
    )
    assert wrong == []


# -- mutations ------------------------------------------------------------------------------------

VALUES = ("nan", "inf", "-inf", "1e39", "1e-39", "-1", "0", "", "x" * 100_000, "true", "1e9", "0.5, 0.5", "7")
TAGS = ("float", "integer", "string", "boolean", "rgb", "spectrum", "point", "vector", "transform", "texture")
PLUGINS = (
    "sphere",
    "rectangle",
    "diffuse",
    "dielectric",
    "point",
    "area",
    "constant",
    "bdpt",
    "hdrfilm",
    "no",
)
NUMBER = re.compile(r"-?\d+(\.\d+)?([eE][-+]?\d+)?")


def mutate(rng, root) -> tuple[str, list[str]]:
    """Change one thing below the ``root``; what is wrong now, and names of it.

    Numbers most often: other mistakes mostly end in the parser.
    """
    kind = rng.choice(["leave out", "double", "tag", "attribute", "no attribute", *["number"] * 4])
    pairs = [(parent, child) for parent in root.iter() for child in parent]
    keys = [(child, key) for _, child in pairs for key in child.attrib]
    if kind == "number":
        keys = [(child, key) for child, key in keys if NUMBER.search(child.get(key))]
    parent, child = rng.choice(pairs)
    if kind in ("attribute", "no attribute", "number"):
        child, key = rng.choice(keys)
    words = f"{kind} <{child.tag} {child.get('name') or child.get('type') or ''}>"
    names, value = [name for e in child.iter() for name in (e.tag, *e.attrib.values())], ""
    if kind == "leave out":
        parent.remove(child)
    elif kind == "double":
        parent.append(copy.deepcopy(child))
    elif kind == "tag":
        value = child.tag = rng.choice(TAGS)
    elif kind == "no attribute":
        value = key
        del child.attrib[key]
    elif kind == "attribute":
        value = rng.choice((*VALUES, *PLUGINS))
        child.set(key, value)
    else:
        value, text = rng.choice(VALUES), child.get(key)
        place = rng.choice(list(NUMBER.finditer(text)))
        child.set(key, text[: place.start()] + value + text[place.end() :])
    return f"{words} {value[:12]!r}", [*names, value]


SCENES = tuple(path.stem for path in sorted((repository.ROOT / "scenes").glob("*.xml")))
# Scenes whose light `path` finds as well.
EASY = ("cornell_box", "many_lights", "open_sky", "veach_mis", "window_room")


@pytest.mark.parametrize("scenes, count", [(EASY, 12), (SCENES, 1)], ids=["easy", "all"])
def test_mutated(scenes, count, tmp_path):
    """One change by chance of each scene of scenes/, 12 of each of five whose light `path` finds as well:
    elements left out, doubled, of another kind; NaN, infinite, huge, negative numbers; words for numbers.

    Expected: a finite image, or an error that names what is wrong: while loading the element or its line, its
    parameter or its value, while rendering in words of ours; where a process dies or does not end, or an
    image is not finite, `path` does alike. Of the five the mean of `path`: within ten standard errors of four
    seeds and 2 % (so few seeds have heavy tails; a lost lamp or a doubled light is off by far more), but in
    scenes without bounds, where `path` sees its environments through all shapes.
    """
    made = []
    for folder in (path for path in (repository.ROOT / "scenes").iterdir() if path.is_dir()):
        (tmp_path / folder.name).symlink_to(folder)

    def add(rng):
        name = scenes[len(made) // count]
        tree = ElementTree.parse(repository.scene_file(name))
        words, names = mutate(rng, tree.getroot())
        path = tmp_path / f"{name}_{len(made)}.xml"
        tree.write(path)
        made.append(Made(path, f"`{name}`: {words}", names))

    by_chance(st.randoms(use_true_random=True), add, count * len(scenes))
    survey(made, scenes == EASY)


# -- numbers that are none ------------------------------------------------------------------------

PLACES = """
<scene version="3.0.0">
    <default name="resolution" value="16"/><default name="integrator" value="bdpt"/>
    <integrator type="$integrator"><integer name="max_depth" value="5"/></integrator>
    <sensor type="perspective">
        <transform name="to_world">
            <lookat origin="0, 2, 5" target="0, 0.5, 0" up="0, 1, 0"/>
            <translate x="0"/><rotate y="1" angle="0"/>
        </transform>
        <film type="hdrfilm">
            <integer name="width" value="$resolution"/><integer name="height" value="$resolution"/>
        </film>
    </sensor>
    <shape type="rectangle">
        <transform name="to_world"><rotate x="1" angle="-90"/><scale x="4"/><translate x="0"/></transform>
        <bsdf type="diffuse">
            <texture type="bitmap" name="reflectance"><string name="filename" value="fine.exr"/></texture>
        </bsdf>
    </shape>
    <shape type="rectangle">
        <transform name="to_world"><rotate x="1" angle="90"/><translate y="4"/></transform>
        <emitter type="area">
            <texture type="bitmap" name="radiance"><string name="filename" value="fine.exr"/></texture>
        </emitter>
    </shape>
    <shape type="cube">
        <transform name="to_world"><scale value="0.3"/></transform>
        <bsdf type="diffuse"><rgb name="reflectance" value="0.5, 0.5, 0.5"/></bsdf>
        <emitter type="area"><rgb name="radiance" value="1, 1, 1"/></emitter>
    </shape>
    <shape type="sphere">
        <point name="center" x="-1" y="0.6" z="0"/><float name="radius" value="0.6"/>
        <bsdf type="dielectric"><float name="int_ior" value="1.5"/></bsdf>
    </shape>
    <shape type="disk"><bsdf type="roughconductor"><float name="alpha" value="0.1"/></bsdf></shape>
    <shape type="disk">
        <transform name="to_world"><translate z="-1"/></transform>
        <bsdf type="mask"><float name="opacity" value="0.5"/><bsdf type="diffuse"/></bsdf>
    </shape>
    <shape type="disk">
        <transform name="to_world"><translate x="1" z="-1"/></transform>
        <bsdf type="blendbsdf">
            <float name="weight" value="0.5"/><bsdf type="diffuse"/><bsdf type="conductor"/>
        </bsdf>
    </shape>
    <shape type="disk">
        <transform name="to_world"><translate x="-1" z="-1"/></transform>
        <bsdf type="bumpmap">
            <texture type="bitmap" name="arbitrary">
                <string name="filename" value="fine.exr"/><boolean name="raw" value="true"/>
            </texture>
            <bsdf type="diffuse"/>
        </bsdf>
    </shape>
    <shape type="ply"><string name="filename" value=".ply"/></shape>
    <shape type="ply">
        <string name="filename" value=".ply"/><transform name="to_world"><translate x="2.5"/></transform>
        <emitter type="area"><rgb name="radiance" value="3, 3, 3"/></emitter>
    </shape>
    <emitter type="envmap"><string name="filename" value="fine.exr"/><float name="scale" value="1"/></emitter>
    <emitter type="point">
        <point name="position" x="1" y="3" z="1"/><rgb name="intensity" value="1, 1, 1"/>
        <float name="sampling_weight" value="1"/>
    </emitter>
    <emitter type="directional"><vector name="direction" x="1" y="-1" z="0"/></emitter>
</scene>
"""
NONE = ("nan", "inf", "3e38", "1e30")


def write_textures(folder: Path) -> list[str]:
    """Write textures with one pixel that is no number, or hardly one; the first without."""
    names = {"fine.exr": 0.5} | {f"pixel {value}.exr": float(value) for value in (*NONE, "-1")}
    for name, value in names.items():
        data = np.full((4, 8, 3), 0.5, dtype=np.float32)
        data[1, 2] = value
        mi.Bitmap(data).write(str(folder / name))
    return list(names)


PLY = """ply
format ascii 1.0
element vertex 4
property float x
property float y
property float z
property float nx
property float ny
property float nz
element face 2
property list uchar int vertex_indices
end_header
{x} 1 0 0 {n} 1
1 1 0 0 0 1
1 2 0 0 0 1
-1 2 0 0 0 1
3 0 1 2
3 0 2 {index}
"""


def write_meshes(folder: Path) -> list[str]:
    """Write two triangles with a vertex, a normal or an index that is wrong; the first without."""
    changes = [{}, *({"x": value} for value in NONE), {"n": "nan"}, {"n": "inf"}, {"x": "1", "index": "1"}]
    changes += [{"index": "4"}, {"index": "-1"}, {"index": "2000000000"}]
    names = [" ".join(f"{k} {v}" for k, v in change.items()) + ".ply" for change in changes]
    for name, change in zip(names, changes, strict=True):
        (folder / name).write_text(PLY.format(**{"x": "-1", "n": "0", "index": "3"} | change))
    return names


def test_no_numbers(tmp_path):
    """NaN, infinity, 3e38 and 1e30 for each number of a scene's transforms, shapes, materials and emitters
    (radiance, place, direction, scale, `sampling_weight`), for a pixel of textures (reflectance, radiance,
    bumps, sky), which may be -1 too, and for a coordinate and a normal of a mesh's vertex; faces without area
    and of vertices that don't exist.

    Expected: as of files that are wrong by chance, all compared with `path`.
    """
    files = {".ply": write_meshes(tmp_path), ".exr": write_textures(tmp_path)}
    made = []

    def write(root, parts) -> None:
        for element in (element for part in parts for element in part.iter()):
            for key, text in element.items():
                first, *rest = text.split(", ")
                values = NONE if NUMBER.fullmatch(first) and element.tag not in ("integer", "lookat") else ()
                for value in files.get(Path(text).suffix or text, values):
                    element.set(key, ", ".join([value, *rest]))
                    path = tmp_path / f"{len(made)}.xml"
                    ElementTree.ElementTree(root).write(path)
                    names = element.tag, element.get("name", ""), value
                    made.append(Made(path, ElementTree.tostring(element, "unicode").strip(), names))
                element.set(key, text)

    # `path` does not find light of lamps without area through smooth surfaces: either these lamps or such
    # surfaces.
    root = ElementTree.fromstring(PLACES)
    delta = [emitter for emitter in root.findall("emitter") if emitter.get("type") != "envmap"]
    for emitter in delta:
        root.remove(emitter)
    write(root, root[3:])
    for shape in root.findall("shape/bsdf/..")[2:]:
        root.remove(shape)
    root.extend(delta)
    write(root, delta)
    survey(made, True)
