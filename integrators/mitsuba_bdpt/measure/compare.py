"""Two ways to render, alternating in time: seconds, errors and efficiency of the first over the second.

    python scripts/compare.py bdpt "path sampler=multijitter" --scenes open_sky veach_mis --spp 16 --pairs 12
    python scripts/compare.py "bdpt stored_vertices=3" bdpt --scenes cornell_box uplight_room

At 128^2, the depth of the benchmark: medians over pairs of renders of different seeds, after one that
compiles; of the efficiency the quartiles too. Errors are relMSE, trimmed of the worst 0.1 % and raw; the
last column is what the reference's own error adds to the trimmed one, of that side where it is more (ratios
are off by as much). Where an image has no error at all there are no ratios of errors, and that is said.
"""

from __future__ import annotations

import argparse
from dataclasses import dataclass

import mitsuba as mi
import numpy as np

from ..cli.arguments import number
from . import reference
from .analysis import Refused
from .metrics import TRIM, rel_mse
from .reference import RESOLUTION, benchmark_depth
from .tables import table
from .timing import timed

HEADS = (
    "scene",
    "spp",
    "time",
    "error",
    "raw error",
    "efficiency (quartiles)",
    "raw efficiency",
    "reference",
)


@dataclass(frozen=True)
class Side:
    """A plugin with parameters, and the scene with the sampler that it is given."""

    made: object
    scene: object

    @staticmethod
    def of(words: str, name: str) -> Side:
        """From ``TYPE KEY=VALUE …``, of which ``sampler=TYPE`` is the sensor's sampler."""
        words, sampler = words.split(), "independent"
        for word in words:
            if word.startswith("sampler="):
                sampler = word.removeprefix("sampler=")
        own = " ".join(word for word in words if not word.startswith("sampler="))
        made = reference.integrator_of(own, benchmark_depth(name))
        return Side(made, reference.load_scene(name, resolution=RESOLUTION, sampler=sampler))

    def measured(self, target: reference.Reference, spp: int, seed: int) -> tuple[float, ...]:
        """Seconds, errors, trimmed and raw, and the reference's share of the trimmed one, of a render; raises
        `Refused` if it has no error."""
        image, seconds = timed(self.scene, self.made, spp, seed)
        trimmed = rel_mse(image, target.image, TRIM)
        if trimmed == 0:
            raise Refused("every value (trimmed) is exactly that of the reference")
        return seconds, trimmed, rel_mse(image, target.image), target.share_of(image, TRIM) / trimmed


def line(name: str, sides: list[str], spp: int, pairs: int) -> list[str]:
    """A scene's line of the table."""
    try:
        return [f"`{name}`", str(spp), *ratios(name, sides, spp, pairs)]
    except Refused as why:
        return [f"`{name}`", str(spp), str(why), *["–"] * (len(HEADS) - 3)]


def ratios(name: str, sides: list[str], spp: int, pairs: int) -> list[str]:
    """The figures of a scene's line; raises `Refused` for an image without an error."""
    target = reference.load_reference(name, RESOLUTION, benchmark_depth(name))
    made, found = [Side.of(words, name) for words in sides], []
    for seed in range(pairs + 1):
        pair = [None, None]
        for i in (0, 1) if seed % 2 else (1, 0):
            pair[i] = made[i].measured(target, spp, seed)
        found.append(pair)
    first, second = np.array(found[1:]).transpose(1, 2, 0)
    time, error, raw, _ = first / second
    share = max(np.median(first[3]), np.median(second[3]))
    low, middle, high = np.quantile(1 / (time * error), (0.25, 0.5, 0.75))
    cells = [*np.median([time, error, raw], axis=1), np.median(1 / (time * raw))]
    text = [f"{x:.3g}" for x in cells]
    return [
        *text[:3],
        f"{middle:.3g} ({low:.3g}–{high:.3g})",
        text[3],
        f"{100 * share:.1f} %",
    ]


def main(arguments=None) -> int:
    """Print the table."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    text = "TYPE KEY=VALUE …, in quotes; sampler=TYPE is the sensor's sampler"
    parser.add_argument("sides", nargs=2, metavar="SIDE", help=text)
    parser.add_argument("--scenes", nargs="+", required=True, help="names in scenes/ that have references")
    parser.add_argument("--spp", type=number(int, 1), nargs="+", default=[64])
    parser.add_argument("--pairs", type=number(int, 1), default=12)
    args = parser.parse_args(arguments)
    mi.set_variant("llvm_ad_rgb")
    print(table(HEADS, [line(s, args.sides, spp, args.pairs) for s in args.scenes for spp in args.spp]))
    return 0
