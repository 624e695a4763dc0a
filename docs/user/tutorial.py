# %% [markdown]
# # Tutorial
#
# This page is a notebook, [tutorial.ipynb](tutorial.ipynb). It needs no other file:
#
# * in Jupyter: put the wheel of `make package` into the notebook's folder; `pip install jupyterlab`, `jupyter lab tutorial.ipynb`.
# * in Colab: [open it there](https://colab.research.google.com/github/mitsuba-bdpt/mitsuba-bdpt/blob/main/docs/user/tutorial.ipynb),
#   upload the wheel (*Files*, on the left), and run the cells from the top, on any type of runtime. (Tried with a kernel
#   in a fresh environment, not in Colab itself.)
#
# The first cell installs the wheel; without one it installs from the repository, since the package is not on the index yet.

# %%
import importlib.util
import subprocess
import sys
from pathlib import Path

if importlib.util.find_spec("mitsuba_bdpt") is None:  # nothing to do where it is installed
    wheels = sorted(map(str, Path().glob("mitsuba_bdpt-*.whl")))
    source = wheels[-1] if wheels else "git+https://github.com/mitsuba-bdpt/mitsuba-bdpt"
    subprocess.run([sys.executable, "-m", "pip", "install", "--quiet", source, "matplotlib"], check=True)

# %%
import time

import matplotlib.pyplot as plt
import mitsuba_bdpt  # before mitsuba: it chooses the LLVM library that Dr.Jit loads
import numpy as np

import mitsuba as mi  # isort: skip

mi.set_variant("llvm_ad_rgb")
SIZE = 128  # width of the images


def show(images, columns=5):
    """Show images (height, width, 3) in linear colours side by side, by their titles."""
    rows = -(-len(images) // columns)
    width = min(len(images), columns)
    axes = plt.subplots(rows, width, figsize=(2.6 * width, 2.9 * rows), squeeze=False)[1]
    for axis, (title, image) in zip(axes.flat, images.items(), strict=True):
        axis.imshow(mi.util.convert_to_bitmap(np.array(image, dtype=np.float32)[..., :3]))
        axis.set_title(title, fontsize=9)
        axis.set_axis_off()
    plt.show()


def rel_mse(image, reference):
    """Mean of (x - r)^2 / (r^2 + 0.01 mean(r)^2)."""
    x, r = (np.array(a, dtype=np.float64)[..., :3] for a in (image, reference))
    return float(((x - r) ** 2 / (r**2 + 0.01 * r.mean() ** 2)).mean())


# %% [markdown]
# ## A first render
#
# Mitsuba's Cornell box, and the same box with a point light inside a ball of glass. `path` would have to hit the light by
# chance or to connect to it through the glass, and can do neither: black. Light subpaths leave the lamp, pass the glass,
# and are connected to the camera subpaths.

# %%
cornell_box = mi.cornell_box()
cornell_box["sensor"]["film"].update(width=SIZE, height=SIZE)
box = mi.load_dict(cornell_box)
ball_lamp = {
    "ball": {"type": "sphere", "center": [0, 0.5, 0], "radius": 0.08, "bsdf": {"type": "dielectric"}},
    "point": {"type": "point", "position": [0, 0.5, 0.02], "intensity": 1.0},
}
glass = mi.load_dict({name: part for name, part in cornell_box.items() if name != "light"} | ball_lamp)
bdpt = mi.load_dict({"type": "bdpt", "max_depth": 8})
path = mi.load_dict({"type": "path", "max_depth": 8})
images = {
    "point in glass, path": mi.render(glass, integrator=path, spp=64),
    "point in glass, bdpt": mi.render(glass, integrator=bdpt, spp=64),
}
show(images)
assert np.array(images["point in glass, path"]).max() == 0

# %% [markdown]
# ## Reading `explain`
#
# Which strategies are used, which are skipped and why, and which paths are not sampled. With `spp` it runs the pilot of
# such a render too: a table of configurations, with the time that each needs for the same error relative to the chosen
# one. "impossible" follows from the scene, "not worth its cost here" from the pilot.

# %%
print(bdpt.explain(glass, spp=4096))

# %%
print(bdpt.explain(box, spp=4096))

# %% [markdown]
# After a render `statistics` has the same in numbers.

# %%
bdpt.render(box, spp=256, seed=1, develop=False)
print({key: bdpt.statistics[key] for key in ("rays", "passes", "peak_memory")})

# %% [markdown]
# ## Choosing parameters
#
# Leave them alone first. Reasons to set one:
#
# * `max_depth`: as in `path`; paths in glass need more edges than one thinks (two for each pane).
# * `light_paths=0`: path tracing with better points; for scenes without caustics, when every render is very short.
# * `skip=none`, `light_paths=1`, `connections=all`: everything, for comparisons with other renderers.
# * `heuristic`: `balance` is the best or nearly so; `power` helps where one strategy is nearly without noise.
# * `layers=variance`: error bars, and `target_error` to stop at one.

# %%
bars = mi.load_dict({"type": "bdpt", "max_depth": 8, "target_error": 0.02})
image = bars.render(box, spp=4096, seed=3)
reference = bdpt.render(box, spp=2048, seed=9)
done, error = sum(bars.statistics["passes"]), bars.statistics["error"]
print(f"{done} spp; relMSE estimated {error:.3g}, measured {rel_mse(image, reference):.3g}")
assert error <= 0.02

# %% [markdown]
# ## Strategy images
#
# A path of k edges can be sampled by k + 2 strategies (s, t), with s vertices on a light subpath and t on a camera
# subpath. Each has its own images: *unweighted*, its estimate alone, and *weighted*, what it adds to the result. Here
# those of paths with three edges. `mitsuba-bdpt pyramid SCENE` writes an image of all lengths.

# %%
layered = mi.load_dict({"type": "bdpt", "max_depth": 3, "layers": "strategies"})
film = np.array(layered.render(box, spp=256))
names = layered.aov_names()
layers = film[..., -len(names) :]
pyramid = {}
for kind in ("unweighted", "weighted"):
    for s in range(5):
        first = names.index(f"{kind}.s{s}t{4 - s}.R")
        pyramid[f"{kind}, s = {s}, t = {4 - s}"] = layers[..., first : first + 3]
show(pyramid)

# %% [markdown]
# ## A caustic of one's own
#
# Any scene will do: a dictionary, a file. Here a small lamp over a glass ball on a floor. `path` finds the caustic by
# camera subpaths that happen to hit the lamp through the ball.

# %%
pair = {"path": path, "bdpt": bdpt}
at = mi.ScalarTransform4f()
dictionary = {
    "type": "scene",
    "sensor": {
        "type": "perspective",
        "fov": 35,
        "to_world": at.look_at(origin=[0, -6, 4], target=[0, 0, 0.5], up=[0, 0, 1]),
        "film": {"type": "hdrfilm", "width": SIZE, "height": SIZE, "rfilter": {"type": "box"}},
    },
    "floor": {
        "type": "rectangle",
        "to_world": at.scale(4),
        "bsdf": {"type": "twosided", "bsdf": {"type": "diffuse", "reflectance": 0.6}},
    },
    "ball": {"type": "sphere", "center": [0, 0, 1], "radius": 1, "bsdf": {"type": "dielectric"}},
    "lamp": {
        "type": "sphere",
        "center": [1.5, 1, 5],
        "radius": 0.1,
        "emitter": {"type": "area", "radiance": 1000.0},
    },
}
caustic = mi.load_dict(dictionary)
show({name: mi.render(caustic, integrator=made, spp=64) for name, made in pair.items()})

# %% [markdown]
# ## Comparing at equal time
#
# A sample of `bdpt` takes longer than one of `path`, so equal numbers of samples compare unequal work. Below each gets the
# samples that it traces in the same time, after a first render that compiles and runs the pilot; errors are means over
# three seeds. The time is the processor's, which other programs disturb less than the clock's. (`mitsuba-bdpt equal-time SCENE`
# compares a file's image in this way.)

# %%
SPP = 64


def timed(integrator, spp, seed):
    """An image of the Cornell box and the processor's seconds that it took."""
    start = time.process_time()
    image = np.array(mi.render(box, integrator=integrator, spp=spp, seed=seed))
    return image, time.process_time() - start


def seconds_per_sample(integrator):
    """The least of three renders, after one that compiles."""
    return min([timed(integrator, SPP, seed)[1] for seed in range(4)][1:]) / SPP


per_sample = {name: seconds_per_sample(made) for name, made in pair.items()}
budget = SPP * max(per_sample.values())
equal, errors = {}, {}
for name, integrator in pair.items():
    spp = max(1, round(budget / per_sample[name]))
    renders = [timed(integrator, spp, seed) for seed in range(3)]
    errors[name] = np.mean([rel_mse(image, reference) for image, _ in renders])
    seconds = np.mean([seconds for _, seconds in renders])
    equal[f"{name}: {spp} spp, {seconds:.2g} s,\nrelMSE {errors[name]:.2g}"] = renders[0][0]
show(equal)
print(f"at equal time the error of path is {errors['path'] / errors['bdpt']:.2g} times that of bdpt")

# %% [markdown]
# ## Long renders
#
# A bar under the cell, or on a terminal. The stop button of a notebook, Ctrl-C and `integrator.cancel()` end a render after
# the pass that is running; what is done is in the film. ([Long renders](long_renders.md) has checkpoints. `mi.render` would
# wrap the interruption in an error of its own; the integrator's method does not.)

# %%
bdpt.on_pass = mitsuba_bdpt.Bar()
try:
    image = bdpt.render(box, spp=256)
except KeyboardInterrupt:
    image = box.sensors()[0].film().develop()  # all finished passes
bdpt.on_pass = None
print(sum(bdpt.statistics["passes"]), "samples per pixel")

# %% [markdown]
# ## Limits
#
# The floor of a basin: the lamp shines on it through water, and the camera sees it through water. Such a path
# (specular-diffuse-specular, SDS) has no edge that can be connected, and only camera subpaths that happen to hit the lamp
# find it: fireflies. By default photons guide them where a pilot finds that it pays (`guiding`). Vertex merging,
# which is photon mapping for these paths alone, finds the light of point lamps too, is biased by a blur of about a pixel, and
# converges to the right image ([the method](../method/sds_paths.md#vertex-merging)).

# %%
water = {
    "type": "rectangle",
    "to_world": at.translate([0, 0, 0.7]).scale(4),
    "bsdf": {"type": "dielectric", "int_ior": 1.33},
}
basin = mi.load_dict(dictionary | {"water": water})
ways = {
    "path": path,
    "guiding=never": mi.load_dict({"type": "bdpt", "max_depth": 8, "guiding": "never"}),
    "bdpt": bdpt,
    "merging=true": mi.load_dict({"type": "bdpt", "max_depth": 8, "merging": True}),
}
show({name: mi.render(basin, integrator=made, spp=64) for name, made in ways.items()})
