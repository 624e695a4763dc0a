"""Wrong parameters, broken scene files, odd films, numbers that are none, outputs that can't be written."""

from __future__ import annotations

import json
import os
import sys
import tempfile
from collections import Counter
from collections.abc import Callable
from functools import partial
from pathlib import Path

import numpy as np
import reference
from hypothesis import HealthCheck, Phase, given, settings
from hypothesis import strategies as st
from mitsuba_bdpt.plan import Settings

import mitsuba as mi  # isort: skip

from . import child, outputs
from .case import Case, Outcome
from .mutations import mutate

SECTION = "Bad input"

# -- parameters -------------------------------------------------------------------------------

ANYTHING = st.one_of(
    st.integers(-(2**63), 2**63 - 1),
    st.integers(-2, 70),
    st.floats(),
    st.booleans(),
    st.text(max_size=12),
    st.sampled_from(
        ["", "auto", "none", "all", "1/4", "1/0", "nan", "[]", "{", "x" * 100_000, "albedo:albedo"]
    ),
)
SENSIBLE = {
    "max_depth": (-1, 0, 1, 2, 5, 9),
    "rr_depth": (1, 3, 100),
    "hide_emitters": (False, True),
    "light_paths": ("auto", 0, 1, "1/2", 0.25, "1/16"),
    "stored_vertices": (1, 2, 64),
    "strategy_images": (False, True),
    "variance": (False, True),
    "until_error": (0.0, 0.1),
    "spp_per_pass": (0, 1, 3),
    "timeout": (-1.0, 0.0, 1e9),
    "heuristic": ("balance", "power", "maximum", "uniform"),
    "skip": ("auto", "impossible", "none"),
    "connections": ("auto", "all", "one", "none"),
    "points": ("sobol", "sampler", "independent"),
    "aovs": ("", "albedo:albedo", "dd:depth,nn:sh_normal"),
    "decisions": ("", "[]"),
}
NAMES = tuple(Settings.__dataclass_fields__)


# Sensible values, and among them mostly one that is not: of many the first alone would be tried.
PARAMETERS = st.builds(
    lambda sensible, wild: sensible | wild,
    st.fixed_dictionaries({}, optional={name: st.sampled_from(SENSIBLE[name]) for name in NAMES}),
    st.just({}) | st.sampled_from(NAMES).flatmap(lambda name: ANYTHING.map(lambda value: {name: value})),
)


def fuzz(strategy, function: Callable, examples: int) -> None:
    """Call ``function`` with examples that are always the same."""
    settled = settings(
        max_examples=examples,
        derandomize=True,
        database=None,
        deadline=None,
        phases=[Phase.generate],
        suppress_health_check=list(HealthCheck),
    )
    settled(given(strategy)(function))()


def _in_words(error: Exception, names) -> bool:
    """Whether an error is one of ours, about a parameter of these ``names``."""
    text = str(error)
    return "bdpt: " in text and any(name in text for name in names)


def _parameters(examples: int, renders: int) -> Outcome:
    """Fuzz the plugin's parameters; render with the first so many different ones that were accepted."""
    counts, wrong, accepted = Counter(), [], {}

    def load(parameters):
        try:
            bdpt = mi.load_dict({"type": "bdpt", **parameters})
        except (TypeError, ValueError, RuntimeError, NotImplementedError) as error:
            counts["refused in words"] += 1
            if not _in_words(error, parameters):
                wrong.append(f"{_short(parameters)}: {_short(error)}")
        else:
            counts["accepted"] += 1
            accepted.setdefault(str(bdpt), bdpt)

    fuzz(PARAMETERS, load, examples)
    scene = reference.load_scene("cornell_box", resolution=4)
    for bdpt in list(accepted.values())[:renders]:
        try:
            image = np.array(bdpt.render(scene, spp=8))
        except (ValueError, NotImplementedError) as error:
            counts["rendered: refused in words"] += 1
            if not _in_words(error, NAMES):
                wrong.append(f"{bdpt.settings}: {_short(error)}")
        else:
            counts["rendered: finite"] += 1
            # A variance of fewer than two replicates is infinite by contract.
            if not np.isfinite(image[..., :3]).all():
                wrong.append(f"{bdpt.settings}: not finite")
    return _outcome(counts, wrong)


def _short(value, length: int = 160) -> str:
    text = " ".join(str(value).split())
    return text if len(text) <= length else f"{text[:length]} …"


def _outcome(counts: Counter, wrong: list[str]) -> Outcome:
    """All is well if nothing is ``wrong``."""
    text = ", ".join(f"{n} {what}" for what, n in counts.items())
    return Outcome(not wrong, text + (f"; {len(wrong)} not so: {'; '.join(wrong[:4])}" if wrong else ""))


ARGUMENTS = st.fixed_dictionaries(
    {},
    optional={
        name: ANYTHING | st.none() | st.lists(st.integers(0, 2), max_size=2)
        for name in ("spp", "seed", "sensor")
    },
)


def _render_arguments(examples: int) -> Outcome:
    """Fuzz the arguments of `render`; however many samples are accepted, one pass is made."""
    counts, wrong = Counter(), []
    scene = reference.load_scene("cornell_box", resolution=4)
    bdpt = mi.load_dict(
        {"type": "bdpt", "max_depth": 3, "light_paths": 1, "connections": "one", "timeout": 0}
    )

    def render(arguments):
        try:
            image = np.array(bdpt.render(scene, **{"spp": 1} | arguments))
        except (TypeError, ValueError) as error:
            counts["refused in words"] += 1
            if not _in_words(error, arguments):
                wrong.append(f"{_short(arguments)}: {_short(error)}")
        else:
            counts["rendered"] += 1
            if image.shape != (4, 4, 3) or not np.isfinite(image).all():
                wrong.append(f"{_short(arguments)}: {image.shape}, not finite")

    fuzz(ARGUMENTS, render, examples)
    return _outcome(counts, wrong)


# -- scene files ------------------------------------------------------------------------------


def attempts(paths: list[Path], integrator: str, limit: float = 60) -> list[dict]:
    """What `attempt.attempt` says of each file; of one where the process dies or takes longer than ``limit``
    seconds: a ``stage`` ``dies`` or ``hangs``. The rest go on in a process anew."""
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


def _is_clear(result: dict) -> bool:
    """Whether what `bdpt` did needs no excuse: a finite image, a mistake found while loading, or one that
    our own words say."""
    if result["stage"] == "image":
        return not result["bad"]
    return result["stage"] == "load" or (result["stage"] == "render" and "bdpt: " in result["text"])


def _differ(ours: dict, theirs: dict) -> bool:
    """Whether means of images differ by more than ten of their standard errors and 2 %: few seeds, whose
    means have heavy tails."""
    a, b = np.array(ours["means"]), np.array(theirs["means"])
    error = np.sqrt((a.var(ddof=1) + b.var(ddof=1)) / len(a))
    return abs(a.mean() - b.mean()) > 10 * error + 0.02 * abs(b.mean()) + 1e-6


def _survey(made: list[tuple[Path, str]], compared: bool) -> Outcome:
    """Render files (each with what is wrong with it, in words); where something happens that needs an excuse,
    and if ``compared`` for all images, by `path` too. The means of images have to agree."""
    counts, wrong = Counter(), []
    ours = attempts([path for path, _ in made], "bdpt")
    asked = [i for i, r in enumerate(ours) if not _is_clear(r) or (compared and r["stage"] == "image")]
    theirs = dict(zip(asked, attempts([made[i][0] for i in asked], "path"), strict=True))
    for index, ((_, words), result) in enumerate(zip(made, ours, strict=True)):
        stage, other = result["stage"], theirs.get(index)
        if _is_clear(result):
            if stage == "image" and other and not other.get("bad", 1) and _differ(result, other):
                means = [np.mean(r["means"]) for r in (result, other)]
                wrong.append("{}: mean {:.3g}, of `path` {:.3g}".format(words, *means))
            elif stage == "image":
                counts[
                    "finite images" + (" with samples left out and counted" if result["counted"] else "")
                ] += 1
            else:
                counts["errors in words"] += 1
        elif other["stage"] == stage and (stage != "image" or other["bad"]):
            counts[f"{HAPPENS[stage]}, `path` alike ({words})"] += 1
        else:
            wrong.append(f"{words}: {HAPPENS[stage]} {_short(result.get('text', ''))}")
    return _outcome(counts, wrong)


HAPPENS = {
    "image": "image not finite",
    "dies": "process dies",
    "hangs": "does not end",
    "render": "error while rendering",
    "load": "error while loading",
}


def _scene_files(scenes, count: int, compared: bool) -> Outcome:
    """Render ``count`` mutations of each scene."""
    with tempfile.TemporaryDirectory() as name:
        return _survey(
            [mutate(scene, seed, Path(name)) for scene in scenes for seed in range(count)], compared
        )


# -- films ------------------------------------------------------------------------------------


def _film(width, height, **keys):
    """A room of radiance 1 (its walls give 0.5, reflect half), seen through a film of this size."""
    film = {"type": "hdrfilm", "width": width, "height": height, "rfilter": {"type": "box"}, **keys}
    return mi.load_dict(
        {
            "type": "scene",
            "sensor": {"type": "perspective", "fov": 60, "fov_axis": "larger", "film": film},
            "wall": {
                "type": "sphere",
                "flip_normals": True,
                "bsdf": {"type": "diffuse", "reflectance": {"type": "rgb", "value": 0.5}},
                "emitter": {"type": "area", "radiance": {"type": "rgb", "value": 0.5}},
            },
        }
    )


def _films(films: dict[str, tuple], parameters: dict) -> Outcome:
    """Render the room with each film, and look for its radiance in the image."""
    counts, wrong = Counter(), []
    bdpt = mi.load_dict({"type": "bdpt", **parameters})
    for words, (size, shape, keys) in films.items():
        try:
            image = np.array(bdpt.render(_film(*size, **keys), spp=16), dtype=np.float64)
        except (ValueError, RuntimeError) as error:
            counts["refused"] += 1
            if shape is not None:
                wrong.append(f"{words}: {_short(error)}")
            elif type(error) is ValueError and "bdpt: " not in str(error):
                wrong.append(f"{words}: {_short(error)}")
        else:
            counts["rendered"] += 1
            # Roulette of long paths leaves noise; one-sidedness or a lost row would be off by far more.
            off = abs(image.mean() - 1) if image.size else np.inf
            if image.shape[:2] != shape or not np.isfinite(image).all() or off > 0.2:
                wrong.append(f"{words}: {image.shape}, mean {image.mean():.3g}")
    return _outcome(counts, wrong)


def _crop(x, y, width, height):
    return {"crop_offset_x": x, "crop_offset_y": y, "crop_width": width, "crop_height": height}


SIZES = {
    f"{w} x {h}": ((w, h), shape, {})
    for w, h, shape in [
        (0, 0, None),
        (0, 8, None),
        (8, 0, None),
        (-1, 8, None),
        (1, 1, (1, 1)),
        (1, 7, (7, 1)),
        (301, 1, (1, 301)),
        (1, 4097, (4097, 1)),
        (40_000, 2, (2, 40_000)),
        (17, 13, (13, 17)),
    ]
}
CROPS = {
    f"{window} of 16 x 12": ((16, 12), shape, _crop(*window))
    for window, shape in [
        ((0, 0, 1, 1), (1, 1)),
        ((15, 11, 1, 1), (1, 1)),
        ((15, 0, 1, 12), (12, 1)),
        ((3, 5, 7, 1), (1, 7)),
        ((0, 0, 16, 12), (12, 16)),
        ((0, 0, 0, 0), None),
        ((4, 4, 0, 5), None),
        ((16, 12, 1, 1), None),
        ((8, 8, 9, 4), None),
        ((0, 0, 17, 1), None),
    ]
} | {"16 x 16 of 100000 x 100000": ((100_000, 100_000), (16, 16), _crop(50_000, 50_000, 16, 16))}

HUGE = """
import resource
width, height, memory = map(int, sys.argv[2:])
resource.setrlimit(resource.RLIMIT_AS, (memory, memory))
scene = mi.load_dict({"type": "scene", "wall": {"type": "sphere", "emitter": {"type": "area"}}, "sensor": {
    "type": "perspective", "film": {"type": "hdrfilm", "width": width, "height": height}}})
integrator = mi.load_dict({"type": sys.argv[1], "max_depth": 2})
try:
    image = integrator.render(scene, spp=1)
    dr.eval(image)
    dr.sync_thread()
    print("image", image.shape)
except Exception as error:
    print(type(error).__name__, " ".join(str(error).split()))
"""

# What a process of these may take, in bytes, so that nothing else suffers; too little for any of them.
HUGE_MEMORY = 8 << 30


def _huge() -> Outcome:
    """Films that don't fit into this machine's memory, or whose numbers can't be counted in 32 bits."""
    side = int((os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES") / 100) ** 0.5)
    happened, ok = [], True
    for width, height in ((side, side), (65_536, 65_536), (100_000, 100_000), (2**31 - 1, 3)):
        said = {"path": "not tried"}  # it would take the memory
        for kind in ("bdpt",) if width == side else ("bdpt", "path"):
            done = child.python(HUGE, kind, str(width), str(height), str(HUGE_MEMORY))
            said[kind] = done.stdout.strip() or f"ends with status {done.returncode}"
        ok &= said["bdpt"].startswith("ValueError bdpt: the film of ")
        happened.append(
            f"{width} x {height}: {_short(said['bdpt'], 90)} (`path`: {_short(said['path'], 60)})"
        )
    return Outcome(ok, "; ".join(happened))


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


def _write_textures(folder: Path) -> list[str]:
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


def _write_meshes(folder: Path) -> list[str]:
    """Two triangles with a vertex, a normal or an index that is wrong."""
    fine, made = {"x": "-1", "n": "0", "index": "3"}, []
    changes = [{"x": value} for value in NONE] + [{"n": "nan"}, {"n": "inf"}, {"x": "1", "index": "1"}]
    for change in ({}, *changes, {"index": "4"}, {"index": "-1"}, {"index": "2000000000"}):
        made.append(" ".join(f"{k} {v}" for k, v in change.items()) + ".ply")
        (folder / made[-1]).write_text(PLY.format(**fine | change))
    return made


def _non_finite(places: dict[str, dict], values: Callable[[Path], list[str]]) -> Outcome:
    """Put each value into each place, and render."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        made = [
            (_write_scene(folder, f"{i}_{j}", change, value), f"{place} {value}")
            for j, value in enumerate(values(folder))
            for i, (place, change) in enumerate(places.items())
        ]
        return _survey(made, True)


def _case(name: str, tried: str, expected: str, run: Callable[[], Outcome], quick: bool = False) -> Case:
    return Case(name, SECTION, tried, expected, run, quick)


OR_WORDS = (
    "a finite image, or an error whose words name what is wrong; where a process dies or does not end, or an "
    "image is not finite, `path` does alike"
)
AS_PATH = (
    f"{OR_WORDS}. Where `path` renders it too, its mean: within ten standard errors of four seeds and 2 % "
    "(so "
    "few seeds have heavy tails; a lost lamp or a doubled light is off by far more)"
)
VARIED = tuple(path.stem for path in sorted((reference.ROOT / "scenes").glob("*.xml")))
# Scenes whose light `path` finds as well.
EASY = ("cornell_box", "many_lights", "open_sky", "veach_mis", "window_room")

CASES = (
    _case(
        "fuzz-parameters",
        "400 dictionaries of parameters, by hypothesis, most with one value that is anything: a word, a "
        "number, "
        "NaN, an infinity, 10^5 letters; 24 that are accepted are rendered",
        "accepted, or refused in words that name a parameter; images are finite",
        partial(_parameters, 400, 24),
    ),
    _case(
        "fuzz-arguments",
        "150 times anything for `spp`, `seed` and `sensor` of `render`, by hypothesis",
        "a finite image, or words that name the argument",
        partial(_render_arguments, 150),
        True,
    ),
    _case(
        "fuzz-scene-file",
        "10 changes by chance of `cornell_box.xml`: elements left out, doubled, of another kind; NaN, "
        "infinite, "
        "huge, negative numbers; words for numbers",
        OR_WORDS,
        partial(_scene_files, ("cornell_box",), 10, False),
        True,
    ),
    _case(
        "fuzz-easy-scene-files",
        f"12 such changes of each of {', '.join(f'`{name}`' for name in EASY)}, also rendered by `path`",
        AS_PATH,
        partial(_scene_files, EASY, 12, True),
    ),
    _case(
        "fuzz-scene-files",
        "one such change of each scene of scenes/, means not compared (`path` can't see the light of some)",
        OR_WORDS,
        partial(_scene_files, VARIED, 1, False),
    ),
    _case(
        "film-sizes",
        "films of 0, 1 x 1, 1 x 4097, 40000 x 2, ... pixels in a room of radiance 1",
        "refused in words, or an image of that size and radiance: within 20 %, for roulette leaves noise "
        "in one "
        "pixel, and a row or a side that is lost costs more; path tracing alone",
        partial(_films, SIZES, {"light_paths": 0}),
        True,
    ),
    _case(
        "film-sizes-light-paths",
        "the same with light subpaths",
        "the same",
        partial(_films, SIZES, {"skip": "none"}),
    ),
    _case(
        "crop-windows",
        "crop windows of one pixel, of a row, of nothing, beyond the film; of 16 x 16 in a film of 10^10 "
        "pixels",
        "as for films of that size",
        partial(_films, CROPS, {"skip": "none"}),
    ),
    _case(
        "film-huge",
        "films larger than the memory, or of more than 2^32 numbers",
        "refused in words before anything is allocated (a process has 8 GiB of address space)",
        _huge,
    ),
    _case(
        "no-number-transforms",
        "NaN, infinities, 3e38 and 1e30 in transforms of camera, shapes and lamp",
        AS_PATH,
        partial(_non_finite, TRANSFORMS, lambda folder: NONE),
    ),
    _case(
        "no-number-emitters",
        "the same as radiance, intensity, place, direction, scale, `sampling_weight` of emitters",
        AS_PATH,
        partial(_non_finite, EMITTERS, lambda folder: NONE),
    ),
    _case(
        "no-number-materials",
        "the same as reflectance, index of refraction, roughness, opacity, weight of a blend",
        AS_PATH,
        partial(_non_finite, MATERIALS, lambda folder: NONE),
    ),
    _case(
        "no-number-textures",
        "one pixel of the same, or -1, in textures: reflectance, radiance, roughness, sky, bump and normal "
        "map",
        AS_PATH,
        partial(_non_finite, TEXTURES, _write_textures),
    ),
    _case(
        "no-number-meshes",
        "the same as coordinate or normal of a vertex, faces without area, faces of vertices that don't "
        "exist",
        AS_PATH,
        partial(_non_finite, {"mesh": {"mesh": MESH}, "emitting mesh": {"mesh": GLOWING}}, _write_meshes),
    ),
    _case(
        "missing-files",
        "`python -m mitsuba_bdpt render` without scene, mesh, texture, include; with half of one",
        "one line that says so, status 1, nothing written",
        outputs.missing_files,
    ),
    _case(
        "outputs-that-cant-be",
        "an output that is a folder, a pipe, a text, a name too long, in a folder that can't be written, ...",
        "said before anything is rendered, nothing changed on the disk",
        outputs.output_names,
        True,
    ),
    _case(
        "full-disk-image",
        "images too large for the disk, by a little and by far",
        "an error, the former image as it was, nothing left behind",
        outputs.full_disk_image,
    ),
    _case(
        "full-disk-checkpoint",
        "checkpoints too large for the disk",
        "a warning, the image written, nothing left behind",
        outputs.full_disk_checkpoint,
    ),
    _case(
        "full-disk-sweep",
        "`scripts/sweep.py` whose images don't fit on the disk; again where they do",
        "each render that could not be kept is named, no row is kept; then all of them",
        outputs.full_disk_sweep,
    ),
    _case(
        "read-only-disk",
        "a disk that is read-only when the image is to be written",
        "an error, the former image as it was",
        outputs.read_only_disk,
    ),
)
