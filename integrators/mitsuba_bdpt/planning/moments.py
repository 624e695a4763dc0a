# pyright: strict, reportArgumentType=false, reportAttributeAccessIssue=false, reportCallIssue=false
# pyright: reportIndexIssue=false, reportOperatorIssue=false, reportUnknownArgumentType=false
# pyright: reportUnknownLambdaType=false, reportUnknownMemberType=false, reportUnknownParameterType=false
# pyright: reportUnknownVariableType=false
"""Statistics of a pilot: variances of every way to render, and what points take off them.

Arithmetic on NumPy arrays that a `pilot.Pilot` has filled; it knows no scene. The equations are those of
`pilot`. `SAMPLE` and `SPLAT` are the rows that a pilot keeps.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, fields, replace
from typing import TYPE_CHECKING, Any, TypeVar

import drjit as dr
import mitsuba as mi
import numpy as np

from ..transport import mis
from ..transport.batch import NET, NETS
from ..transport.plan import GUIDED
from .configuration import WEIGHTINGS

if TYPE_CHECKING:
    from ..sensors.records import Region

    Lanes = TypeVar("Lanes", np.ndarray, mi.UInt32)


@dataclass(frozen=True)
class Layout:
    """The parts of a row, by name: how many numbers each has, in their order."""

    parts: dict[str, int]

    @property
    def width(self) -> int:
        """Numbers of a row: an even one, so that Dr.Jit adds it as a packet."""
        used = sum(self.parts.values())
        return used + used % 2

    def place(self, name: str) -> slice:
        """Where the numbers of a part are."""
        names = list(self.parts)
        first = sum(self.parts[other] for other in names[: names.index(name)])
        return slice(first, first + self.parts[name])

    def of(self, rows: np.ndarray, name: str) -> np.ndarray:
        """A part of all rows; their numbers lie along the last axis."""
        return rows[..., self.place(name)]

    def row(self, values: Mapping[str, list[Any]]) -> list[Any]:
        """The numbers of one row, from lists by the names of its parts."""
        return [x for name in self.parts for x in values[name]]


# How many weightings use a class of strategies: the last ones.
_USERS = {kind: sum(w.of(kind) > 0 for w in WEIGHTINGS) for kind in mis.CLASSES}

# Of a camera sample, for each weighting: its estimate, and the second moments of its contributions without
# t <= 1, less their squares; for each weighting with t <= 1 their second moments by it; for each weighting
# with inner connections what drawing one adds. Then the number of its vertices that were joined; its tile; in
# scenes with media the number of pairs that were evaluated, else 0.
SAMPLE = Layout(
    {
        "estimate": len(WEIGHTINGS),
        "moment": len(WEIGHTINGS),
        "light": _USERS["light"],
        "draw": _USERS["inner"],
        "joined": 1,
        "tile": 1,
        "evaluated": 1,
    }
)

# Parts of `SAMPLE` that are sums over the contributions.
SUMS = ("estimate", "moment", "light", "draw")

# The size of splats, their second moments without t <= 1, those of them that are rare (see `pilot.SELDOM`),
# and their second moments by t <= 1.
SPLAT = Layout(
    {
        "size": 1,
        "moment": len(WEIGHTINGS),
        "rare": len(WEIGHTINGS),
        "light": _USERS["light"],
    }
)

# Tiles of the image in each direction: of those whose brightness is known by itself, and of the larger ones
# that stand in for them as far as it is noise. (A caustic and its shadow are smaller than the larger ones: in
# small_casters/point_sphere splats would seem an eighth as noisy as they are.)
FINE, TILES = 32, 8

# The same for what is heard of emissions.
HEARD_TILES = 4

# Independent parts of the pilot, among which outliers are looked for.
GROUPS = 16

# The least that nets leave, of what can be told from so few.
LEAST_GAIN = 1e-3

# Camera samples of a pixel whose products give its squared mean (more of them where there are few pixels).
PER_PIXEL = 2


# A weighting whose relative variance comes out beyond this is ruled out, see `pilot.LOST`.
RULED_OUT = 1e15

# What nets leave is known from some 128 pairs of them: of the logarithm of a weighting's gain so much is its
# own, the rest that of all weightings. (All of it: one pilot of 32 chooses twice the best in `cornell_box`.)
OWN_GAIN = 0.3


# Fields of `Moments` that have a row for each group, and all of its arrays.
_OF_GROUPS = ("base", "rare", "light", "draw", "isolated")
_ARRAYS = (*_OF_GROUPS, "gain", "emission")


@dataclass(frozen=True)
class Moments:
    """What a pilot found, in units of the image's relative squared error per sample and pixel.

    ``base``, ``rare``, ``light`` and ``draw`` have the shape (`GROUPS`, weightings): with independent numbers
    variance is ``base`` + S ``light``, plus ``draw`` where one inner connection is drawn; ``rare`` is that
    part of ``base`` which paths have that are made too rarely for points to help. ``gain``, of each
    weighting, is what the points of a net leave of the rest of ``base``. ``isolated``, shape (`GROUPS`,
    numbers): the variance of paths on which s = 0 can be guided, which are in no other, if it is not, and
    with each of `plan.GUIDED` numbers of samples (no numbers: not measured). ``emission``: what was heard of
    emissions, see `_of_tiles` (nothing: no cells). ``mean`` of the image (mean of the
    colours, emitters seen directly left out; the median of the groups', so that no outlier sets it);
    ``rays`` and connections per camera sample and kind, with one light subpath each, the number of ``kinds``
    of BSDFs, and ``far``, the share of light subpaths that start at infinity; ``lanes``: number of camera
    samples.
    """

    base: np.ndarray
    rare: np.ndarray
    light: np.ndarray
    draw: np.ndarray
    isolated: np.ndarray
    gain: np.ndarray
    mean: float
    rays: dict[str, float]
    lanes: int
    emission: np.ndarray = field(default_factory=lambda: np.zeros((2, 0, 0)))

    def variance(self, draw: np.ndarray | float, stratified: bool = False) -> np.ndarray:
        """Relative variance per sample, shape (`GROUPS`, 2, weightings).

        First what does not depend on S, ``draw`` (`Moments.draw`, or 0 for all connections) included, then
        what grows with it, that of splats; with independent numbers, or with what ``stratified`` points leave
        of it.
        """
        base = self.base
        if stratified:
            # Not of splats, which land in pixels by chance: 0.2 to 1.3 is left of these in 22 scenes. (Mean
            # of 32 pilots' time times error over the best with 1 in place of 0.75, the median: `uplight_room`
            # 1.05 to 1.02, `veach_bidir` 1.07 to 1.02, `thin_lens` 1.24 to 1.17, small_casters/spot_sphere
            # 1.30 to 1.23, small_casters/sun_sphere 1.06 to 1.19.)
            base = self.rare + self._left_by_points() * (base - self.rare)
        return np.stack([base + draw, self.light], axis=1)

    def _left_by_points(self) -> np.ndarray:
        """What the points of a pixel leave of the variance, by weighting.

        Of what nets of `NET` leave, see `OWN_GAIN`, what 64 leave. (Fitted to pilots with nets of 64 points
        in 32 scenes: where 8 leave 0.65 these leave 0.65 of it again, at 0.3 half, at 0.05 a third, at 0.01 a
        fifth, within a factor of 1.6 in all but four.)
        """
        possible = np.isfinite(self.base).all(axis=0)
        common = self.gain[possible].mean() if possible.any() else 1.0
        gain = self.gain**OWN_GAIN * common ** (1 - OWN_GAIN)
        return gain ** (1.35 + gain)

    def of(self, groups: np.ndarray) -> Moments:
        """The moments of these of its groups, by number."""
        return replace(self, **{n: getattr(self, n)[groups] for n in _OF_GROUPS})

    def joined(self, other: Moments) -> Moments:
        """This pilot and another, of which each counts by its number of ``lanes``."""
        share = self.lanes / (self.lanes + other.lanes)

        def mean(a: Any, b: Any) -> Any:
            return share * a + (1 - share) * b

        rays = {n: mean(self.rays[n], other.rays[n]) for n in self.rays}
        means = {n: mean(getattr(self, n), getattr(other, n)) for n in (*_ARRAYS, "mean") if n != "isolated"}
        means["isolated"] = self.isolated if self.isolated.size else other.isolated
        if self.isolated.size and other.isolated.size:
            means["isolated"] = mean(self.isolated, other.isolated)
        return Moments(**means, rays=rays, lanes=self.lanes + other.lanes)


@dataclass(frozen=True)
class Samples:
    """Camera samples of a pilot, one row each.

    The ``estimate`` of each weighting, sums of second moments (``moment`` without t <= 1, less the squares
    that are in the estimate, ``light`` by t <= 1), what drawing one connection adds (``draw``), the fine
    ``tile``. Of neighbours each `PER_PIXEL` are of the same pixel; in nets each `NETS` times `NET`.
    """

    estimate: np.ndarray
    moment: np.ndarray
    light: np.ndarray
    draw: np.ndarray
    tile: np.ndarray

    @staticmethod
    def of_rows(rows: np.ndarray) -> Samples:
        """Those of a pilot's rows of `rows.SAMPLE`."""
        found = {f.name: SAMPLE.of(rows, f.name) for f in fields(Samples)}
        return Samples(**found | {"tile": found["tile"][:, 0].astype(int)})


@dataclass(frozen=True)
class Splats:
    """Sums of the splats of so many ``lanes`` light subpaths.

    By the group of the subpath and fine tile: shape (`GROUPS`, fine tiles, `rows.SPLAT`).
    """

    sums: np.ndarray
    lanes: int


def tile_of(region: Region, position: mi.Point2f, tiles: int = FINE) -> mi.UInt32:
    """The number of the tile at a ``position`` on the film, of so many in each direction."""
    uv = dr.clip(region.to_uv(position), 0, 1)
    xy = dr.minimum(mi.Point2u(uv * tiles), tiles - 1)
    return mi.UInt32(xy.y * tiles + xy.x)


def group(lane: Lanes) -> Lanes:
    """The independent part to which a sample, or the light subpath of a lane, belongs.

    The `PER_PIXEL` samples of a pixel, whose products are taken, are in the same.
    """
    return lane // PER_PIXEL % GROUPS


@dataclass(frozen=True)
class Isolated:
    """Light that s = 0 finds where it can be guided.

    ``sums`` of its moments (`guiding_benefit.Found`) over ``lanes`` camera samples, shape (`GROUPS`, fine
    tiles, moments); ``aimed``: vertices of one where s = 0 can be guided.
    """

    sums: np.ndarray
    aimed: float
    lanes: int


def moments(
    samples: Samples,
    nets: Samples | None,
    splats: Splats,
    rays: dict[str, float],
    isolated: Isolated | None = None,
    heard: np.ndarray | None = None,
) -> Moments:
    """The moments of a pilot of independent ``samples``, and ``nets``.

    ``splats`` count as if there were one light subpath per camera sample; ``rays`` are per camera sample;
    ``isolated`` light is in no sample. ``heard``: see `emission.Listener`.
    """
    count = len(samples.tile)
    width = samples.estimate.shape[1]
    sizes = SPLAT.of(splats.sums, "size").sum(axis=2) / splats.lanes
    if isolated is not None:
        sizes = sizes + isolated.sums[:, :, 0] / isolated.lanes
    groups = group(np.arange(count))
    inverse = 1 / _norms(samples, groups % 2, np.stack([sizes[half::2].sum(axis=0) for half in (0, 1)]))
    of_group = inverse[np.arange(GROUPS) % 2][:, None]
    weighted = np.matmul(of_group, splats.sums)[:, 0] * (GROUPS / splats.lanes)
    of_sample = inverse[groups % 2, samples.tile][:, None]

    def summed(values: np.ndarray | None, of_splats: str | None = None) -> np.ndarray:
        """By group, one column per weighting: those that have no use for ``values`` come first."""
        total = SPLAT.of(weighted, of_splats) if of_splats else weighted[:, :0]
        if values is not None:
            of_samples = _by_group(values * of_sample) * (GROUPS / count)
            total = of_samples + (total if total.shape[1] else 0)
        return np.pad(total, ((0, 0), (width - total.shape[1], 0)))

    guided = np.zeros((GROUPS, 1 + len(GUIDED)))
    if isolated is not None:
        guided = np.matmul(of_group, isolated.sums[:, :, 1:])[:, 0] * (GROUPS / isolated.lanes)
    estimate = samples.estimate
    base = summed(estimate**2 + samples.moment - estimate * _other(estimate), "moment")
    by_group = _by_group(estimate[:, -1:])[:, 0] / count + sizes.sum(axis=1)
    return Moments(
        base=np.where(base < RULED_OUT, base, np.inf),
        rare=summed(None, "rare"),
        light=summed(samples.light, "light"),
        draw=summed(samples.draw),
        isolated=guided,
        emission=_of_tiles(heard, samples, sizes.sum(axis=0)),
        gain=_gain(nets.estimate, inverse[0, nets.tile]) if nets else np.ones(width),
        mean=float(np.median(by_group) * GROUPS),
        rays=rays,
        lanes=count + (len(nets.tile) if nets else 0),
    )


def _of_tiles(heard: np.ndarray | None, samples: Samples, splats: np.ndarray) -> np.ndarray:
    """What was heard of emissions relative to the brightness of its place, `HEARD_TILES` in each direction.

    Shape (2, cells, classes), per sample; no cells if nothing was listened to. ``splats``: shares of the fine
    tiles of an image's brightness.
    """
    if heard is None:
        return np.zeros((2, 0, 0))

    def over_tiles(values: np.ndarray) -> np.ndarray:
        return _sums_of_blocks(values, HEARD_TILES).ravel()

    last = samples.estimate[:, -1]
    counts = over_tiles(np.bincount(samples.tile, minlength=FINE**2).astype(float))
    brightness = over_tiles(np.bincount(samples.tile, last, FINE**2)) / np.maximum(counts, 1)
    brightness += over_tiles(splats) * HEARD_TILES**2
    norms = brightness**2 + 0.01 * brightness.mean() ** 2
    found = np.einsum("htck,t->hck", heard, 1 / np.where(norms > 0, norms, np.inf)) / len(last)
    # What is no number would be one in no pilot that is joined with this one.
    return found if np.isfinite(found).all() else np.zeros_like(found)


def _other(estimate: np.ndarray) -> np.ndarray:
    """For each sample another one of its pixel."""
    return estimate.reshape(-1, PER_PIXEL, estimate.shape[1])[:, ::-1].reshape(estimate.shape)


def _by_group(values: np.ndarray) -> np.ndarray:
    """Sums of the samples' ``values`` by group, shape (`GROUPS`, columns)."""
    whole = -(-len(values) // (GROUPS * PER_PIXEL)) * GROUPS * PER_PIXEL
    padded = np.zeros((whole, values.shape[1]))
    padded[: len(values)] = values
    return padded.reshape(-1, GROUPS, PER_PIXEL, values.shape[1]).sum(axis=(0, 2))  # see `group`


def _norms(samples: Samples, half: np.ndarray, splats: np.ndarray) -> np.ndarray:
    """What squared errors are divided by, of each fine tile.

    The squared brightness, and a hundredth of that of the image, as relMSE has it.

    Shape (2, tiles): for each half of the samples, told by ``half`` (0 or 1 each), fine tiles have the
    brightness that the other half has found: an outlier would hide itself. ``splats`` of the halves, shape
    (2, tiles): their shares of a whole image's.
    """
    last = samples.estimate[:, -1]
    place = half * FINE**2 + samples.tile
    counts = np.bincount(place, minlength=2 * FINE**2).reshape(2, FINE, FINE).astype(float)
    sums = np.bincount(place, last, 2 * FINE**2).reshape(2, FINE, FINE)
    splats = splats.reshape(2, FINE, FINE) * FINE**2  # radiance, of which each half has a part
    coarse = _over_blocks(sums.sum(axis=0)) / np.maximum(_over_blocks(counts.sum(axis=0)), 1)
    coarse += _over_blocks(splats.sum(axis=0)) / (FINE // TILES) ** 2
    floor = 0.01 * coarse.mean() ** 2
    # A tile's own brightness is worth as many samples of the larger one as it has noise.
    square = last**2 + samples.moment[:, -1] - last * _other(samples.estimate)[:, -1]
    first = (coarse**2 + floor).ravel()[samples.tile]
    noise = np.sum(square / np.where(first > 0, first, np.inf)) / len(last)
    least = 2 * max(noise, 1e-3)
    found: list[np.ndarray] = []
    for other in (1, 0):
        near = _with_neighbours(counts[other])
        own = _with_neighbours(sums[other]) / np.maximum(near, 1)
        own += 2 * _with_neighbours(splats[other]) / _with_neighbours(np.ones_like(coarse))
        brightness = (near * own + least * coarse) / (near + least)
        found.append(brightness**2 + floor)
    norms = np.stack(found).reshape(2, -1)
    return np.where(norms > 0, norms, np.inf)


def _over_blocks(values: np.ndarray) -> np.ndarray:
    """Sums over the larger tiles, in place of each fine one."""
    many = FINE // TILES
    return np.kron(_sums_of_blocks(values, TILES), np.ones((many, many)))


def _sums_of_blocks(values: np.ndarray, tiles: int) -> np.ndarray:
    """Sums over larger tiles, so many in each direction, of ``values`` of the fine ones."""
    many = FINE // tiles
    return values.reshape(tiles, many, tiles, many).sum(axis=(1, 3))


def _with_neighbours(values: np.ndarray) -> np.ndarray:
    """Sums over squares of 3 x 3 tiles."""
    padded = np.pad(values, 1)
    rows = padded[:-2] + padded[1:-1] + padded[2:]
    return rows[:, :-2] + rows[:, 1:-1] + rows[:, 2:]


def _gain(estimate: np.ndarray, inverse: np.ndarray) -> np.ndarray:
    """Variance of a sample among points of a net over that of an independent one, by weighting; 1 at most.

    ``estimate`` of the samples in nets, ``inverse`` of the norm of their places. The square of the difference
    of two nets' means is twice the variance of such a mean, without bias; so is the mean square of the
    samples less the product of the two means the variance of a sample."""
    width = estimate.shape[1]
    nets = estimate.reshape(-1, NETS, NET, width)
    first, second = nets.mean(axis=2).transpose(1, 0, 2)
    inverse = inverse.reshape(len(nets), -1)[:, :1]
    alone = ((nets**2).mean(axis=(1, 2)) - first * second) * inverse
    within = NET * (first - second) ** 2 / 2 * inverse
    alone, within = alone.sum(axis=0), within.sum(axis=0)
    return np.clip(np.where(alone > 0, within / np.where(alone > 0, alone, 1), 1), LEAST_GAIN, 1)
