# %% [markdown]
# # Tutorial
#
# A notebook (`docs/user/tutorial.ipynb`) and a script of the same cells, in a checkout of the repository, whose scenes it renders:
#
#     pip install 'mitsuba-bdpt[measure]' jupyterlab
#     jupyter lab docs/user/tutorial.ipynb
#     python docs/user/tutorial.py                   # some minutes; images in renders/tutorial
#     TUTORIAL_SIZE=32 python docs/user/tutorial.py  # a quick look

# %%
import json
import os
from pathlib import Path

import matplotlib.pyplot as plt
import mitsuba_bdpt  # before mitsuba: it chooses the LLVM library that Dr.Jit loads
import numpy as np
from mitsuba_bdpt.progress import Bar

import mitsuba as mi  # isort: skip

SIZE = int(os.environ.get("TUTORIAL_SIZE", "128"))  # width of the images
here = Path(globals().get("__file__", ".")).resolve()
ROOT = next(folder for folder in (here, *here.parents) if (folder / "scenes").is_dir())
OUT = ROOT / "renders" / "tutorial"
OUT.mkdir(parents=True, exist_ok=True)
mi.set_variant("llvm_ad_rgb")
print("mitsuba-bdpt", mitsuba_bdpt.__version__)


def scene(name, **values):
    """A scene of scenes/ at our size."""
    return mi.load_file(str(ROOT / "scenes" / f"{name}.xml"), resolution=SIZE, **values)


def rel_mse(image, reference):
    """Mean of (x - r)^2 / (r^2 + 0.01 mean(r)^2)."""
    x, r = (np.array(a, dtype=np.float64)[..., :3] for a in (image, reference))
    return ((x - r) ** 2 / (r**2 + 0.01 * r.mean() ** 2)).mean()


def show(name, **images):
    """Images side by side, in the notebook and in a file."""
    figure, axes = plt.subplots(1, len(images), figsize=(3.2 * len(images), 3.2), squeeze=False)
    for axis, (title, image) in zip(axes[0], images.items(), strict=True):
        colours = np.array(
            mi.Bitmap(image).convert(mi.Bitmap.PixelFormat.RGB, mi.Struct.Type.UInt8, srgb_gamma=True)
        )
        axis.imshow(colours)
        axis.set_title(title)
        axis.set_axis_off()
    keep(figure, name)


def keep(figure, name):
    """Write a figure to a file, and show it in a notebook."""
    figure.savefig(OUT / f"{name}.png", bbox_inches="tight", dpi=100)
    if "get_ipython" in globals():
        plt.show()
    plt.close(figure)


# %% [markdown]
# ## A first render
#
# A point light inside cut glass. `path` would have to hit the light by chance or to connect to it through the glass,
# and can do neither: black. Light subpaths leave the lamp, pass the glass, and are connected to the camera subpaths.

# %%
lamp = scene("lamp_behind_glass")
integrators = {name: mi.load_dict({"type": name, "max_depth": 12}) for name in ("bdpt", "path")}
bdpt = integrators["bdpt"]
images = {name: mi.render(lamp, integrator=made, spp=64) for name, made in integrators.items()}
for name, image in images.items():
    print(f"{name}: mean {np.array(image)[..., :3].mean():.3f}")
show("lamp_behind_glass", **images)
assert np.array(images["path"])[..., :3].max() == 0
assert np.array(images["bdpt"])[..., :3].mean() > 0.01

# %% [markdown]
# ## Reading `explain`
#
# Which strategies are used, which are skipped and why. With `spp` it runs the pilot of such a render too: a table of
# ways to render, with the time that each needs for the same error over that of the best. "impossible" follows from the
# scene, "not worth its cost here" from the pilot.

# %%
print(bdpt.explain(lamp, spp=4096))
box = scene("cornell_box")
print(bdpt.explain(box, spp=4096))

# %% [markdown]
# After a render `statistics` has the same in numbers; its decisions can be repeated in another process, or by an
# artist who wants the same image tomorrow.

# %%
bdpt.render(box, spp=4096 if SIZE < 64 else 256, seed=1, develop=False)
decisions = bdpt.statistics["decisions"]
print({key: bdpt.statistics[key] for key in ("seconds", "rays", "passes")})
again = mi.load_dict({"type": "bdpt", "max_depth": 12, "decisions": json.dumps(decisions)})
again.render(box, spp=16, seed=1, develop=False)
assert again.statistics["decisions"] == decisions

# %% [markdown]
# ## Choosing parameters
#
# Leave them alone first. Reasons to set one:
#
# * `max_depth`: as in `path`; paths in glass need more edges than one thinks (two for each pane).
# * `light_paths=0`: path tracing with better points; for scenes without caustics, when every render is very short.
# * `skip=none`, `light_paths=1`, `connections=all`: everything, for comparisons with other renderers.
# * `heuristic`: `balance` is the best or nearly so; `power` helps where one strategy is nearly without noise.
# * `variance=true`: error bars, and `target_error` to stop at one.

# %%
bars = mi.load_dict({"type": "bdpt", "max_depth": 6, "variance": True, "target_error": 0.02})
image = bars.render(box, spp=4096, seed=3)
done, error = sum(bars.statistics["passes"]), bars.statistics["error"]
reference = mi.render(box, integrator=mi.load_dict({"type": "bdpt", "max_depth": 6}), spp=8192, seed=9)
print(f"{done} spp; estimated relMSE {error:.3g}, found {rel_mse(image, reference):.3g}")
assert error <= 0.02

# %% [markdown]
# ## Strategy images
#
# A path of k edges can be sampled by k + 2 strategies (s, t). Each has its own image: weighted, what it adds to the
# result; unweighted, its estimate alone. `scripts/strategies.py` makes the pyramid of all of them.

# %%
shown = mi.load_dict({"type": "bdpt", "max_depth": 3, "strategy_images": True})
layers = np.array(shown.render(box, spp=64))
layers = layers[..., -len(shown.aov_names()) :]
three_edges = {}
for s in range(5):
    t = 4 - s
    at = shown.aov_names().index(f"weighted.s{s}t{t}.R")
    three_edges[s, t] = layers[..., at : at + 3].mean()
print("paths of three edges, by strategy:", {key: f"{value:.4f}" for key, value in three_edges.items()})

# %% [markdown]
# ## A caustic of one's own
#
# Any scene will do: a dictionary, a file. Here a small lamp over a glass ball on a floor. `path` finds the caustic by
# camera subpaths that happen to hit the lamp through the ball.

# %%
at = mi.ScalarTransform4f()
own = mi.load_dict(
    {
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
            "bsdf": {"type": "diffuse", "reflectance": 0.6},
        },
        "ball": {"type": "sphere", "center": [0, 0, 1], "radius": 1, "bsdf": {"type": "dielectric"}},
        "lamp": {
            "type": "sphere",
            "center": [1.5, 1, 5],
            "radius": 0.1,
            "emitter": {"type": "area", "radiance": 300.0},
        },
    }
)
made = {
    "path": mi.load_dict({"type": "path", "max_depth": 8}),
    "bdpt": mi.load_dict({"type": "bdpt", "max_depth": 8}),
}
images = {name: mi.render(own, integrator=integrator, spp=64) for name, integrator in made.items()}
show("own_caustic", **images)
print(made["bdpt"].explain(own, spp=64))

# %% [markdown]
# ## Long renders
#
# A bar under the cell, or on a terminal. The stop button of a notebook, Ctrl-C and `integrator.cancel()` end a render after
# the pass that is running; what is done is in the film. (`docs/user/long_renders.md` has checkpoints. `mi.render` would wrap the
# interruption in an error of its own; the integrator's method does not.)

# %%
bdpt.on_pass = Bar()
try:
    image = bdpt.render(box, spp=256)
except KeyboardInterrupt:
    image = box.sensors()[0].film().develop()  # all finished passes
bdpt.on_pass = None
print(sum(bdpt.statistics["passes"]), "samples per pixel")

# %% [markdown]
# ## Sweeps
#
# `presets/small.toml` names scenes, integrators and samples; a sweep is
#
#     python scripts/sweep.py presets/small.toml -o results/small
#     python scripts/report.py results/small      # tables and plots
#     python scripts/page.py results/small        # one HTML file to send around
#
# In a script of one's own, compare at equal time, not at equal samples, and more than one seed. Twice the samples, half the
# error; bdpt's points make it fall somewhat faster.

# %%
counts = [4, 16, 64, 256] if SIZE >= 64 else [4, 16]
plain = mi.load_dict({"type": "path", "max_depth": 6})
ours = mi.load_dict({"type": "bdpt", "max_depth": 6})
figure, axis = plt.subplots(figsize=(4.5, 3.2))
for name, integrator in (("path", plain), ("bdpt", ours)):
    sweep = []
    for spp in counts:
        renders = [mi.render(box, integrator=integrator, spp=spp, seed=seed) for seed in range(3)]
        sweep.append(np.mean([rel_mse(image, reference) for image in renders]))
    axis.loglog(counts, sweep, "o-", label=name)
    print(name, [f"{error:.3g}" for error in sweep])
axis.set_xlabel("samples per pixel")
axis.set_ylabel("relMSE")
axis.legend()
keep(figure, "sweep")

# %% [markdown]
# ## Limits
#
# In `pool` a small lamp shines over wavy water. The wall (sensor 0) gets its caustics by light tracing (t = 1), which
# `path` does not have. The floor seen from above (sensor 2) is behind water for the lamp *and* for the camera: no vertex of
# such a path can be connected to a neighbour, and only camera subpaths that happen to hit the lamp (s = 0) find it.

# %%
pool = scene("pool")
for sensor, view in ((0, "wall"), (2, "floor through water")):
    long_render = mi.render(pool, integrator=bdpt, sensor=sensor, spp=1024, seed=5)
    errors = {}
    for name, made in integrators.items():
        image = mi.render(pool, integrator=made, sensor=sensor, spp=64, seed=6)
        errors[name] = rel_mse(image, long_render)
        print(f"{view}, {name}: relMSE {errors[name]:.3g} at 64 samples per pixel")
    print(f"{view}: error of path over ours: {errors['path'] / errors['bdpt']:.3g}")
    assert view != "wall" or errors["path"] > 3 * errors["bdpt"]

# %% [markdown]
# On the floor a few fireflies determine the relMSE of both, the long render's too: no figure there means much, which
# is typical of paths that are found by chance only. With `merging=True` it comes out smooth, blurred by about a pixel
# (docs/reports/merging.md); `scenes/pool_floor.xml` has the sun in place of the lamp, and nothing else finds it.
