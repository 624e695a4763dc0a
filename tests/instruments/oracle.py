"""A slow oracle for the weights: every density of every strategy, written out.

E. Veach, "Robust Monte Carlo Methods for Light Transport Simulation" (1997), section 10.2: a path x_0 ... x_k
of k edges, x_0 on an emitter and x_k on the sensor, can be made by the strategies (s, t) with t = k + 1 - s:

    p_s = light[0] ... light[s-1] * camera[s] ... camera[k],

densities of each vertex from either side. Nothing is recursive and nothing is shared with the code under
test. Logarithms: products of twenty densities over 60 orders of magnitude leave the range of float64.

In media every sampled vertex has the density T c besides: T the transmittance of the edge that it is sampled
along, c the extinction (1 on surfaces, at emitters and sensors). A connecting edge is not sampled. Cosines
are 1 (M. Raab, D. Seibert, A. Keller 2008).

Edge i joins x_i and x_{i+1}. Arrays have one row per path.
"""

from __future__ import annotations

from dataclasses import dataclass, fields

import numpy as np

AREA, POSITION, ENVIRONMENT, DIRECTIONAL = range(4)


@dataclass
class Paths:
    """``n`` paths of ``k`` edges. ``dist2`` (n, k): squared length of the edges; ``cos_light`` (n, k):
    absolute geometric cosine of edge i at x_i, ``cos_camera`` at x_{i+1}; ``to_camera``, ``to_light`` (n, k +
    1): solid-angle densities of sampling x_{i+1} and x_{i-1} at x_i, used for 0 < i < k and where the event
    is not ``delta``. ``kind`` (n,) of the emitter. ``first``, ``second``: density of x_0 and of the direction
    to x_1 in emission (at infinity: of the direction, solid angle, and of the point on a disk across it).
    ``direct``: density of x_0 by next-event estimation from x_1, solid angle at x_1 (probability for delta
    emitters). ``lens``: whether the sensor has area; ``lens_pdf`` area density of x_k on it (1 without);
    ``sensor_pdf``: solid-angle density of the direction to x_{k-1}. In media (else None) ``transmittance``
    (n, k) of the edges, ``extinction`` (n, k + 1) of the vertices."""

    dist2: np.ndarray
    cos_light: np.ndarray
    cos_camera: np.ndarray
    to_camera: np.ndarray
    to_light: np.ndarray
    delta: np.ndarray
    kind: np.ndarray
    first: np.ndarray
    second: np.ndarray
    direct: np.ndarray
    lens: np.ndarray
    lens_pdf: np.ndarray
    sensor_pdf: np.ndarray
    transmittance: np.ndarray | None = None
    extinction: np.ndarray | None = None

    @property
    def k(self) -> int:
        """Number of edges."""
        return self.dist2.shape[1]

    def of(self, chosen) -> Paths:
        columns = (getattr(self, f.name) for f in fields(self))
        return Paths(*(None if x is None else x[chosen] for x in columns))

    @property
    def infinite(self):
        return (self.kind == ENVIRONMENT) | (self.kind == DIRECTIONAL)

    @property
    def delta_emitter(self):
        """No camera subpath can hit the emitter."""
        return (self.kind == POSITION) | (self.kind == DIRECTIONAL)


@dataclass(frozen=True)
class Coefficients:
    """kappa of each class of strategies; s = 0 and s = 1 with t >= 2 have 1. ``splat_prime``: that of t = 1
    where merges are compared with it."""

    endpoints: float = 1.0
    splat: float = 1.0
    inner: float = 1.0
    arrival: float = 1.0
    splat_prime: float = 1.0

    def of(self, s: int, k: int) -> float:
        t = k + 1 - s
        if s == 0:
            return 1.0
        if t == 0:
            return self.arrival
        if s == 1 and t == 1:
            return self.endpoints
        if s == 1:
            return 1.0
        return self.splat if t == 1 else self.inner


def log_steps(paths: Paths) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Logarithms of the densities of each vertex when sampled from the light and from the camera, (n, k + 1),
    and of x_0 by next-event estimation, (n,); area measure, at infinity solid angle."""
    k, n = paths.k, len(paths.kind)
    names = ("dist2", "cos_light", "cos_camera", "to_camera", "to_light")
    names += ("first", "second", "direct", "lens_pdf", "sensor_pdf")
    with np.errstate(divide="ignore"):
        log = {name: np.log(np.asarray(getattr(paths, name), dtype=np.float64)) for name in names}
    is_area = paths.kind == AREA

    # Densities of x_i when sampled from x_{i-1}. A delta event has the same (discrete) probability both ways,
    # so that any number serves; here 1. (The solid angles on the two sides of a refraction are not the same:
    # their ratio is left out, as by the weights under test, see `mis.scatter`.)
    light = np.zeros((n, k + 1))
    light[:, 0] = log["first"]
    # The emission density of x_1: over directions, or already over an area perpendicular to the edge.
    spread = np.where(paths.infinite, 0, log["dist2"][:, 0])
    light[:, 1] = log["second"] + log["cos_camera"][:, 0] - spread
    for i in range(2, k + 1):
        pdf = np.where(paths.delta[:, i - 1], 0, log["to_camera"][:, i - 1])
        light[:, i] = pdf + log["cos_camera"][:, i - 1] - log["dist2"][:, i - 1]

    camera = np.zeros((n, k + 1))
    camera[:, k] = log["lens_pdf"]
    for i in range(k - 1, -1, -1):
        if i == k - 1:
            pdf = log["sensor_pdf"]
        else:
            pdf = np.where(paths.delta[:, i + 1], 0, log["to_light"][:, i + 1])
        to_area = log["cos_light"][:, i] - log["dist2"][:, i]
        if i == 0:  # a direction keeps its solid angle; a delta emitter is never hit
            to_area = np.where(is_area, to_area, 0)
        camera[:, i] = pdf + to_area

    if paths.transmittance is not None:
        tr, c = np.log(paths.transmittance), np.log(paths.extinction)
        light[:, 1:] += tr + c[:, 1:]
        camera[:, :-1] += tr + c[:, :-1]

    # Next-event estimation makes x_0 with a density of its own.
    direct = log["direct"] + np.where(is_area, log["cos_light"][:, 0] - log["dist2"][:, 0], 0)
    return light, camera, direct


def log_densities(paths: Paths) -> np.ndarray:
    """log p_s, (n, k + 2); -inf where the strategy cannot make the path."""
    k, n = paths.k, len(paths.kind)
    light, camera, direct = log_steps(paths)
    p = np.empty((n, k + 2))
    for s in range(k + 2):
        t = k + 1 - s
        start = direct[:, None] if s == 1 and t >= 2 else light[:, : min(s, 1)]
        p[:, s] = start.sum(1) + light[:, 1:s].sum(1) + camera[:, s:].sum(1)
        possible = np.ones(n, dtype=bool)
        if s == 0:
            possible &= ~paths.delta_emitter
        elif s == 1 and t == 1:
            possible &= ~paths.delta_emitter | paths.lens
        else:  # the connecting edge joins x_{s-1} and x_s
            possible &= ~paths.delta[:, s - 1] if s >= 2 else True
            possible &= ~paths.delta[:, s] if t >= 2 else True
        if t == 0:
            possible &= paths.lens
        p[~possible, s] = -np.inf
    return p


def log_merges(paths: Paths, eta: np.ndarray) -> np.ndarray:
    """log n p of merging at x_1 ... x_{k-1}, (n, k - 1); -inf at delta events. Both subpaths make x_m, and
    the photon has to be in the disc: ``eta`` (n, k + 1) is the number of photons' subpaths times its area."""
    light, camera, _ = log_steps(paths)
    p = np.empty((len(paths.kind), max(paths.k - 1, 0)))
    for m in range(1, paths.k):
        p[:, m - 1] = np.log(eta[:, m]) + light[:, : m + 1].sum(1) + camera[:, m:].sum(1)
        p[paths.delta[:, m], m - 1] = -np.inf
    return p


class Explicit:
    """All strategies of ``paths``. ``size``: log kappa p, (n, k + 2); ``used``: where that is finite."""

    def __init__(self, paths: Paths, coefficients: Coefficients):
        kappa = np.array([coefficients.of(s, paths.k) for s in range(paths.k + 2)])
        with np.errstate(divide="ignore"):
            self._take(log_densities(paths) + np.log(kappa))

    def _take(self, size):
        self.size, self.used = size, np.isfinite(size)
        best = self.size.max(1, keepdims=True, initial=-1e300)
        self._ratio = np.where(self.used, np.exp(np.minimum(self.size - best, 0)), 0)

    def weights(self, heuristic: str):
        part = self._ratio ** {"balance": 1, "power": 2}[heuristic]
        total = part.sum(1, keepdims=True)
        return part / np.where(total > 0, total, 1)


def _combined(log_terms, heuristic: str):
    """log of the sum of each row's terms, with the power heuristic of the root of the sum of squares."""
    exponent = {"balance": 1, "power": 2}[heuristic]
    best = log_terms.max(1, initial=-1e300)
    with np.errstate(divide="ignore"):
        return best + np.log(np.exp(exponent * (log_terms - best[:, None])).sum(1)) / exponent


class Merged(Explicit):
    """With merges in further columns, see `mis`. S is the sum of kappa p of all strategies but merges, V that
    of the merges that have at least ``least`` (B) times that of the connection of either edge at their
    vertex, where t = 1 has `splat_prime` for kappa; a path is ``merged`` if V >= B S. ``log_s``, ``log_v``:
    their logarithms; ``near``: a comparison is closer than 0.1 %, so that rounding may decide it. With
    ``volume``, a mask, no merge counts on the light's side of an event of up to the density of isotropic
    scattering in a volume, of a diffuse reflection on a surface."""

    def __init__(self, paths, coefficients: Coefficients, eta, least: float, heuristic: str, volume=None):
        super().__init__(paths, coefficients)
        k, size, primed = paths.k, self.size, self.size.copy()
        with np.errstate(divide="ignore", invalid="ignore"):
            merges, log_b = log_merges(paths, eta), np.log(least)
            if volume is not None:
                diffuse = np.where(volume, 1.001 / (4 * np.pi), 1.001 / np.pi)
                events = ~paths.delta & (np.maximum(paths.to_camera, paths.to_light) <= diffuse)
                events[:, k] = False
                later = np.cumsum(events[:, ::-1], axis=1)[:, ::-1] - events  # number beyond x_i
                merges[later[:, 1:k] > 0] = -np.inf
            if coefficients.splat and k > 1:
                primed[:, k] += np.log(coefficients.splat_prime / coefficients.splat)
            edges = np.maximum(primed[:, 1:k], primed[:, 2 : k + 1])  # before and after x_1 ... x_{k-1}
            over = merges - (log_b + edges)
            merges = np.where(over >= 0, merges, -np.inf)
            self.log_s, self.log_v = _combined(size, heuristic), _combined(merges, heuristic)
            total = self.log_v - (log_b + self.log_s)
            self.near = (np.abs(over) < 1e-3).any(1) | (np.abs(total) < 1e-3)
        self.merged = (total >= 0) & np.isfinite(merges).any(1)
        merges = np.where(self.merged[:, None], merges, -np.inf)
        self._take(np.concatenate([size, merges], axis=1))


class Guided(Explicit):
    """With photon guiding through near-specular events, see `sds`. Events with at least the density ``least``
    from both sides count as specular beside delta ones. ``sds``: paths of three or more edges, not only of
    delta events, of which no edge is between two other vertices whose connection is in use. They have s = 0
    and s = 1, and the same two, in further columns, for each vertex x_2 ... x_{k-1} with a guided direction:
    that of the first vertex that is not specular, seen from the emitter; without one (``pure``) those of all
    that are not delta, behind a specular event or an edge that no strategy connects. ``guide`` (n, k + 1):
    density of that direction at each vertex. With ``least`` infinite delta events alone are specular, and t =
    0 takes part."""

    def __init__(self, paths: Paths, coefficients: Coefficients, guide, least: float):
        super().__init__(paths, coefficients)
        k, n, size = paths.k, len(paths.kind), self.size
        specular = paths.delta | (np.minimum(paths.to_camera, paths.to_light) >= least)
        specular[:, [0, k]] = False
        used = np.array([coefficients.of(e + 1, k) > 0 for e in range(k)])  # s = e + 1 connects edge e
        isolated = ~(~specular[:, :-1] & ~specular[:, 1:] & used).any(1)
        self.sds = isolated & ~paths.delta_emitter & ~paths.delta[:, 1:k].all(1) & (k > 2)
        diffuse = ~specular[:, 1:k]
        self.pure = self.sds & ~diffuse.any(1)
        guides = ~paths.delta[:, 1:k] & (specular[:, 2:] | ~used[1:]) & self.pure[:, None]
        rows = np.flatnonzero(self.sds & ~self.pure)
        guides[rows, diffuse[rows].argmax(1)] = True
        size[self.sds, 2 : k + 2 if np.isfinite(least) else k + 1] = -np.inf
        with np.errstate(divide="ignore"):
            ratio = np.log(guide[:, 1:k] / paths.to_light[:, 1:k])
        ratio = np.where(guides, ratio, -np.inf)[:, 1:]
        guided = (size[:, None, :2] + ratio[..., None]).reshape(n, -1)
        self._take(np.concatenate([size, guided], axis=1))
