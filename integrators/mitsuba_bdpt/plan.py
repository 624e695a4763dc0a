"""What a render does and does not need: the strategies in use, their counts and coefficients."""

from __future__ import annotations

from dataclasses import dataclass, field

import mitsuba as mi

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
    spp_per_pass: int
    timeout: float


@dataclass(frozen=True)
class Plan:
    """Strategy classes in use for one scene and sensor.

    Classes: ``hit`` s=0, ``direct`` s=1 with t>=2, ``splat`` t=1 with s>=2, ``endpoints`` (1,1),
    ``inner`` s,t>=2. ``served``: camera subpaths per light subpath (S). ``connections``: ``all``,
    ``one`` or ``none``. ``splat_coefficient``: kappa of t=1 over its count. ``roulette``: whether
    small contributions may be dropped before their ray. ``skipped`` explains what is left out.
    """

    hit: bool
    direct: bool
    splat: bool
    endpoints: bool
    connections: str
    served: int
    splat_coefficient: float
    roulette: bool
    hide_emitters: bool
    skipped: tuple = field(default=())

    @property
    def light(self) -> bool:
        """Whether light subpaths are traced at all."""
        return self.splat or self.connections != "none" or self.endpoints


def plan(scene, emitters, camera, settings: Settings) -> Plan:
    """Decide from the scene alone what is impossible, and apply the parameters given by hand."""
    skipped = []

    def skip(name, level, why):
        skipped.append({"class": name, "level": level, "why": why})
        return False

    surfaces = bool(scene.shapes())
    smooth = any(mi.has_flag(b.flags(), mi.BSDFFlags.Smooth) for b in scene_bsdfs(scene))
    depth = settings.max_depth
    hit = emitters.hittable or skip("s=0", "impossible", "no emitter that a ray can hit")
    direct = smooth and emitters.count > 0 and depth >= 2
    if not direct:
        skip("s=1", "impossible", _why_not(surfaces, smooth, emitters, depth, 2))
    splat = smooth and emitters.count > 0 and depth >= 2
    if not splat:
        skip("t=1", "impossible", _why_not(surfaces, smooth, emitters, depth, 2))
    inner = smooth and emitters.count > 0 and depth >= 3
    if not inner:
        skip("inner", "impossible", _why_not(surfaces, smooth, emitters, depth, 3))
    endpoints = emitters.count > 0 and depth >= 1
    if endpoints and settings.hide_emitters:
        endpoints = skip("(1,1)", "impossible", "hide_emitters: emitters are not seen directly")
    elif endpoints and camera.delta and not emitters.hittable:
        endpoints = skip(
            "(1,1)", "impossible", "delta emitters are not seen by a sensor without area (measure zero)"
        )

    light_paths, connections = _defaults(settings)
    if light_paths == 0:
        splat = endpoints = inner = False
        skip("t=1, (1,1), inner", "by hand", "light_paths=0")
    if inner and connections == "none":
        inner = skip("inner", "by hand", "connections=none")
    if light_paths and settings.stored_vertices < min(depth, DEFAULT_STORED):
        skip(
            f"t=1 and inner for paths longer than {settings.stored_vertices} edges",
            "by hand",
            f"stored_vertices={settings.stored_vertices}: such paths use s=0 and s=1",
        )
    return Plan(
        hit=hit,
        direct=direct,
        splat=splat,
        endpoints=endpoints,
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


def _why_not(surfaces, smooth, emitters, depth, needed):
    if depth < needed:
        return f"max_depth={depth} allows no such path"
    if emitters.count == 0:
        return "the scene has no emitter"
    if not surfaces:
        return "the scene has no surface"
    return "no surface has a lobe that is not delta"


def scene_bsdfs(scene):
    """The BSDFs of all shapes, those of shape groups included."""
    found = [s.bsdf() for s in scene.shapes()]

    class Collect(mi.TraversalCallback):
        def put(self, name, value, flags, cpptype=None):
            if isinstance(value, mi.BSDF):
                found.append(value)
            elif isinstance(value, mi.Shape):
                value.traverse(self)

    for shape in scene.shapes():
        shape.traverse(Collect())
    return [b for b in found if b is not None]
