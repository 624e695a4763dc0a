"""A picture of polarization: intensity, degree and angle on a table with glass, metal and varnish.

python scripts/polarization.py docs/images
"""

from __future__ import annotations

import sys
from pathlib import Path

import command_line
import numpy as np
import repository
from mitsuba_bdpt.cli.mistakes import answered
from mitsuba_bdpt.measure.options import WHOLE

import mitsuba as mi  # isort: skip

TABLE = Path(__file__).with_suffix(".xml")


def pictures(folder: Path, spp: int) -> None:
    """Intensity, degree of linear polarization and its angle, side by side."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    mi.set_variant("llvm_ad_spectral_polarized")
    method = mi.load_dict({"type": "bdpt", "max_depth": 8, "layers": "stokes"})
    image = np.array(method.render(mi.load_file(str(TABLE), parallel=False), spp=spp, seed=0))
    shown = np.clip(image[..., :3], 0, None)
    exposed = np.clip(shown / np.quantile(shown, 0.97), 0, 1) ** (1 / 2.2)
    s0, s1, s2 = (image[..., -12 + 3 * i : -9 + 3 * i].mean(-1) for i in range(3))
    degree = np.hypot(s1, s2) / np.maximum(s0, 1e-6)
    angle = np.degrees(np.arctan2(s2, s1)) / 2 % 180
    figure, axes = plt.subplots(1, 3, figsize=(14.4, 3.3), layout="constrained")
    hue = np.where(degree > 0.03, angle, np.nan)
    panels = {
        "intensity S0": (exposed, {}),
        "degree of linear polarization": (degree, {"vmin": 0, "vmax": 1, "cmap": "magma"}),
        "its angle in degrees (0: horizontal)": (hue, {"vmin": 0, "vmax": 180, "cmap": "twilight"}),
    }
    for axis, (title, (values, look)) in zip(axes, panels.items(), strict=True):
        drawn = axis.imshow(values, **look)
        axis.set(title=title)
        axis.set_axis_off()
        if look:
            figure.colorbar(drawn, ax=axis)
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
