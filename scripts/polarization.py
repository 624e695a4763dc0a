"""A picture of polarization: intensity, degree and angle on a table with glass, metal and varnish.

python scripts/polarization.py docs/images
"""

from __future__ import annotations

import sys
from pathlib import Path

import command_line
import mitsuba_bdpt  # noqa: F401 (before mitsuba: it chooses the LLVM library)

import mitsuba as mi  # isort: skip
import numpy as np
import repository
from mitsuba_bdpt.cli.mistakes import answered
from mitsuba_bdpt.measure.options import WHOLE

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
    method = mi.load_dict({"type": "bdpt", "max_depth": 8, "layers": "stokes"})
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


def main(arguments=None) -> int:
    """Write the picture."""
    parser = command_line.parser(__doc__)
    parser.add_argument("folder", nargs="?", type=Path, default=repository.ROOT / "docs" / "images")
    parser.add_argument("--spp", type=WHOLE, default=512)
    options = parser.parse_args(arguments)
    pictures(options.folder, options.spp)
    return 0


if __name__ == "__main__":
    sys.exit(answered(main))
