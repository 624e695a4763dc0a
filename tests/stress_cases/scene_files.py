"""Scene files that are wrong by chance, or hold numbers that are none: part of the section on bad input."""

from __future__ import annotations

import json
import re
import sys
import tempfile
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np

import mitsuba as mi  # isort: skip

from . import child
from .case import Outcome
from .counting import counted, short
from .mutations import mutate


def attempts(paths: list[Path], integrator: str, limit: float = 600) -> list[dict]:
    """What `attempt.attempt` says of each file.

    Of one where the process dies or takes longer than ``limit`` seconds: a ``stage`` ``dies`` or ``hangs``.
    The rest go on in a process anew.
    """
    found = []
    while len(found) < len(paths):
        rest = [str(path) for path in paths[len(found) :]]
        process = child.Lines([sys.executable, "-m", "stress_cases.attempt", integrator, *rest], limit)
        try:
            while (line := process.next()) is not None:
                found.append(json.loads(line))
        except TimeoutError:
            found.append({"stage": "hangs", "text": f"more than {limit} s"})
        else:
            if len(found) < len(paths):
                found.append({"stage": "dies", "text": f"status {process.process.returncode}"})
    return found


@dataclass(frozen=True)
class Made:
    """A scene file, and what is wrong with it.

    That in ``words``; and ``names`` of it, one of which an error has to name: of an element, a parameter, a
    value.
    """

    path: Path
    words: str
    names: tuple[str, ...]


# What Mitsuba says of an element before what is wrong with it.
PLACE = re.compile(r"\(line \d+, col \d+\): \w+")


def _is_named(text: str, names) -> bool:
    """Whether one of ``names`` stands in ``text`` as a word. (Of long ones the beginning will do.)"""
    parts = (re.escape(name[:40]) + ("" if len(name) > 40 else r"(?!\w)") for name in names if name)
    return any(re.search(r"(?<![\w.])" + part, text) for part in parts)


def _is_clear(result: dict, made: Made) -> bool:
    """Whether what `bdpt` did needs no excuse.

    That is a finite image, a mistake found while loading and named, or one that our own words say.
    """
    stage, text = result["stage"], result.get("text", "")
    if stage == "image":
        return not result["bad"]
    if stage == "load":
        return "Traceback" not in text and (bool(PLACE.search(text)) or _is_named(text, made.names))
    return stage == "render" and "bdpt: " in text


def _differ(ours: dict, theirs: dict) -> bool:
    """Whether means of images differ by more than ten of their standard errors and 2 %.

    There are few seeds, whose means have heavy tails. In scenes without bounds `path` has no shadows.
    """
    if not ours["bounded"]:
        return False
    a, b = np.array(ours["means"]), np.array(theirs["means"])
    error = np.sqrt((a.var(ddof=1) + b.var(ddof=1)) / len(a))
    return abs(a.mean() - b.mean()) > 10 * error + 0.02 * abs(b.mean()) + 1e-6


def _survey(made: list[Made], compared: bool) -> Outcome:
    """Render files; where something happens that needs an excuse, by `path` too.

    All images by both if ``compared``. The means of images have to agree.
    """
    counts, wrong = Counter(), []
    ours = attempts([file.path for file in made], "bdpt")
    clear = [_is_clear(result, file) for result, file in zip(ours, made, strict=True)]
    asked = [i for i, r in enumerate(ours) if not clear[i] or (compared and r["stage"] == "image")]
    theirs = dict(zip(asked, attempts([made[i].path for i in asked], "path"), strict=True))
    for index, (file, result) in enumerate(zip(made, ours, strict=True)):
        stage, other = result["stage"], theirs.get(index)
        if clear[index]:
            if stage == "image" and other and not other.get("bad", 1) and _differ(result, other):
                means = [np.mean(r["means"]) for r in (result, other)]
                wrong.append("{}: mean {:.3g}, of `path` {:.3g}".format(file.words, *means))
            elif stage == "image":
                counts[
                    "finite images" + (" with samples left out and counted" if result["counted"] else "")
                ] += 1
            else:
                counts["errors in words"] += 1
        elif other["stage"] == stage and (other["bad"] if stage == "image" else stage in ("dies", "hangs")):
            counts[f"{HAPPENS[stage]}, `path` alike ({file.words})"] += 1
        else:
            wrong.append(f"{file.words}: {HAPPENS[stage]} {short(result.get('text', ''))}")
    return counted(counts, wrong)


HAPPENS = {
    "image": "image not finite",
    "dies": "process dies",
    "hangs": "does not end",
    "render": "error while rendering",
    "load": "error while loading",
}


def mutated(scenes, count: int, compared: bool) -> Outcome:
    """Render ``count`` mutations of each scene."""
    with tempfile.TemporaryDirectory() as name:
        made = [Made(*mutate(scene, seed, Path(name))) for scene in scenes for seed in range(count)]
        return _survey(made, compared)


# -- numbers that are none --------------------------------------------------------------------

PLACES = """
<scene version="3.0.0">
    <default name="resolution" value="16"/>
    <default name="integrator" value="bdpt"/>
    <integrator type="$integrator"><integer name="max_depth" value="5"/></integrator>
    <sensor type="perspective">
        <float name="fov" value="45"/>
        <transform name="to_world">
            <lookat origin="0, 2, 5" target="0, 0.5, 0" up="0, 1, 0"/>{camera}
        </transform>
        <film type="hdrfilm">
            <integer name="width" value="$resolution"/><integer name="height" value="$resolution"/>
        </film>
    </sensor>
    <shape type="rectangle">
        <transform name="to_world"><rotate x="1" angle="-90"/><scale value="4"/>{floor}</transform>
        {material}
    </shape>
    <shape type="sphere">
        <point name="center" x="-1" y="0.6" z="0"/><float name="radius" value="0.6"/>{ball}
    </shape>
    {mesh}
    <shape type="rectangle">
        <transform name="to_world"><rotate x="1" angle="90"/><translate y="4"/>{lamp_place}</transform>
        <emitter type="area">{radiance}</emitter>
    </shape>
    {emitter}
</scene>
"""
PLAIN = {
    "material": '<bsdf type="diffuse"/>',
    "ball": '<bsdf type="dielectric"/>',
    "radiance": '<rgb name="radiance" value="5, 5, 5"/>',
    "mesh": '<shape type="cube"><transform name="to_world"><scale value="0.3"/></transform></shape>',
}
NONE = ("nan", "inf", "3e38", "1e30")
TRANSFORMS = {
    "camera moved": {"camera": '<translate x="{}"/>'},
    "camera turned": {"camera": '<rotate y="1" angle="{}"/>'},
    "floor moved": {"floor": '<translate x="{}"/>'},
    "floor scaled": {"floor": '<scale x="{}"/>'},
    "cube scaled": {
        "mesh": '<shape type="cube"><transform name="to_world"><scale value="{}"/></transform></shape>'
    },
    "lamp moved": {"lamp_place": '<translate x="{}"/>'},
    "sphere's radius": {"mesh": '<shape type="sphere"><float name="radius" value="{}"/></shape>'},
}
EMITTERS = {
    "area": {"radiance": '<rgb name="radiance" value="{0}, 1, 1"/>'},
    "constant": {"emitter": '<emitter type="constant"><rgb name="radiance" value="{}, 1, 1"/></emitter>'},
    "point": {"emitter": '<emitter type="point"><rgb name="intensity" value="{}, 1, 1"/></emitter>'},
    "point's place": {
        "emitter": '<emitter type="point"><point name="position" x="{}" y="3" z="1"/></emitter>'
    },
    "directional": {
        "emitter": '<emitter type="directional"><vector name="direction" x="{}" y="-1" z="0"/></emitter>'
    },
    "envmap's scale": {
        "emitter": '<emitter type="envmap"><string name="filename" value="fine.exr"/>'
        '<float name="scale" value="{}"/></emitter>'
    },
    "sampling weight": {
        "emitter": '<emitter type="point"><float name="sampling_weight" value="{}"/></emitter>'
    },
}
MATERIALS = {
    "reflectance": {"material": '<bsdf type="diffuse"><rgb name="reflectance" value="{}, 0.5, 0.5"/></bsdf>'},
    "index of refraction": {"ball": '<bsdf type="dielectric"><float name="int_ior" value="{}"/></bsdf>'},
    "roughness": {"ball": '<bsdf type="roughconductor"><float name="alpha" value="{}"/></bsdf>'},
    "opacity": {"ball": '<bsdf type="mask"><float name="opacity" value="{}"/><bsdf type="diffuse"/></bsdf>'},
    "blend": {
        "ball": '<bsdf type="blendbsdf"><float name="weight" value="{}"/>'
        '<bsdf type="diffuse"/><bsdf type="conductor"/></bsdf>'
    },
}
BITMAP = '<texture type="bitmap" name="{name}"><string name="filename" value="{file}"/>{raw}</texture>'


def _bitmap(name: str, raw: bool = False) -> str:
    flag = '<boolean name="raw" value="true"/>' if raw else ""
    return BITMAP.format(name=name, file="{}", raw=flag)


TEXTURES = {
    "reflectance": {"material": f'<bsdf type="diffuse">{_bitmap("reflectance")}</bsdf>'},
    "radiance": {"radiance": _bitmap("radiance")},
    "envmap": {"emitter": '<emitter type="envmap"><string name="filename" value="{}"/></emitter>'},
    "roughness": {"ball": f'<bsdf type="roughconductor">{_bitmap("alpha", True)}</bsdf>'},
    "bump map": {
        "material": f'<bsdf type="bumpmap">{_bitmap("arbitrary", True)}<bsdf type="diffuse"/></bsdf>'
    },
    "normal map": {
        "material": f'<bsdf type="normalmap">{_bitmap("normalmap", True)}<bsdf type="diffuse"/></bsdf>'
    },
}
MESH = '<shape type="ply"><string name="filename" value="{}"/></shape>'
GLOWING = (
    '<shape type="ply"><string name="filename" value="{}"/><emitter type="area">'
    '<rgb name="radiance" value="3"/></emitter></shape>'
)


def _write_scene(folder: Path, name: str, change: dict[str, str], value: str) -> Path:
    parts = dict.fromkeys(("camera", "floor", "lamp_place", "emitter"), "") | PLAIN
    parts |= {key: text.format(value) for key, text in change.items()}
    path = folder / f"{name}.xml"
    path.write_text(PLACES.format(**parts))
    return path


def write_textures(folder: Path) -> list[str]:
    """Textures with one pixel that is no number, or hardly one; and one without."""
    made = ["fine.exr"]
    data = np.full((4, 8, 3), 0.5, dtype=np.float32)
    mi.Bitmap(data).write(str(folder / "fine.exr"))
    for value in (*NONE, "-1"):
        wrong = data.copy()
        wrong[1, 2] = float(value)
        made.append(f"pixel {value}.exr")
        mi.Bitmap(wrong).write(str(folder / made[-1]))
    return made


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
    """Two triangles with a vertex, a normal or an index that is wrong."""
    fine, made = {"x": "-1", "n": "0", "index": "3"}, []
    changes = [{"x": value} for value in NONE] + [{"n": "nan"}, {"n": "inf"}, {"x": "1", "index": "1"}]
    for change in ({}, *changes, {"index": "4"}, {"index": "-1"}, {"index": "2000000000"}):
        made.append(" ".join(f"{k} {v}" for k, v in change.items()) + ".ply")
        (folder / made[-1]).write_text(PLY.format(**fine | change))
    return made


MESHES = {"mesh": {"mesh": MESH}, "emitting mesh": {"mesh": GLOWING}}
NAMED = re.compile(r'<(\w+)|(?:name|type)="(\w+)"')


def _names(change: dict[str, str], value: str) -> tuple[str, ...]:
    """Of what is wrong when ``value`` is put into the text of ``change``: it, and elements and parameters."""
    found = (name for text in change.values() for pair in NAMED.findall(text) for name in pair)
    return value, *found


def no_numbers(places: dict[str, dict], values: Callable[[Path], list[str]] = lambda folder: NONE) -> Outcome:
    """Put each value into each place, and render."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        made = [
            Made(_write_scene(folder, f"{i}_{j}", change, value), f"{place} {value}", _names(change, value))
            for j, value in enumerate(values(folder))
            for i, (place, change) in enumerate(places.items())
        ]
        return _survey(made, True)
