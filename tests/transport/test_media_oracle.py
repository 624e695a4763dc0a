"""The weights in media against explicit densities: the oracle has T of every edge and c = sigma_t of every
volume vertex in each density, the recursion T~ of the joining edge alone, and c in eta of merges."""

from __future__ import annotations

import itertools
from collections import defaultdict
from dataclasses import dataclass

import drjit as dr
import media_parts as parts
import mitsuba as mi
import numpy as np
import pytest
from mitsuba_bdpt import settings
from mitsuba_bdpt.merging import merging, passes, radius
from mitsuba_bdpt.merging.radius import Balls, Radius
from mitsuba_bdpt.run import rendering
from mitsuba_bdpt.sampling.points import Points
from mitsuba_bdpt.transport import connections, mis, techniques
from mitsuba_bdpt.transport.contribution import Counters
from mitsuba_bdpt.transport.inputs import Observer
from test_oracle import Unaimed, check, check_merged

from instruments import endpoints, oracle
from instruments.capture import rows, run
from instruments.chains import COEFFICIENTS, random_paths, recursion
from instruments.oracle import AREA, POSITION


def in_media(rng, paths, decades):
    """With random transmittances and extinctions; half of the inner vertices lie in a volume."""
    n, k = paths.dist2.shape
    paths.transmittance = (10 ** -rng.uniform(0, decades, (n, k))).astype(np.float32)
    volume = rng.random((n, k + 1)) < 0.5
    volume[:, [0, k]] = False
    paths.extinction = np.where(volume, 10 ** rng.uniform(-3, 3, (n, k + 1)), 1)
    paths.delta &= ~volume
    paths.cos_light[volume[:, :-1]] = 1
    paths.cos_camera[volume[:, 1:]] = 1
    return paths


@pytest.mark.parametrize("name", settings.HEURISTICS)
@pytest.mark.parametrize("classes", ["n1c1", "odd", "n1c0-half", "n0c0"])
def test_recursion_with_transmittances(name, classes):
    """All extinctions cancel, and all transmittances but that of the joining edge. 500 random paths each of k
    = 1 ... 7 edges, transmittances of 1e-4 to 1, extinctions of 1e-3 to 1e3; tolerances as of
    `test_oracle.test_recursion_agrees_with_explicit_densities`."""
    rng = np.random.default_rng(1)
    for k in range(1, 8):
        paths = in_media(rng, random_paths(rng, 500, k), 4)
        weights = recursion(paths, COEFFICIENTS[classes], name)
        check(oracle.Explicit(paths, COEFFICIENTS[classes]), name, weights, relative=1e-4)


@pytest.mark.parametrize("least", [0.0, mis.MERGE_DOMINATED])
@pytest.mark.parametrize("name", settings.HEURISTICS)
@pytest.mark.parametrize("classes", ["n1c1", "odd", "n0c0"])
def test_recursion_with_merges_in_volumes(name, classes, least, monkeypatch):
    """Merges have transmittances of all edges, and their vertex's extinction twice: once more in eta. Paths
    as above, volumes of balls times photons over six orders of magnitude."""
    monkeypatch.setattr(mis, "MERGE_DOMINATED", least)
    kappa, rng, total = COEFFICIENTS[classes], np.random.default_rng(6), 0
    for k in range(2, 8):
        paths = in_media(rng, random_paths(rng, 500, k), 4)
        eta = 10 ** rng.uniform(-3, 3, (500, k + 1))
        explicit = oracle.Merged(paths, kappa, eta, least, name)
        weights = recursion(paths, kappa, name, eta * paths.extinction)
        check_merged(explicit, name, weights, 1e-4, paths.delta)
        total += (explicit.merged & ~explicit.near).sum()
    assert total > 200


# -- the kernel ---------------------------------------------------------------------------------------

SIGMA, G, NEAR = 0.8, 0.4, 0.1
LANES, DEPTH = 640, 4
# Photon subpaths, and radii at which a camera vertex has one photon or none.
COUNT, DISC, BALL = 1 << 16, 2e-3, 0.014
WALL, ALBEDO, GLOW = np.array([0.7, 0.5, 0.3]), 0.9, np.array([5, 4, 3])


def hg(cos):
    return (1 - G * G) / (4 * np.pi * (1 + G * G - 2 * G * cos) ** 1.5)


def cloud():
    """A grid that holds the whole room, whose extinction varies by a factor of nine."""
    values = np.random.default_rng(4).uniform(0.2, 1.8, (4, 4, 4))
    return parts.grid(values, [-1.2] * 3, 2.4, SIGMA, 0.9, phase={"type": "hg", "g": G})


@dataclass
class Path:
    """A contribution's ``weight``, and its path from the emitter on: positions, and which lie in a volume. Of
    a merge also the camera's vertex ``z`` beside the photon, and the ``value`` of one photon."""

    s: int
    t: int
    weight: float
    p: np.ndarray
    volume: np.ndarray
    z: np.ndarray | None = None
    value: np.ndarray | None = None


def wide(v):
    return np.broadcast_to(rows(v), (LANES, 3))


def each(x):
    """A value of each lane."""
    return np.broadcast_to(np.array(x), LANES)


class Recorder(Observer):
    """Sink and observer of a run: by side, lane and number of a vertex its position (a null event's is
    overwritten), that of the endpoint connected to, and whether it lies in a volume; ``lens``: where a light
    subpath meets it on the edge to a vertex."""

    alpha, lanes = False, LANES

    def __init__(self):
        shape = (LANES, DEPTH + 2)
        self.p, self.ends = ({name: np.zeros((*shape, 3)) for name in ("light", "camera")} for _ in range(2))
        self.volume = {name: np.zeros(shape, dtype=bool) for name in self.p}
        self.lens, self.paths, self.drawn, self.gaps = np.zeros((*shape, 3)), [], None, [0.0]

    def with_photons(self, kernel_, least, patch):
        """The kernel with photons of which all are merged. A first pass stores all vertices (B = 0)."""
        patch.setattr(merging, "SLACK", 1e30)
        patch.setattr(radius, "MEAN_FREE_PATHS", np.inf)
        radii = (Radius(mi.Point3f(0), *map(mi.Float, (r, 0, r / 8, 8 * r))) for r in (DISC, BALL))
        discs, balls = radii
        merges, draw = merging.Merging(discs, mi.Float(COUNT), mi.Float(1)), merging.sample
        merges.balls = Balls(balls, kernel_.space.media)
        for b in (0.0, least):
            patch.setattr(mis, "MERGE_DOMINATED", b)
            points = Points("independent", dr.opaque(mi.UInt32, 7))
            merges, _ = passes.trace(kernel_, merges, Unaimed(), points, COUNT)
            if b == 0:
                found = merges.photons.found
                at = np.array(found.lane), np.array(found.edges)
                self.photons, self.foggy = np.zeros((COUNT, DEPTH, 3)), np.zeros((COUNT, DEPTH), dtype=bool)
                self.photons[at], self.foggy[at] = rows(found.p), np.array(found.medium) > 0
                self.photons[at[0][at[1] == 1], 0] = rows(found.p + found.d * found.distance)[at[1] == 1]

        def drawn(*arguments):
            self.drawn = draw(*arguments)
            return self.drawn

        patch.setattr(merging, "sample", drawn)
        return kernel_.replaced(sds=merges)

    def emitted(self, emission):
        self.origin = emission.si.p
        self.p["light"][:, 0] = wide(emission.si.p)

    def started(self, kernel, side, walk):
        self.kernel = kernel
        if not side.adjoint:
            self.p["camera"][:, 0] = wide(walk.previous)

    def vertex(self, side, walk, vertex, step):
        lanes = np.flatnonzero(each(vertex.active))
        at = lanes, each(vertex.edges)[lanes]
        self.p[side.name][at] = wide(vertex.si.p)[lanes]
        self.volume[side.name][at] = each(vertex.volume)[lanes]
        if vertex.endpoint is not None:
            end = vertex.endpoint.p if side.adjoint else vertex.endpoint.anchor.p
            self.ends[side.name][at] = wide(end)[lanes]
        if side.adjoint and self.kernel.plan.arrival:
            dist2 = self.kernel.camera.hit(walk, vertex, mi.Bool(False)).dist2
            self.lens[at] = wide(walk.previous + walk.d * dr.sqrt(dist2))[lanes]

    def begin(self):
        return dr.zeros(mi.Spectrum)

    def add(self, kernel_, c, total, start, shared):
        self._note(c)
        return total

    def splat(self, kernel_, c, shared, stream):
        if kernel_.plan.endpoints:  # (1,1) is made before the walk begins
            u = techniques._sensor_points(kernel_, stream)
            self.ends["light"][:, 0] = wide(kernel_.camera.connect(self.origin, *u).p)
        self._note(c)
        return Counters()

    def connect(self, kernel_, z, lane, stream, total, start):
        """All are weighed; the one that is drawn has the weight of one of them."""
        found = []
        connections.connect_all(
            kernel_, z, lane.path, stream, total, lambda _, c, total: found.append(c) or total
        )
        for c in found:
            self._note(c)
        if found:
            c = connections.connect_one(kernel_, z, lane.path, stream)
            gaps = np.abs(np.stack([each(other.weight) for other in found]) - each(c.weight)).min(0)
            self.gaps += [*gaps[each(c.active)]]
        return total, Counters()

    def end(self, *_):
        return Counters()

    def _note(self, c):
        s, t, weight = (each(x) for x in (c.s, c.t, c.weight))
        for i in np.flatnonzero(each(c.active) & wide(c.value).any(1)):
            if c.kind == "merge":
                self.paths.append(self._merge(c, i, int(s[i]), int(t[i]), float(weight[i])))
            else:
                self.paths.append(self._path(i, int(s[i]), int(t[i]), float(weight[i])))

    def _merge(self, c, i, s, t, weight):
        lane, value = each(self.drawn.photon.lane)[i], wide(c.value)[i] / each(self.drawn.number)[i]
        p = np.concatenate([self.photons[lane, :s], self.p["camera"][i, :t][::-1]])
        volume = np.concatenate([self.foggy[lane, :s], self.volume["camera"][i, :t][::-1]])
        return Path(s, t, weight, p, volume, self.p["camera"][i, t].copy(), value)

    def _path(self, i, s, t, weight):
        y, z = self.p["light"][i, :s], self.p["camera"][i, :t]
        if s == 1 and t > 1:  # next-event estimation, light tracing and (1,1) sample an endpoint of their own
            y = self.ends["camera"][i, [t - 1]]
        elif t == 1:
            z = self.ends["light"][i, [s - 1]]
        elif t == 0:
            y = np.concatenate([y[:-1], self.lens[i, [s - 1]]])
        volume = self.volume["light"][i, :s], self.volume["camera"][i, :t][::-1]
        return Path(s, t, weight, np.concatenate([y, z[::-1]]), np.concatenate(volume))


def recorded(scene, integrator, least, patch):
    """All paths of one run of the kernel, with merges unless ``least`` (B) is empty, and the extinction (1 /
    scene unit) of T~."""
    render, recorder = rendering.Render(scene, scene.sensors()[0], integrator.settings, 5, 1), Recorder()
    run(recorder.with_photons(render.kernel, float(least), patch) if least else render.kernel, recorder, 5)
    assert max(recorder.gaps) < 1e-4
    (sigma,) = render.kernel.space.media.mean(render.kernel.sensor_medium).numpy()
    return recorder.paths, float(sigma)


def normals(p, light):
    """Of wall and lamp, both balls."""
    if light.radius:
        from_lamp = p - light.center
        on_lamp = np.abs(np.linalg.norm(from_lamp, axis=-1) - light.radius) < 1e-3
        p = np.where(on_lamp[..., None], from_lamp, p)
    return p / np.linalg.norm(p, axis=-1, keepdims=True)


def explicit_paths(made, scene, sigma):
    """Densities of paths of one length, vertices from the emitter on."""
    light, camera = endpoints.lamps_of(scene)[0], endpoints.Camera.of(scene.sensors()[0])
    p, volume = (np.array([getattr(path, name) for path in made]) for name in ("p", "volume"))
    n, k = len(p), p.shape[1] - 1
    normal = normals(p, light)
    volume[:, [0, k]] = False
    step = p[:, 1:] - p[:, :-1]
    for i, path in enumerate(made):
        if path.z is not None:  # the camera's edge ends beside the photon
            step[i, path.s - 1] = p[i, path.s] - path.z
    dist2 = (step**2).sum(2)
    d = step / np.sqrt(dist2)[..., None]
    cos_light = np.where(volume[:, :-1], 1, np.abs((normal[:, :-1] * d).sum(2)))
    cos_camera = np.where(volume[:, 1:], 1, np.abs((normal[:, 1:] * d).sum(2)))
    cos_camera[:, -1] = np.where(camera.radius > 0, np.abs(d[:, -1] @ camera.axis), 1)
    if light.kind == POSITION:
        cos_light[:, 0] = 1
    in_fog = np.sqrt(dist2)
    in_fog[:, -1] -= NEAR / np.abs(d[:, -1] @ camera.axis)  # camera rays start at the near plane
    to_camera, to_light = np.ones((n, k + 1)), np.ones((n, k + 1))
    for i in range(1, k):
        phase = hg((d[:, i - 1] * d[:, i]).sum(1))
        to_camera[:, i] = np.where(volume[:, i], phase, cos_light[:, i] / np.pi)
        to_light[:, i] = np.where(volume[:, i], phase, cos_camera[:, i - 1] / np.pi)
    return oracle.Paths(
        dist2=dist2,
        cos_light=cos_light,
        cos_camera=cos_camera,
        to_camera=to_camera,
        to_light=to_light,
        delta=np.zeros((n, k + 1), dtype=bool),
        kind=np.full(n, light.kind),
        first=light.first(d[:, 0]),
        second=light.second(cos_light[:, 0], p[:, 1], d[:, 0], None),
        direct=light.direct(cos_light[:, 0], dist2[:, 0], p[:, 1], d[:, 0]),
        lens=np.full(n, camera.radius > 0),
        lens_pdf=np.full(n, camera.lens_density()),
        sensor_pdf=camera.density(d[:, -1]),
        transmittance=np.exp(-sigma * in_fog),
        extinction=np.where(volume, sigma, 1.0),
    )


@pytest.mark.parametrize(
    "kind, heuristic",
    [
        *itertools.product(["lamp", "point", "lens"], ["balance", "power"]),
        *(("cloud", "balance"), ("lens B=0", "balance"), ("cloud B=0.1", "power")),
    ],
)
def test_kernel_in_fog_agrees_with_explicit_densities(kind, heuristic, monkeypatch):
    """A room of gray fog (sensor and lamp in it, hg); densities are written out from the positions of the
    vertices of each lane's paths. In a cloud T~ is that of its mean extinction. Expected: every weight to
    2e-3 of its own size plus 1e-4, but for 1 % of the paths of each strategy and one: near walls cosines are
    few digits of float32 positions, and at a lamp's rim rounding decides. At least so many paths of each
    strategy with vertices in the fog as below. With a B also merges, about a null ball in the same fog or in
    a cloud: a photon's estimate in fog is its flux, albedos and the phase function over eta, to 1e-3."""
    kind, _, least = kind.partition(" B=")
    camera = parts.thinlens if kind == "lens" else parts.sensor
    light = parts.point() if kind == "point" else parts.lamp()
    medium = cloud() if kind == "cloud" else parts.fog(SIGMA, ALBEDO, G)
    more = {"null": parts.ball("null", interior=medium, exterior=medium)} if least else {}
    sensor = camera(near=NEAR, medium=medium) | ({"aperture_radius": 0.4} if kind == "lens" else {})
    scene = mi.load_dict(parts.room(sensor, light, **more))
    method = parts.integrator(skip="none", max_depth=DEPTH, heuristic=heuristic)
    monkeypatch.setattr(merging.Merging, "inside", lambda *_: 1.0)  # balls are whole
    made, sigma = recorded(scene, method, least, monkeypatch)
    by_length, seen, wrong = defaultdict(list), defaultdict(int), defaultdict(list)
    for path in made:
        by_length[len(path.p) - 1].append(path)
    for k, of_length in by_length.items():
        paths = explicit_paths(of_length, scene, sigma)
        assert (paths.kind == (POSITION if kind == "point" else AREA)).all()
        eta = COUNT * np.where(paths.extinction != 1, 4 / 3 * np.pi * BALL**3, np.pi * DISC**2)
        explicit = oracle.Explicit(paths, oracle.Coefficients())
        if least:
            volume = paths.extinction != 1
            explicit = oracle.Merged(paths, oracle.Coefficients(), eta, float(least), heuristic, volume)
        expected = explicit.weights(heuristic)
        np.testing.assert_allclose(expected.sum(1), 1, atol=1e-9)
        for i, (path, volume, weights) in enumerate(
            zip(of_length, paths.extinction != 1, expected, strict=True)
        ):
            strategy, wanted = (min(path.s, 2), min(path.t, 2)), weights[path.s]
            if path.z is not None:
                strategy, wanted, m = ("merge", 2), weights[k + path.s], path.s - 1
                albedos = np.where(volume[1:k, None], ALBEDO, WALL).prod(0)
                f = paths.to_camera[i, m] / (paths.cos_light[i, m] * eta[i, m] * paths.extinction[i, m])
                flux = GLOW * np.pi * 4 * np.pi * 0.2**2
                if kind != "cloud":
                    np.testing.assert_allclose(path.value, flux * albedos * f, rtol=1e-3)
            seen[*strategy, bool(volume.any())] += 1
            if abs(path.weight - wanted) > 2e-3 * wanted + 1e-4:
                wrong[strategy].append((k, path.s, path.weight, wanted))
    for strategy in {key[:2] for key in seen}:
        count = seen[*strategy, True] + seen[*strategy, False]
        assert len(wrong[strategy]) <= 1 + 0.01 * count, (strategy, count, wrong[strategy][:9])
    for strategy in ((0, 2), (1, 2), (2, 1), (2, 2)):
        fewest = (kind != "point") * 8 if strategy[0] == 0 else 100
        assert seen[*strategy, True] >= fewest, (strategy, dict(seen))
    assert seen["merge", 2, True] >= 60 or not least, dict(seen)
    if kind == "lens":
        assert seen[2, 0, True] >= 8 and seen[2, 0, False] >= 8 and seen[1, 1, False] >= 100, dict(seen)
