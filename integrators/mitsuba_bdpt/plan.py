"""What a render does and does not need: the strategies in use, their counts and coefficients."""

from __future__ import annotations

from dataclasses import dataclass, field

import mitsuba as mi

from .objects import children

UNLIMITED = 2**32 - 1

# Most light vertices per lane (a lane's local memory lies on a thread's stack).
MAX_STORED = 1024

DEFAULT_STORED = 64

LIGHT_PATHS = (0, 1, 1 / 2, 1 / 4, 1 / 8, 1 / 16)
CONNECTIONS = ("auto", "all", "one", "none")
SKIP = ("auto", "impossible", "none")


@dataclass(frozen=True)
class Settings:
    """The integrator's parameters, checked. See `integrator` for their meaning."""

    max_depth: int
    rr_depth: int
    hide_emitters: bool
    heuristic: str
    skip: str
    light_paths: float | str
    connections: str
    points: str
    stored_vertices: int
    strategy_images: bool
    variance: bool
    aovs: str
    spp_per_pass: int
    timeout: float

    @property
    def strategy_depth(self) -> int:
        """The largest path length of the strategy images, 0 for none."""
        return self.max_depth if self.strategy_images else 0


@dataclass(frozen=True)
class Plan:
    """Strategy classes in use for one scene and sensor.

    Classes: ``hit`` s=0, ``direct`` s=1 with t>=2, ``splat`` t=1 with s>=2, ``endpoints`` (1,1),
    ``arrival`` t=0, ``inner`` s,t>=2. ``served``: camera subpaths per light subpath (S).
    ``connections``: ``all``, ``one`` or ``none``. ``splat_coefficient``: kappa of t=1 over its count.
    ``roulette``: whether small contributions may be dropped before their ray. ``skipped`` explains what is
    left out.
    """

    hit: bool
    direct: bool
    splat: bool
    endpoints: bool
    arrival: bool
    connections: str
    served: int
    splat_coefficient: float
    roulette: bool
    hide_emitters: bool
    skipped: tuple = field(default=())

    @property
    def light(self) -> bool:
        """Whether light subpaths are traced at all."""
        return self.splat or self.arrival or self.connections != "none" or self.endpoints


def plan(scene, emitters, camera, settings: Settings) -> Plan:
    """Decide from the scene alone what is impossible, and apply the parameters given by hand."""
    skipped = []

    def skip(name, level, why):
        skipped.append({"class": name, "level": level, "why": why})
        return False

    smooth = any(mi.has_flag(b.flags(), mi.BSDFFlags.Smooth) for b in scene_bsdfs(scene))
    hit = emitters.hittable or skip("s=0", "impossible", "no emitter that a ray can hit")

    def possible(name, needed, where, why):
        """A class that joins surfaces, on paths of ``needed`` edges or more."""
        why = _why_not(scene, smooth, emitters, settings.max_depth, needed) or ("" if where else why)
        return skip(name, "impossible", why) if why else True

    joinable = camera.joinable and emitters.traced
    direct = possible("s=1", 2, emitters.direct, "next-event estimation can choose no emitter")
    splat = possible("t=1", 2, joinable, camera.reason or _UNTRACED)
    inner = possible("inner", 3, emitters.traced, _UNTRACED)
    why = _why_not_endpoints(emitters, camera, settings)
    endpoints = skip("(1,1)", "impossible", why) if why else True
    why = _why_not_arrival(emitters, camera, settings)
    arrival = skip("t=0", "impossible", why) if why else True
    for name, why in emitters.left_out:
        skip(name, "impossible", why)

    light_paths, connections = _defaults(settings)
    if light_paths == 0:
        splat = endpoints = arrival = inner = False
        skip("t=0, t=1, (1,1), inner", "by hand", "light_paths=0")
    if inner and connections == "none":
        inner = skip("inner", "by hand", "connections=none")
    if light_paths and settings.stored_vertices < min(settings.max_depth, DEFAULT_STORED):
        skip(
            f"t=0, t=1 and inner for paths longer than {settings.stored_vertices} edges",
            "by hand",
            f"stored_vertices={settings.stored_vertices}: such paths use s=0 and s=1",
        )
    return Plan(
        hit=hit,
        direct=direct,
        splat=splat,
        endpoints=endpoints,
        arrival=arrival,
        connections=connections if inner else "none",
        served=round(1 / light_paths) if light_paths else 1,
        splat_coefficient=1.0 if settings.skip == "none" else 0.25,
        roulette=settings.skip != "none" and not settings.strategy_images,
        hide_emitters=settings.hide_emitters,
        skipped=tuple(skipped),
    )


def _defaults(settings: Settings):
    """``light_paths`` and ``connections`` in effect: given by hand, or by ``skip``."""
    everything = settings.skip == "none"
    light_paths, connections = settings.light_paths, settings.connections
    if light_paths == "auto":
        light_paths = 1 if everything else 1 / 4
    if connections == "auto":
        connections = "all" if everything else "one"
    if settings.strategy_images and connections == "one":
        connections = "all"  # a drawn connection is no estimate of each strategy by itself
    return light_paths, connections


_UNTRACED = "no light subpath can start from the emitters"


def _why_not(scene, smooth, emitters, depth, needed) -> str:
    """Why no path of ``needed`` edges can be made by joining surfaces; empty if nothing forbids it."""
    if depth < needed:
        return f"max_depth={depth} allows no such path"
    if emitters.count == 0:
        return "the scene has no emitter"
    if not scene.shapes():
        return "the scene has no surface"
    return "" if smooth else "no surface has a lobe that is not delta"


def _why_no_light(emitters, settings: Settings) -> str:
    """Why no path reaches the sensor at all; empty if one may."""
    if settings.max_depth < 1:
        return "max_depth=0 allows no path"
    return "" if emitters.count else "the scene has no emitter"


def _why_not_endpoints(emitters, camera, settings: Settings) -> str:
    """Why (1,1) is impossible; empty if it is not."""
    if not camera.joinable:
        return camera.reason
    if settings.hide_emitters:
        return "hide_emitters: emitters are not seen directly"
    if emitters.count and not emitters.joinable:
        return "no point of the emitters can be joined with the sensor"
    if emitters.count and camera.delta and not emitters.hittable:
        return "delta emitters are not seen by a sensor without area (measure zero)"
    if emitters.count and camera.parallel and not emitters.finite_hittable:
        return "a direction of the surroundings is not that of the sensor's rays (measure zero)"
    return _why_no_light(emitters, settings)


def _why_not_arrival(emitters, camera, settings: Settings) -> str:
    """Why t=0 is impossible; empty if it is not."""
    if not camera.area:
        return camera.no_area
    if settings.hide_emitters and emitters.on_shapes:
        return "hide_emitters: camera rays pass through emitting shapes, which block light subpaths"
    if emitters.count and not emitters.traced:
        return _UNTRACED
    return _why_no_light(emitters, settings)


def scene_bsdfs(scene):
    """The BSDFs of all shapes, those of shape groups included."""
    found = [s.bsdf() for s in scene.shapes()]
    waiting = list(scene.shapes())
    while waiting:
        for value in children(waiting.pop()).values():
            if isinstance(value, mi.BSDF):
                found.append(value)
            elif isinstance(value, mi.Shape):
                waiting.append(value)
    return [b for b in found if b is not None]
