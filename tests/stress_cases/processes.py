"""Many renders in one process, renders that are interrupted, processes side by side, caches on disk."""

from __future__ import annotations

import contextlib
import gc
import os
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path

import drjit as dr
import numpy as np
import repository
from mitsuba_bdpt.planning import budget

import mitsuba as mi  # isort: skip

from . import child
from .case import Case, Outcome, of_section

_case = of_section("Processes")

# Sums of the same numbers in another order, in single precision.
ROUNDING = 1e-4

# Along each side of most films here, and samples per pixel with which such a render asks a pilot.
SIZE = 8
PILOTED = budget.LEAST_SAMPLES // SIZE**2


def _room(lamp=(0, 0.9, 0), light=1.0, wall=0.5, eye=(0, 0, 2.5), size=SIZE, moved=0.0, texture=0.5):
    """A room of two textured walls, a ball, a mesh, a lamp with area and a point light."""
    at = mi.ScalarTransform4f()
    bitmap = mi.Bitmap(np.full((2, 2, 3), texture, dtype=np.float32))
    return {
        "type": "scene",
        "sensor": {
            "type": "perspective",
            "to_world": at.look_at(list(eye), [0, 0, 0], [0, 1, 0]),
            "film": {"type": "hdrfilm", "width": size, "height": size, "rfilter": {"type": "box"}},
        },
        "sky": {"type": "constant", "radiance": {"type": "rgb", "value": 0.1 * light}},
        "floor": {
            "type": "rectangle",
            "to_world": at.translate([0, -1, 0]).rotate([1, 0, 0], -90),
            "bsdf": {"type": "diffuse", "reflectance": {"type": "bitmap", "bitmap": bitmap}},
        },
        "wall": {
            "type": "rectangle",
            "to_world": at.translate([0, 0, -1]),
            "bsdf": {"type": "diffuse", "reflectance": {"type": "rgb", "value": wall}},
        },
        "ball": {"type": "sphere", "radius": 0.3, "center": [0.4, -0.6, 0], "bsdf": {"type": "dielectric"}},
        "block": {"type": "cube", "to_world": at.translate([-0.5 + moved, -0.7, 0]).scale(0.2)},
        "lamp": {
            "type": "rectangle",
            "to_world": at.translate(list(lamp)).rotate([1, 0, 0], 90).scale(0.2),
            "emitter": {"type": "area", "radiance": {"type": "rgb", "value": 5 * light}},
        },
        "spark": {"type": "point", "position": [0.5, 0.5, 0.5], "intensity": {"type": "rgb", "value": light}},
    }


def _image(integrator, scene, **keywords) -> np.ndarray:
    return np.array(integrator.render(scene, **keywords), dtype=np.float64)


def _traced_pilots(bdpt) -> int:
    """Pilots of its last render, but for those whose results were cached."""
    return bdpt.statistics["pilots"]["rendered"]


def _decided(integrator) -> list[dict]:
    """What the pilots of its last render have decided."""
    return integrator.statistics["decisions"]


def _off(image, expected) -> float:
    """The largest difference of two images, as a share of the expected one's mean."""
    return float(np.abs(image - expected).max() / expected.mean())


# -- many renders in one process --------------------------------------------------------------


def _resident() -> int:
    """Memory of this process in bytes: what it has now, not the most it had."""
    gc.collect()
    text = Path("/proc/self/statm")
    if text.exists():
        return int(text.read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE")
    import resource

    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * (1 if sys.platform == "darwin" else 1024)


def _kept_by_dr_jit() -> int:
    """Variables that exist."""
    gc.collect()
    dr.sync_thread()
    return len(dr.whos(True).splitlines())


# Parameters, the film's size and samples per pixel of renders in a row: plain ones; and twenty in turn, of
# which the first asks a pilot. (One with the variance has eight passes.)
PLAIN = (({}, SIZE, 1),)
IN_TURN = (
    ({}, 48, 64),
    ({"layers": "variance"}, SIZE, 16),
    *(({"aovs": "albedo:albedo,nn:sh_normal"}, SIZE, 1), ({"points": "independent"}, SIZE, 1)) * 6,
    *(({"skip": "none"}, SIZE, 1), *PLAIN) * 3,
)


def _in_a_row(count: int, kinds: tuple) -> Outcome:
    """Render ``count`` times, by all ``kinds`` in turn, after a tenth of that as warm-up."""
    scenes = {size: mi.load_dict(_room(size=size)) for _, size, _ in kinds}
    made = [
        (mi.load_dict({"type": "bdpt", "max_depth": 4} | parameters), size, spp)
        for parameters, size, spp in kinds
    ]
    asked = []

    def once(number):
        bdpt, size, spp = made[number % len(made)]
        piloted = spp * size**2 >= budget.LEAST_SAMPLES
        # Anew where a pilot is asked, so that it is not remembered.
        scene = mi.load_dict(_room(size=size)) if piloted else scenes[size]
        compiled = _once(scene, bdpt, number, spp)
        asked.append(_traced_pilots(bdpt))
        return compiled

    grown, more, compiled = _growth(count, once)
    pilots = [int(spp * size**2 >= budget.LEAST_SAMPLES) for _, size, spp in kinds] * (count // len(kinds))
    text = f"{_grown(grown, more, compiled)}, {sum(asked)} pilots"
    return Outcome(grown < GROWTH and more <= 0 and compiled == 0 and asked == pilots, text)


def _scenes_in_a_row(count: int) -> Outcome:
    """Render ``count`` times, each time another scene by another integrator; and by `path`."""

    def once(kind, number):
        scene = mi.load_dict(_room(light=1 + number % 7, wall=0.1 + 0.1 * (number % 5)))
        return _once(scene, mi.load_dict({"type": kind, "max_depth": 4}), number)

    grown, more, compiled = _growth(count, partial(once, "bdpt"))
    theirs = _growth(count, partial(once, "path"))
    text = f"{_grown(grown, more, compiled)} (`path`: {_grown(*theirs)})"
    return Outcome(grown < GROWTH and more <= 0 and compiled <= 0.01 * count, text)


# A film of 8 x 8 and its sums are 10 KB, and pages come and go in hundreds of KB.
GROWTH = 2 << 20


def _once(scene, integrator, number: int, spp: int = 1) -> int:
    """Render; the number of kernels that were compiled for it."""
    with dr.scoped_set_flag(dr.JitFlag.KernelHistory, True):
        dr.kernel_history_clear()
        integrator.render(scene, seed=number, spp=spp)
        dr.sync_thread()
        history = [entry for entry in dr.kernel_history() if entry["type"] == dr.KernelType.JIT]
    if hasattr(integrator, "statistics"):
        return integrator.statistics["kernels"]["compiled"]
    return sum(not entry["cache_hit"] for entry in history)


def _growth(count: int, once: Callable[[int], int]) -> tuple[int, int, int]:
    """How much this process grows over the second half of ``count`` calls of ``once``.

    Twice the bytes that it grows by in the third or the fourth quarter, in that with fewer: what leaks does
    so in both, and an arena that the system gives to a thread comes once. Variables of Dr.Jit that there are
    more at the end than after half of the calls, and kernels compiled after a tenth of them.
    """
    compiled, sizes = 0, []
    for number in range(count):
        made = once(number)
        compiled += made if number >= count // 10 else 0
        if number == count // 2 - 1:
            variables = _kept_by_dr_jit()
        if number + 1 in (count // 2, 3 * count // 4, count):
            sizes.append(_resident())
    return 2 * int(np.diff(sizes).min()), _kept_by_dr_jit() - variables, compiled


def _grown(grown: int, more: int, compiled: int) -> str:
    return f"{grown / 2**20:.1f} MiB and {more} variables of Dr.Jit more, {compiled} kernels compiled"


# -- one after the other ----------------------------------------------------------------------


def _alternating() -> Outcome:
    """Two scenes under two variants in turn, each with one integrator object for all."""
    first, worst, same = {}, 0.0, True
    made = {}
    for variant in ("llvm_ad_rgb", "llvm_ad_spectral"):
        mi.set_variant(variant)
        # Loaded anew for each render, so that pilots are not remembered.
        loads = [lambda: mi.load_dict(_room()), lambda: repository.load_scene("glass_caustics", resolution=8)]
        made[variant] = mi.load_dict({"type": "bdpt", "max_depth": 5}), loads
    for _ in range(3):
        for variant, (bdpt, loads) in made.items():
            mi.set_variant(variant)
            for index, load in enumerate(loads):
                image = _image(bdpt, load(), seed=3, spp=PILOTED)
                expected, decisions = first.setdefault((variant, index), (image, _decided(bdpt)))
                worst = max(worst, _off(image, expected))
                same &= _traced_pilots(bdpt) == 1 and _decided(bdpt) == decisions
    mi.set_variant("llvm_ad_rgb")
    text = f"largest difference {worst:.1g} of the mean, 4 images rendered 3 times; "
    text += "decisions of pilots the same" if same else f"not the same decisions: {_decided(bdpt)}"
    return Outcome(worst < ROUNDING and same, text)


def _edit(key: str, change) -> Callable:
    """Set what `mi.traverse` calls so; ``change`` makes the value of the one that is there."""

    def edit(params):
        (name,) = [name for name in params.keys() if name.endswith(key)]
        params[name] = change(params[name])
        params.update()

    return edit


def _move(by: float, params):
    positions = mi.Point3f(dr.unravel(mi.Point3f, params["block.vertex_positions"]))
    params["block.vertex_positions"] = dr.ravel(positions + mi.Vector3f(by, 0, 0))
    params.update()


def _edits() -> dict[str, tuple[Callable, dict]]:
    """What is edited, and the room that is made so."""
    at = mi.Transform4f()
    return {
        "intensity of a point light": (_edit("spark.intensity.value", lambda v: v * 3), {}),
        "reflectance": (_edit("wall.bsdf.reflectance.value", lambda v: type(v)(0.8)), {"wall": 0.8}),
        "texture": (_edit("floor.bsdf.reflectance.data", lambda v: v * 0 + 0.9), {"texture": 0.9}),
        "camera": (
            _edit("sensor.to_world", lambda v: at.look_at([0.3, 0.2, 2.0], [0, 0, 0], [0, 1, 0])),
            {"eye": (0.3, 0.2, 2.0)},
        ),
        "size of the film": (_edit("sensor.film.size", lambda v: mi.ScalarPoint2u(11, 11)), {"size": 11}),
        "place of a lamp": (
            _edit("lamp.to_world", lambda v: at.translate([0.2, 0.5, 0.3]).rotate([1, 0, 0], 90).scale(0.2)),
            {"lamp": (0.2, 0.5, 0.3)},
        ),
        "vertices of a mesh": (partial(_move, 0.4), {"moved": 0.4}),
    }


def _edited(parameters: dict, spp: int) -> Outcome:
    """Render, edit, render: the image of a scene that was made so, and by what a pilot decides there."""
    wrong, worst = [], 0.0
    for words, (edit, room) in _edits().items():
        scene = mi.load_dict(_room())
        bdpt, anew = (mi.load_dict({"type": "bdpt", "max_depth": 5, **parameters}) for _ in range(2))
        before = _image(bdpt, scene, seed=1, spp=spp)
        edit(mi.traverse(scene))
        built = _room(**room)
        if words.startswith("intensity"):
            built["spark"]["intensity"]["value"] = 3.0
        image = _image(bdpt, scene, seed=2, spp=spp)
        expected = _image(anew, mi.load_dict(built), seed=2, spp=spp)
        ways, of_built = ([_way(made) for made in _decided(integrator)] for integrator in (bdpt, anew))
        off = _off(image, expected) if image.shape == expected.shape else np.inf
        # Numbers made along another way differ in their last bits, and few paths take another turn by it.
        changed = image.shape != before.shape or _off(before, expected) > 0.01
        outliers = (
            float((np.abs(image - expected) > ROUNDING * expected.mean()).mean()) if off < np.inf else 1
        )
        worst = max(worst, outliers)
        if ways != of_built or bool(ways) != (spp >= PILOTED):
            wrong.append(f"{words}: decided {ways}, of a scene made so {of_built}")
        if outliers > 0.05 or abs(image.mean() / expected.mean() - 1) > 0.01 or not changed:
            wrong.append(
                f"{words}: {outliers:.1%} of the values differ, the largest by {off:.2g}; {changed=}"
            )
    text = f"at most {worst:.1%} of values differ by more than rounding"
    text += ", decisions of pilots the same" if spp >= PILOTED else ""
    return Outcome(not wrong, "; ".join(wrong) or text)


def _way(decision: dict) -> list:
    """What was decided, without figures."""
    return [decision[key] for key in ("light_paths", "connections", "coefficients")]


@contextlib.contextmanager
def _sigint_after(seconds: float):
    """SIGINT to this process when it has used so many ``seconds`` of CPU time, if it is still in here.

    On the clock a render takes longer where something else runs, and the moment would be another one.
    """
    armed = [True]

    def interrupt(*_):
        if armed:
            signal.raise_signal(signal.SIGINT)

    previous = {
        signal.SIGINT: signal.signal(signal.SIGINT, signal.default_int_handler),
        signal.SIGPROF: signal.signal(signal.SIGPROF, interrupt),
    }
    try:
        signal.setitimer(signal.ITIMER_PROF, seconds)
        yield
    finally:
        armed.clear()
        signal.setitimer(signal.ITIMER_PROF, 0)
        for number, handler in previous.items():
            signal.signal(number, handler)


def _interrupted(times: int) -> Outcome:
    """SIGINT at some moment of a render, its pilot included, then the same again."""
    load = partial(repository.load_scene, "cornell_box", resolution=32)  # anew: its pilot is not remembered
    # Short passes: recording them takes as long as tracing them, and may be interrupted as well.
    bdpt = mi.load_dict({"type": "bdpt", "max_depth": 6, "spp_per_pass": 8})
    keywords = {"seed": 5, "spp": 128}
    whole = _image(bdpt, load(), **keywords)
    decisions, scene = _decided(bdpt), load()
    started = time.process_time()
    _image(bdpt, scene, **keywords)
    seconds = time.process_time() - started
    hit, kept, worst, wrong = 0, set(), 0.0, []
    for number in range(times):
        scene = load()
        try:
            with _sigint_after(seconds * (number + 0.5) / times):
                bdpt.render(scene, **keywords)
        except KeyboardInterrupt:
            hit += 1
            kept.add(sum(bdpt.statistics["passes"]))
            film = np.array(scene.sensors()[0].film().develop())
            if bdpt.statistics["passes"] and not 0.5 < film.mean() / whole.mean() < 2:
                wrong.append(f"film of {bdpt.statistics['passes']}: mean {film.mean():.3g}")
        worst = max(worst, _off(_image(bdpt, scene, **keywords), whole))
        if not decisions or _decided(bdpt) != decisions:
            wrong.append(f"decided {_decided(bdpt)} in place of {decisions}")
    text = f"{hit} of {times} met it, after {min(kept, default=0)} to {max(kept, default=0)} of "
    text += "; ".join([f"{keywords['spp']} samples", *wrong, f"then off by {worst:.1g} of the mean at most"])
    return Outcome(not wrong and hit >= times // 2 and worst < ROUNDING, text)


# -- kernel caches ----------------------------------------------------------------------------

RENDER = """
scene = mi.load_dict(mi.cornell_box() | {"sensor": {"type": "perspective", "film": {
    "type": "hdrfilm", "width": 16, "height": 16}, "to_world": mi.ScalarTransform4f().look_at(
    [0, 0, 4], [0, 0, 0], [0, 1, 0])}})
bdpt = mi.load_dict({"type": "bdpt", "max_depth": 6})
image = np.array(bdpt.render(scene, spp=512, seed=3), dtype=np.float64)
assert bdpt.statistics["decisions"], "no pilot"
print(bdpt.statistics["kernels"]["compiled"], image.mean(), image.std(), np.isfinite(image).all())
"""


def _told(done: subprocess.CompletedProcess) -> tuple[int, np.ndarray]:
    """Kernels compiled, and mean and spread of the image; raises ``ValueError`` if there is none."""
    words = done.stdout.split()
    if done.returncode or len(words) != 4 or words[3] != "True":
        raise ValueError(f"status {done.returncode}: {(done.stdout + done.stderr).strip()[-160:]}")
    return int(words[0]), np.array([float(word) for word in words[1:3]])


def _same(image, expected) -> bool:
    return bool(np.all(np.abs(image / expected - 1) < ROUNDING))


def _side_by_side() -> Outcome:
    """Two processes fill an empty kernel cache together, a third one uses it."""
    with tempfile.TemporaryDirectory() as cache:
        env = child.environment(DRJIT_CACHE_DIR=cache)
        command = [sys.executable, "-c", child.PRELUDE + RENDER]
        both = [
            subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, env=env)
            for _ in range(2)
        ]
        texts = [process.communicate(timeout=200) for process in both]
        try:
            made = [
                _told(subprocess.CompletedProcess(command, process.returncode, *text))
                for process, text in zip(both, texts, strict=True)
            ]
            compiled, image = _told(child.python(RENDER, env=env))
        except ValueError as error:
            return Outcome(False, str(error))
        same = all(_same(image, other) for _, other in made)
        return Outcome(
            same and compiled == 0,
            f"{made[0][0]} and {made[1][0]} kernels compiled, then {compiled}; images equal: {same}",
        )


def _without_cache(made: Callable) -> Outcome:
    """Render with the cache as ``made`` leaves it, and with one that works.

    ``made`` is a context manager of an environment and further keywords, which are for what stands in for a
    disk.
    """
    with tempfile.TemporaryDirectory() as folder:
        try:
            _, expected = _told(child.python(RENDER, env=child.environment(DRJIT_CACHE_DIR=folder)))
            with made() as (changes, keywords):
                if changes is None:
                    return Outcome(None, "this user can't make such a folder")
                done = child.python(RENDER, env=child.environment(**changes), **keywords)
                compiled, image = _told(done)
        except ValueError as error:
            return Outcome(False, str(error))
    warned, same = "a warning" if done.stderr.strip() else "nothing said", _same(image, expected)
    text = f"{compiled} kernels compiled, {warned}, {'the same' if same else 'another'} image"
    if same and keywords:
        return Outcome(None, f"{child.NO_DISK}; with small files only: {text}")
    return Outcome(same, text)


@contextlib.contextmanager
def _no_folder():
    """A cache that is a file, which nobody can make a folder of."""
    with tempfile.NamedTemporaryFile() as file:
        yield {"DRJIT_CACHE_DIR": str(Path(file.name) / "cache")}, {}


@contextlib.contextmanager
def _read_only():
    with child.read_only_folder() as folder:
        yield ({"DRJIT_CACHE_DIR": str(folder)} if folder else None), {}


@contextlib.contextmanager
def _full():
    """Room for no kernel, which take some 100 KB."""
    with child.small_disk(16 << 10) as (folder, keywords, _):
        yield {"DRJIT_CACHE_DIR": str(folder)}, keywords


@contextlib.contextmanager
def _no_home():
    yield {"HOME": None, "DRJIT_CACHE_DIR": None, "XDG_CACHE_HOME": None}, {}


@contextlib.contextmanager
def _spoiled():
    """The kernels of the cache cut in half, as a power cut may leave them."""
    with tempfile.TemporaryDirectory() as folder:
        child.python(RENDER, env=child.environment(DRJIT_CACHE_DIR=folder))
        for file in Path(folder).rglob("*.bin"):
            file.write_bytes(file.read_bytes()[: file.stat().st_size // 2])
        yield {"DRJIT_CACHE_DIR": folder}, {}


SAME = "the same image, up to the rounding of sums in another order (1e-4 of the mean)"
STAYS = (
    "after a tenth of them no kernel is compiled; in the second half no variable of Dr.Jit more and less "
    "than 2 MiB, of its quarters the one that takes less counted twice (a film of 8 x 8 and its sums take "
    "10 KB, 500 of them 5 MB, 25 of 48 x 48 9 MB; pages come and go in hundreds of KB, arenas of threads of "
    "4 MiB come once)"
)


def _cache_case(name: str, tried: str, made: Callable) -> Case:
    return _case(
        f"cache-{name}", f"the folder of compiled kernels: {tried}", SAME, partial(_without_cache, made)
    )


CASES = (
    _case("renders-100", "100 renders of 8 x 8 in one process", STAYS, partial(_in_a_row, 100, PLAIN), True),
    _case(
        "renders-1000",
        "1,000 renders: of twenty each one of 48 x 48 that asks a pilot, others with `variance`, `aovs`, "
        "`points=independent`, `skip=none` or plain",
        f"{STAYS}; 50 pilots",
        partial(_in_a_row, 1000, IN_TURN),
        timed=True,
    ),
    _case(
        "scenes-400",
        "400 plain ones, each of another scene object by another integrator object",
        f"{STAYS}; kernels for at most 1 %: Dr.Jit numbers what it calls anew in each scene, and now and "
        "then "
        "compiles a kernel of `path`, too",
        partial(_scenes_in_a_row, 400),
        timed=True,
    ),
    _case(
        "alternating-scenes-and-variants",
        "two scenes under `llvm_ad_rgb` and `llvm_ad_spectral` in turn, three times, each with a pilot",
        f"{SAME}, and the same decision",
        _alternating,
    ),
    _case(
        "edited-scenes",
        "a scene edited by `mi.traverse` between two renders with pilots: light, reflectance, texture, "
        "camera, film, lamp, mesh",
        "the image of a scene that was made so: the mean within 1 %, at most 5 % of values other than in "
        "rounding (numbers made along another way differ in the last bits, and few paths take another turn); "
        "the decision that is made there",
        partial(_edited, {}, PILOTED),
        True,
    ),
    _case(
        "edited-scenes-skip-none",
        "the same with `skip=none`, without pilots",
        "the same",
        partial(_edited, {"skip": "none"}, 16),
    ),
    _case(
        "interrupted",
        "SIGINT at 12 moments of a render with a pilot, by its CPU time, each time the render again",
        "`KeyboardInterrupt` at half of the moments at least (Python drops one that comes in a destructor, "
        "and a render that takes less time than the first one has ended before the last), in the film the "
        "passes that were done (mean within a factor of 2: of 8 samples per pixel); then "
        f"{SAME}, by the same decision",
        partial(_interrupted, 12),
        timed=True,
    ),
    _case(
        "two-processes",
        "two processes fill an empty folder of compiled kernels at once, that of the pilot too, a third one "
        "follows",
        f"{SAME}; the third one compiles nothing",
        _side_by_side,
    ),
    _cache_case("in-a-file", "below a file", _no_folder),
    _cache_case("read-only", "can't be written", _read_only),
    _cache_case("full-disk", "on a full disk", _full),
    _cache_case("no-home", "no `HOME` to put it in", _no_home),
    _cache_case("spoiled", "kernels cut in half", _spoiled),
)
