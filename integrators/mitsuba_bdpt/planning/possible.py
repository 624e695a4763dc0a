"""The strategies that the scene and the parameters allow: the `Plan`."""

from __future__ import annotations

import mitsuba as mi
import numpy as np

from .. import components
from ..geometry.boxes import scene_box
from ..host.introspection import world_matrix
from ..scene.prepared import PreparedScene
from ..settings import Settings
from ..transport.plan import GUIDED_SAMPLES, Plan
from ..transport.sds import FEWEST_EDGES
from .budget import EVEN


def plan(prepared: PreparedScene, settings: Settings) -> Plan:
    """Rule out impossible strategies and apply parameters set by hand."""
    emitters, camera, depth = prepared.emitters, prepared.camera, settings.max_depth
    skipped: list[dict[str, str]] = []

    def possible(name: str, why: str, level: str = "impossible") -> bool:
        """Whether there is no reason against a class; a reason is noted."""
        if why:
            skipped.append({"class": name, "level": level, "why": why})
        return not why

    unconnected, untraced = _why_no_path(prepared, depth, 2), "" if emitters.traced else _UNTRACED
    hit = possible("s=0", "" if emitters.hittable else "no emitter that a ray can hit")
    no_choice = "" if emitters.direct else "next-event estimation can choose no emitter"
    direct = possible("s=1", unconnected or no_choice)
    splat = possible("t=1", unconnected or camera.reason or untraced)
    inner = possible("inner", _why_no_path(prepared, depth, 3) or untraced)
    endpoints = possible("(1,1)", _why_not_endpoints(prepared, settings))
    arrival = possible("t=0", _why_not_arrival(prepared, settings))
    merging = settings.merging is True and possible("merging", _why_not_merging(prepared, direct))
    why = _why_not_guided(prepared, settings, hit, direct)
    if settings.guiding == "always":
        possible("guided s=0", why)
    guidable = not why
    if merging:  # a pilot may choose not to merge where s = 0 samples that light too
        guidable = guidable and not (emitters.unhittable or prepared.near_specular)
    elif guidable and settings.guiding in ("emission", "never"):
        guidable = possible("guided s=0", f"guiding={settings.guiding}", BY_HAND)
    for name, why in emitters.left_out:
        possible(name, why)

    everything, (light_paths, connections) = settings.skip == "none", _light_paths(settings)
    traced = possible(_ALL_LIGHT, "" if light_paths else "light_paths=0", BY_HAND)
    traced = traced and possible(_ALL_LIGHT, prepared.contradiction)
    splat, endpoints, arrival, inner = (each and traced for each in (splat, endpoints, arrival, inner))
    if inner and connections == "none":
        inner = possible("inner", "connections=none", BY_HAND)
    light = teachable = splat or endpoints or arrival or inner
    if light and settings.guiding in ("photons", "never"):
        teachable = possible("guided emission", f"guiding={settings.guiding}", BY_HAND)
    elif light:
        why = components.why_absent("guided_emission") or components.guided_emission.why_not(emitters)
        teachable = possible("guided emission", why)
    return Plan(
        hit=hit,
        direct=direct,
        splat=splat,
        endpoints=endpoints,
        arrival=arrival,
        connections=connections if inner else "none",
        camera_paths_per_light_path=round(1 / light_paths) if light else 1,
        kappa_light=1.0 if everything else 0.25,
        kappa_direct=1.0,
        roulette=not everything and not settings.strategy_images,
        hide_emitters=settings.hide_emitters,
        skipped=tuple(skipped),
        merging=merging,
        guided=GUIDED_SAMPLES if guidable and not merging and settings.guiding == "always" else 0,
        guidable=guidable,
        teachable=teachable,
    )


def _light_paths(settings: Settings) -> tuple[float, str]:
    """Light subpaths per camera subpath, and connections, without a decision of a pilot."""
    everything = settings.skip == "none"
    light_paths, connections = settings.light_paths, settings.connections
    if isinstance(light_paths, str):  # "auto"
        light_paths = 1 if everything else 1 / 4
    if connections == "auto":
        connections = "all" if everything else "one"
    if settings.strategy_images and connections == "one":
        connections = "all"  # a drawn connection does not estimate each strategy
    return light_paths, connections


_UNTRACED = "no light subpath can start from the emitters"
_ALL_LIGHT = "t=0, t=1, (1,1), inner"
BY_HAND = "by hand"


def _why_no_path(prepared: PreparedScene, depth: int, needed: int = 1) -> str:
    """Why no path has ``needed`` edges, empty if one may; from 2 on it is connected at a vertex."""
    if depth < needed:
        return f"max_depth={depth} allows no such path"
    if prepared.emitters.count == 0:
        return "the scene has no emitter"
    if needed == 1 or (prepared.space is not None and prepared.space.media.scatters):
        return ""
    if not prepared.surfaces:
        return "the scene has no surface"
    return "" if prepared.smooth else "no surface has a lobe that is not delta"


def _why_not_endpoints(prepared: PreparedScene, settings: Settings) -> str:
    """Why (1,1) is impossible; empty if it is possible."""
    emitters, camera = prepared.emitters, prepared.camera
    if camera.reason:
        return camera.reason
    if settings.hide_emitters:
        return "hide_emitters: emitters are not seen directly"
    if emitters.count and not emitters.connectible_to_sensor:
        return "no point of the emitters can be connected with the sensor"
    if emitters.count and camera.delta and not emitters.hittable:
        return "delta emitters are not seen by a pinhole (delta) sensor (measure zero)"
    if emitters.count and camera.parallel and not emitters.finite_hittable:
        return "a direction of the surroundings is not that of the sensor's rays (measure zero)"
    return _why_no_path(prepared, settings.max_depth)


def _why_not_arrival(prepared: PreparedScene, settings: Settings) -> str:
    """Why t=0 is impossible; empty if it is possible."""
    emitters, camera = prepared.emitters, prepared.camera
    if camera.no_area:
        return camera.no_area
    if settings.hide_emitters and emitters.on_shapes:
        return "hide_emitters: camera rays pass through emitting shapes, which block light subpaths"
    if emitters.count and not emitters.traced:
        return _UNTRACED
    media = None if prepared.space is None else prepared.space.media
    if media is not None and (media.coloured_grids or (media.grids and not media.gray)):
        return "what a flight through a grid carries of each colour is known at its end, not at the sensor"
    if media is not None and emitters.at_infinity and _reaches_behind(prepared, camera.sensor):
        return "what lies behind the far plane meets light from infinity, but no camera ray"
    return _why_no_path(prepared, settings.max_depth)


def _why_not_merging(prepared: PreparedScene, direct: bool) -> str:
    """Why no vertex can be merged, or empty; ``direct``: next-event estimation is possible."""
    emitters = prepared.emitters
    if not emitters.traced:
        return _UNTRACED
    if prepared.contradiction:
        return prepared.contradiction
    if emitters.contrast <= EVEN:
        return "s=0 finds a uniform environment by itself"
    if direct and not (prepared.delta or prepared.near_specular or emitters.beams):
        return "without specular surfaces next-event estimation connects all that light meets first"
    return ""


def _why_not_guided(prepared: PreparedScene, settings: Settings, hit: bool, direct: bool) -> str:
    """Why s = 0 cannot be guided, or does not gain by it; empty if neither."""
    if prepared.space is not None:
        return "photons in scenes with participating media are not traced"
    if settings.strategy_images:
        return "strategy images show each strategy by itself, and it is another s=0"
    if not hit:
        return "no emitter that a ray can hit"
    if settings.max_depth < FEWEST_EDGES:
        return f"max_depth={settings.max_depth} allows no such path"
    return _why_not_merging(prepared, direct)


def _reaches_behind(prepared: PreparedScene, sensor: mi.Sensor) -> bool:
    """Whether the scene's box extends behind the far plane of the sensor, if any."""
    if not isinstance(sensor, mi.ProjectiveCamera) or not prepared.surfaces:
        return False
    box, to_world = scene_box(prepared.scene, prepared.facts.about), world_matrix(sensor)
    corners = np.array([[*box.corner(i)] for i in range(8)], dtype=np.float64).reshape(8, 3)
    forwards, origin = to_world[:3, 2:].T
    return bool(((corners - origin) @ forwards / np.linalg.norm(forwards) > sensor.far_clip()).any())


def unsampled_paths(prepared: PreparedScene, p: Plan, settings: Settings) -> tuple[str, ...]:
    """Paths that no strategy in use samples, from the emitter to the sensor, and what they need."""
    starts, found = _unsampled_starts(prepared), list[str]()
    if not (p.arrival or p.merging):  # t = 0 samples all paths, merging those with a vertex that is not delta
        for start in starts:
            if not p.splat:
                found.append(f"{start} - one non-specular vertex - sensor (needs t=1)")
            if p.connections == "none":
                rest = "two or more non-specular vertices - specular or nothing - sensor"
                found.append(f"{start} - {rest} (needs inner connections)")
        if prepared.delta and prepared.emitters.unhittable:
            rest = "one non-specular vertex - specular - sensor"
            found.append(f"delta emitter - specular - {rest} (SDS: no connectible edge)")
    return (*found, *unsampled_at_sensor(prepared, p, settings))


def unsampled_at_sensor(prepared: PreparedScene, p: Plan, settings: Settings) -> list[str]:
    """`unsampled_paths` without a vertex between emitter, delta surfaces and a sensor with area."""
    if p.arrival or prepared.camera.delta:
        return []
    starts = _unsampled_starts(prepared)
    found = [f"{' or '.join(starts)} - sensor (needs t=0)"] if starts else []
    # With hide_emitters this light is hidden on purpose.
    direct = prepared.emitters.unhittable_connectible and not settings.hide_emitters
    if direct and not p.endpoints and settings.max_depth:
        found.append("delta emitter - sensor (needs (1,1))")
    return found


def _unsampled_starts(prepared: PreparedScene) -> list[str]:
    """Starts of paths that camera subpaths sample neither by a hit nor by next event."""
    deltas, beams = prepared.delta and prepared.emitters.unhittable, prepared.emitters.beams
    return ["delta emitter - specular"] * deltas + ["directionalarea"] * beams
