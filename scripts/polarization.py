"""Polarized variants: what they gain over `stokes` around `path`, and pictures.

    python scripts/polarization.py table                      # three scenes, some ten minutes
    python scripts/polarization.py pictures docs/images       # polarization of a table with glass and metal

The table: `bdpt` over `path` at equal time (CPU) in ``mono`` and in ``mono_polarized``, there with the layers
of Stokes vectors on both sides, at 64^2 and 64 samples per pixel. Errors are the mean squared distance of the
Stokes vectors, relative as in relMSE to the intensity, raw and without the worst pixels, of a render of our
own with many samples; medians over seeds. (In ``mono`` filters are grey, and vectors have the intensity
alone.)
"""

from __future__ import annotations

import argparse
import time
from pathlib import Path

import mitsuba_bdpt  # noqa: F401 (before mitsuba: it chooses the LLVM library)

import drjit as dr  # isort: skip
import mitsuba as mi  # isort: skip
import numpy as np
import repository
from mitsuba_bdpt.measure.metrics import TRIM, rel_mse_epsilon
from mitsuba_bdpt.measure.tables import ratio, table

SIZE, SPP, SEEDS, REFERENCE_SPP = 64, 64, 7, 8192

FILTER = """<shape type="rectangle"><bsdf type="polarizer"><float name="theta" value="30"/></bsdf>
<transform name="to_world"><scale value="{}"/><rotate y="1" angle="{}"/><translate value="{}"/></transform>
</shape>"""

SCENES = {
    "veach_bidir": FILTER.format(0.4, 90, "15.9, 4.0517, 0.0115"),  # before the lens
    "glass_caustics": "",
    "projector_through_glass": FILTER.format(0.1, 180, "0, 1, 1.1"),  # before the projector
}


def scene(name: str, more: str) -> mi.Scene:
    """A scene of the repository with ``more`` objects, written as XML."""
    file = repository.scene_file(name)
    text = file.read_text().replace("</scene>", more + "</scene>")
    mi.file_resolver().prepend(str(file.parent))
    return mi.load_string(text, resolution=str(SIZE), parallel=False)


def vectors(image) -> np.ndarray:
    """Stokes vectors (height, width, 1 or 4) of a render in a monochromatic variant."""
    image = np.array(image, dtype=np.float64)
    return image[..., -12::3] if mi.is_polarized else image[..., :1]


def error(found, reference, trim: float) -> float:
    """Mean squared distance of Stokes vectors over the squared intensity, without the share ``trim``."""
    intensity = reference[..., :1]
    epsilon = rel_mse_epsilon(np.repeat(intensity, 3, axis=-1))
    errors = ((found - reference) ** 2).sum(-1) / (intensity[..., 0] ** 2 + epsilon)
    kept = np.sort(errors.ravel())[: round(errors.size * (1 - trim))]
    return float(kept.mean())


def integrators(depth: int) -> dict:
    """Ours and Mitsuba's, by name, with Stokes vectors if the variant has them."""
    ours = {"type": "bdpt", "max_depth": depth}
    path = {"type": "path", "max_depth": depth}
    if mi.is_polarized:
        ours["stokes"], path = True, {"type": "stokes", "nested": path}
    return {"bdpt": mi.load_dict(ours), "path": mi.load_dict(path)}


def costs(name: str, variant: str) -> dict[str, tuple[float, float]]:
    """Errors times seconds by integrator, raw and trimmed."""
    mi.set_variant(variant)
    made, depth = scene(name, SCENES[name]), repository.benchmark_depth(name)
    methods = integrators(depth)
    reference = vectors(methods["bdpt"].render(made, spp=REFERENCE_SPP, seed=10**6))
    found = {}
    for label, method in methods.items():
        rows = []
        for seed in range(SEEDS + 1):
            dr.sync_thread()
            began = time.process_time()
            image = mi.render(made, integrator=method, spp=SPP, seed=seed)
            dr.eval(image)
            dr.sync_thread()
            seconds = time.process_time() - began
            rows.append([seconds, *(error(vectors(image), reference, trim) for trim in (0, TRIM))])
        seconds, raw, trimmed = np.median(rows[1:], axis=0)  # the first one compiles
        found[label] = seconds * raw, seconds * trimmed, seconds
    return found


def rows() -> str:
    """The table."""
    lines = []
    for name in SCENES:
        plain, polarized = (costs(name, f"llvm_ad_mono{more}") for more in ("", "_polarized"))
        raw, trimmed = ([found["path"][i] / found["bdpt"][i] for found in (plain, polarized)] for i in (0, 1))
        dearer = [polarized[who][2] / plain[who][2] for who in ("bdpt", "path")]
        lines.append([name, *map(ratio, [*trimmed, *raw]), *(f"{x:.2f}" for x in dearer)])
        print(lines[-1], flush=True)
    head = [
        "scene",
        "mono",
        "mono_polarized",
        "mono, raw",
        "mono_polarized, raw",
        "time of `bdpt`",
        "of `path`",
    ]
    return table(head, lines)


TABLE = """<scene version="3.0.0">
<sensor type="perspective"><float name="fov" value="32"/>
<transform name="to_world"><lookat origin="0, 2.6, 5" target="0, 0.45, 0" up="0, 1, 0"/></transform>
<film type="hdrfilm"><integer name="width" value="480"/><integer name="height" value="300"/>
<string name="component_format" value="float32"/></film></sensor>
<shape type="rectangle"><transform name="to_world"><scale value="6"/><rotate x="1" angle="-90"/></transform>
<bsdf type="pplastic"><rgb name="diffuse_reflectance" value="0.25, 0.16, 0.1"/>
<float name="alpha" value="0.08"/></bsdf>
</shape>
<shape type="rectangle"><transform name="to_world"><scale value="6"/><translate value="0, 0, -4"/></transform>
<bsdf type="diffuse"><rgb name="reflectance" value="0.4"/></bsdf></shape>
<shape type="sphere"><point name="center" value="-0.95, 0.5, 0"/><float name="radius" value="0.5"/>
<bsdf type="dielectric"/></shape>
<shape type="sphere"><point name="center" value="0.2, 0.5, -0.4"/><float name="radius" value="0.5"/>
<bsdf type="roughconductor"><string name="material" value="Au"/><float name="alpha" value="0.1"/></bsdf>
</shape>
<shape type="sphere"><point name="center" value="1.2, 0.4, 0.2"/><float name="radius" value="0.4"/>
<bsdf type="pplastic"><rgb name="diffuse_reflectance" value="0.1, 0.25, 0.5"/></bsdf></shape>
<shape type="sphere"><point name="center" value="-2.6, 3.4, -0.6"/><float name="radius" value="0.25"/>
<bsdf type="diffuse"><rgb name="reflectance" value="0"/></bsdf>
<emitter type="area"><rgb name="radiance" value="40"/></emitter></shape>
<shape type="rectangle"><transform name="to_world"><scale value="1.6"/>
<lookat origin="0, 4, -3" target="0, 0.4, 0" up="0, 1, 0"/></transform>
<emitter type="area"><rgb name="radiance" value="1.2"/></emitter></shape>
</scene>"""


def pictures(folder: Path, spp: int) -> None:
    """Intensity, degree of linear polarization and its angle, side by side."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    mi.set_variant("llvm_ad_spectral_polarized")
    method = mi.load_dict({"type": "bdpt", "max_depth": 8, "stokes": True})
    image = np.array(method.render(mi.load_string(TABLE, parallel=False), spp=spp, seed=0))
    shown = np.clip(image[..., :3], 0, None)
    exposed = np.clip(shown / np.quantile(shown, 0.97), 0, 1) ** (1 / 2.2)
    s0, s1, s2 = (image[..., -12 + 3 * i : -9 + 3 * i].mean(-1) for i in range(3))
    degree = np.hypot(s1, s2) / np.maximum(s0, 1e-6)
    angle = np.degrees(np.arctan2(s2, s1)) / 2 % 180
    figure, axes = plt.subplots(1, 3, figsize=(14.4, 3.3), layout="constrained")
    axes[0].imshow(exposed)
    axes[0].set_title("intensity S0")
    drawn = axes[1].imshow(degree, vmin=0, vmax=1, cmap="magma")
    axes[1].set_title("degree of linear polarization")
    figure.colorbar(drawn, ax=axes[1])
    hue = np.where(degree > 0.03, angle, np.nan)
    drawn = axes[2].imshow(hue, vmin=0, vmax=180, cmap="twilight")
    axes[2].set_title("its angle in degrees (0: horizontal)")
    figure.colorbar(drawn, ax=axes[2])
    for axis in axes:
        axis.set_axis_off()
    file = folder / "polarization.png"
    figure.savefig(file, dpi=90, metadata={"Software": None})
    print(file)


def main() -> None:
    """As the command line says."""
    layout = argparse.RawDescriptionHelpFormatter
    parser = argparse.ArgumentParser(allow_abbrev=False, description=__doc__, formatter_class=layout)
    parser.add_argument("what", choices=("table", "pictures"))
    parser.add_argument("folder", nargs="?", type=Path, default=repository.ROOT / "docs" / "images")
    parser.add_argument("--spp", type=int, default=512, help="of pictures")
    options = parser.parse_args()
    if options.what == "table":
        print(rows())
    else:
        pictures(options.folder, options.spp)


if __name__ == "__main__":
    main()
