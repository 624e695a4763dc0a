"""Many renders in one process, edits, processes side by side, caches on disk."""

import gc
import os
import subprocess
import sys
from pathlib import Path

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from mitsuba_bdpt.planning import budget
from scene_parts import T

from scenes import DOWNWARDS, area, camera, floor, square

# Sums of the same numbers in another order, in single precision.
ROUNDING = 1e-4

# Along each side of most films here, and samples per pixel with which such a render asks a pilot.
SIZE = 8
PILOTED = budget.LEAST_SAMPLES // SIZE**2


def room(
    lamp=(0, 0.9, 0), light=1.0, wall=0.4, eye=(0, 0, 2.5), size=SIZE, moved=0.0, texture=0.5, spark=1.0
):
    """A room of two textured walls, a ball, a mesh, a lamp with area and a point light."""
    bitmap = mi.Bitmap(np.full((2, 2, 3), texture, dtype=np.float32))
    return {
        "type": "scene",
        "sensor": camera(origin=eye, target=(0, 0, 0), size=size),
        "sky": {"type": "constant", "radiance": 0.1 * light},
        "floor": floor(-1, 1, {"type": "diffuse", "reflectance": {"type": "bitmap", "bitmap": bitmap}}),
        "wall": square((0, 0, -1), bsdf={"type": "diffuse", "reflectance": wall}),
        "ball": {"type": "sphere", "radius": 0.3, "center": [0.4, -0.6, 0], "bsdf": {"type": "dielectric"}},
        "block": {"type": "cube", "to_world": T().translate([-0.5 + moved, -0.7, 0]).scale(0.2)},
        "lamp": square(lamp, DOWNWARDS, 0.2, emitter=area(5 * light)),
        "spark": {"type": "point", "position": [0.5, 0.5, 0.5], "intensity": spark},
    }


def rendered(integrator, scene, **keywords) -> np.ndarray:
    return np.array(integrator.render(scene, **keywords), dtype=np.float64)


def off(image, expected) -> float:
    """The largest difference of two images, as a share of the expected one's mean."""
    return float(np.abs(image - expected).max() / expected.mean())


# -- many renders in one process ------------------------------------------------------------------


def resident() -> int:
    """Bytes that this process has now, not the most it had."""
    gc.collect()
    return int(Path("/proc/self/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE")


def variables() -> int:
    """Variables of Dr.Jit that exist."""
    gc.collect()
    dr.sync_thread()
    return len(dr.whos(True).splitlines())


def check_growth(count: int, render, most_compiled: float = 0) -> None:
    """Call ``render`` of a number ``count`` times; it returns how many kernels were compiled.

    What leaks grows in the third and in the fourth quarter: the one in which the process grows less counts
    twice (an arena that the system gives to a thread comes once).
    """
    compiled, sizes = 0, []
    for number in range(count):
        made = render(number)
        compiled += made if number >= count // 10 else 0
        if number == count // 2 - 1:
            before = variables()
        if number + 1 in (count // 2, 3 * count // 4, count):
            sizes.append(resident())
    grown, more = 2 * int(np.diff(sizes).min()), variables() - before
    print(f"{grown / 2**20:.1f} MiB and {more} variables of Dr.Jit more, {compiled} kernels compiled")
    # A film of 8 x 8 and its sums are 10 KB, and pages come and go in hundreds of KB.
    assert grown < 2 << 20
    assert more <= 0
    assert compiled <= most_compiled


@pytest.mark.skipif(sys.platform != "linux", reason="memory is read in /proc")
def test_renders_1000():
    """1,000 renders in one process: of twenty each one of 48 x 48 that asks a pilot, others with `variance`,
    `aovs`, `points=independent`, `skip=none` or plain.

    Expected: after a tenth of them no kernel is compiled; in the second half no variable of Dr.Jit more and
    less than 2 MiB (500 times a film of 8 x 8 and its sums take 5 MB, 25 of 48 x 48 9 MB); 50 pilots.
    """
    kinds = [
        ({}, 48, 64),
        ({"layers": "variance"}, SIZE, 16),
        *[({"aovs": "albedo:albedo,nn:sh_normal"}, SIZE, 1), ({"points": "independent"}, SIZE, 1)] * 6,
        *[({"skip": "none"}, SIZE, 1), ({}, SIZE, 1)] * 3,
    ]
    scene = mi.load_dict(room())
    made = [(mi.load_dict({"type": "bdpt", "max_depth": 4} | p), size, spp) for p, size, spp in kinds]
    pilots = []

    def render(number):
        bdpt, size, spp = made[number % len(made)]
        # Anew where a pilot is asked, so that it is not remembered.
        bdpt.render(mi.load_dict(room(size=size)) if size > SIZE else scene, seed=number, spp=spp)
        dr.sync_thread()
        pilots.append(bdpt.statistics["pilots"]["rendered"])
        return bdpt.statistics["kernels"]["compiled"]

    check_growth(1000, render)
    assert pilots == [1, *[0] * 19] * 50


@pytest.mark.skipif(sys.platform != "linux", reason="memory is read in /proc")
def test_scenes_400():
    """400 plain renders, each of another scene object by another integrator object.

    Expected: as of 1,000 renders; kernels for at most 1 %: Dr.Jit numbers what it calls anew in each scene,
    and now and then compiles a kernel of `path`, too.
    """

    def render(number):
        bdpt = mi.load_dict({"type": "bdpt", "max_depth": 4})
        bdpt.render(
            mi.load_dict(room(light=1 + number % 7, wall=0.1 + 0.1 * (number % 5))), seed=number, spp=1
        )
        dr.sync_thread()
        return bdpt.statistics["kernels"]["compiled"]

    check_growth(400, render, 0.01 * 400)


# -- edited scenes --------------------------------------------------------------------------------

# What is edited by its name in `mi.traverse`, and the room that is made so.
EDITS = {
    "spark.intensity.value": {"spark": 3.0},
    "wall.bsdf.reflectance.value": {"wall": 0.8},
    "floor.bsdf.reflectance.data": {"texture": 0.9},
    "sensor.to_world": {"eye": (0.3, 0.2, 2.0)},
    "sensor.film.size": {"size": 11},
    "lamp.to_world": {"lamp": (0.2, 0.5, 0.3)},
    "block.vertex_positions": {"moved": 0.4},
}


@pytest.mark.parametrize("parameters, spp", [({}, PILOTED), ({"skip": "none"}, 16)], ids=["pilot", "none"])
@pytest.mark.parametrize("name", EDITS)
def test_edited_scenes(name, parameters, spp):
    """A scene edited by `mi.traverse` between two renders: light, reflectance, texture, camera, film, lamp,
    mesh; with pilots, and with `skip=none`.

    Expected: the image of a scene that was made so: the mean within 1 %, at most 5 % of values other than in
    rounding (numbers made along another way differ in the last bits, and few paths take another turn); the
    decision that is made there.
    """
    scene, made = mi.load_dict(room()), mi.load_dict(room(**EDITS[name]))
    bdpt, anew = (mi.load_dict({"type": "bdpt", "max_depth": 5} | parameters) for _ in range(2))
    before = rendered(bdpt, scene, seed=1, spp=spp)
    params, values = mi.traverse(scene), mi.traverse(made)
    (key,) = [key for key in params.keys() if key.endswith(name)]
    params[key] = values[key]
    params.update()
    image = rendered(bdpt, scene, seed=2, spp=spp)
    expected = rendered(anew, made, seed=2, spp=spp)
    ours, theirs = (
        [[decision[key] for key in ("light_paths", "connections", "coefficients")] for decision in decisions]
        for decisions in (bdpt.statistics["decisions"], anew.statistics["decisions"])
    )
    assert image.shape == expected.shape
    assert ours == theirs
    assert bool(ours) == (spp >= PILOTED)
    assert image.shape != before.shape or off(before, expected) > 0.01
    outliers = (np.abs(image - expected) > ROUNDING * expected.mean()).mean()
    print(f"{outliers:.1%} of values differ by more than rounding")
    assert outliers <= 0.05
    assert abs(image.mean() / expected.mean() - 1) < 0.01


# -- kernel caches --------------------------------------------------------------------------------

RENDER = """
import mitsuba_bdpt, short_pilots
import mitsuba as mi
import numpy as np
mi.set_variant("llvm_ad_rgb")
scene = mi.load_dict(mi.cornell_box() | {"sensor": {"type": "perspective", "film": {
    "type": "hdrfilm", "width": 16, "height": 16}, "to_world": mi.ScalarTransform4f().look_at(
    [0, 0, 4], [0, 0, 0], [0, 1, 0])}})
bdpt = mi.load_dict({"type": "bdpt", "max_depth": 6})
image = np.array(bdpt.render(scene, spp=512, seed=3), dtype=np.float64)
assert bdpt.statistics["decisions"], "no pilot"
print(bdpt.statistics["kernels"]["compiled"], image.mean(), image.std())
"""


def begun(cache, **environment) -> subprocess.Popen:
    """A render in a process of its own with that folder of compiled kernels."""
    environment = {"PYTHONPATH": os.pathsep.join(sys.path), "DRJIT_CACHE_DIR": str(cache)} | environment
    environment = {name: value for name, value in (os.environ | environment).items() if value is not None}
    return subprocess.Popen(
        [sys.executable, "-c", RENDER], stdout=subprocess.PIPE, text=True, env=environment
    )


def ended(process) -> tuple[int, np.ndarray]:
    """Kernels compiled, and mean and spread of the image."""
    text, _ = process.communicate()
    assert process.returncode == 0
    compiled, *image = text.split()[-3:]
    return int(compiled), np.array(image, dtype=float)


def test_two_processes(tmp_path):
    """Two processes fill an empty folder of compiled kernels at once, that of the pilot too, a third one
    follows.

    Expected: the same image, up to the rounding of sums in another order (1e-4); the third one compiles
    nothing.
    """
    both = [begun(tmp_path) for _ in range(2)]
    images = [ended(process)[1] for process in both]
    compiled, image = ended(begun(tmp_path))
    assert compiled == 0
    np.testing.assert_allclose(images, [image, image], rtol=ROUNDING)


@pytest.mark.parametrize("how", ["below a file", "no home", "spoilt", "size=16k", "ro"])
def test_cache(how, tmp_path):
    """The folder of compiled kernels: below a file, no `HOME` to put it in, kernels cut in half as a power
    cut may leave them, a full disk (16 KB, kernels take some 100), a disk that can't be written.

    Expected: the same image, up to the rounding of sums in another order (1e-4 of the mean).
    """
    cache, more = tmp_path / "cache", {}
    cache.mkdir()
    _, expected = ended(begun(cache))
    if how == "below a file":
        (tmp_path / "file").touch()
        cache = tmp_path / "file" / "cache"
    elif how == "no home":
        more = {"HOME": None, "DRJIT_CACHE_DIR": None, "XDG_CACHE_HOME": None}
    elif how == "spoilt":
        for file in cache.rglob("*.bin"):
            file.write_bytes(file.read_bytes()[: file.stat().st_size // 2])
    elif subprocess.run(["mount", "-t", "tmpfs", "-o", how, "tmpfs", str(cache)]).returncode:
        pytest.skip("this user can't mount a disk")
    try:
        compiled, image = ended(begun(cache, **more))
    finally:
        if "=" in how or how == "ro":
            subprocess.run(["umount", "-l", str(cache)], check=True)
    print(f"{compiled} kernels compiled")
    np.testing.assert_allclose(image, expected, rtol=ROUNDING)
