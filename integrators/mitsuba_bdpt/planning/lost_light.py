"""Estimates the share of an image's light on SDS paths that no strategy samples.

Such a path leaves a delta emitter, passes delta surfaces, one diffuse or glossy surface, delta surfaces, and
reaches the sensor; no two neighbouring vertices can be connected. `possible.unsampled_paths` decides
whether such paths are possible. The estimate merges a few thousand camera subpaths with as many photons, see
`merging.unsampled` for what it leaves out, and lamps seen in a mirror.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import drjit as dr
import mitsuba as mi
import numpy as np

from .. import components
from ..host.jit import evaluated_mode, gc_paused
from ..host.notices import warn_once
from ..sampling.points import Points
from ..scene.prepared import PreparedScene
from ..settings import Settings
from ..transport import mis
from ..transport.batch import Batch
from ..transport.inputs import Kernel
from ..transport.plan import Plan
from .possible import Start, unsampled_paths

# Subpaths from either end. The noise of the estimate suffices for `WORTH_A_WORD`, not for a figure to rely
# on; see experiments, "Vertex merging".
SUBPATHS = 1 << 13

# Share of an image's light from which on a warning is given.
WORTH_A_WORD = 0.01

# Most lamps named in a message.
NAMED = 3

SEED = 0x6C6F7374

_PLUGINS = {
    "PointLight": "point light",
    "SpotLight": "spot",
    "Projector": "projector",
    "DirectionalEmitter": "directional light",
    "DirectionalArea": "directionalarea",
}


@dataclass(frozen=True)
class LostLight:
    """Unsampled light: mean over the film by emitter index.

    ``through``: ids of the shapes through which most of it is seen, the brightest first.
    """

    colours: dict[int, np.ndarray]
    through: tuple[str, ...] = ()

    @property
    def radiance(self) -> dict[int, float]:
        """Brightest colour of the sum, divided in proportion to each lamp's brightest."""
        single = {i: float(colour.max()) for i, colour in self.colours.items()}
        brightest = float(sum(self.colours.values()).max()) if single else 0.0
        scale = brightest / max(sum(single.values()), np.finfo(float).tiny)
        return {i: radiance * scale for i, radiance in single.items()}

    @property
    def intensity(self) -> float:
        """Mean over the colours, the measure of images in pilots."""
        return float(sum(colour.mean() for colour in self.colours.values()))


def is_possible(prepared: PreparedScene, plan: Plan, settings: Settings) -> bool:
    """Whether emitters, surfaces and sensor of the scene allow such paths."""
    if plan.arrival or not prepared.emitters.traced:  # the estimate traces light subpaths
        return False
    if prepared.light_media is not None and prepared.light_media.contradiction:  # it would see another scene
        return False
    if plan.merging:  # which samples these paths
        return False
    if components.why_absent("merging"):  # which estimates their light
        return False
    lost = unsampled_paths(prepared, plan, settings)  # light without a vertex in between: `missed_direct`
    return any(Start.DIRECT_DELTA_EMITTER not in paths.starts for paths in lost)


def estimate(prepared: PreparedScene, plan: Plan, settings: Settings) -> LostLight:
    """Estimate the unsampled light.

    Skips emitters whose estimate or photons are non-finite and warns; the render itself may not meet that
    value.
    """
    pixels = int(prepared.camera.region.size.prod())
    chosen = min(SUBPATHS, pixels)
    batch = Batch(0, chosen, 0, SUBPATHS // chosen, spread=pixels)
    with gc_paused(), evaluated_mode(prepared.emitters.evaluated):
        kernel = delta_kernel(prepared, plan, settings)
        found = components.merging.estimate(kernel, batch, SUBPATHS, points("sobol"), points("independent"))
    # In spectral variants the mean over the wavelengths, of which subpaths have different ones.
    total = np.array(found.by_emitter).reshape(len(prepared.scene.emitters()), -1) / batch.size
    if mi.is_spectral:
        total = np.repeat(total.mean(axis=1, keepdims=True), total.shape[1], axis=1)
    if np.array(found.seen).any():
        total[np.array(found.broken)] = np.nan
    finite = np.isfinite(total).all(axis=1)
    if not finite.all():
        _warn_of_not_finite(prepared, np.flatnonzero(~finite))
    total = np.where(finite[:, None], total, 0)
    colours = {int(i): total[i] for i in np.flatnonzero(total.any(axis=1))}
    return LostLight(colours, _ids(np.array(found.through), np.array(found.size)))


def delta_kernel(prepared: PreparedScene, plan: Plan, settings: Settings) -> Kernel:
    """A kernel whose subpaths follow delta lobes only; weights are not computed."""
    kernel = Kernel(prepared, plan, settings, mis.Heuristic("balance"))
    kernel.reverse, kernel.traits = False, prepared.traits.of_delta_lobes()
    kernel.last_light = kernel.last_arrival = kernel.max_depth
    return kernel


def points(kind: str) -> Points:
    """Random numbers of an estimate, the same for all renders."""
    return Points(kind, dr.opaque(mi.UInt32, SEED))


def _ids(shapes: np.ndarray, found: np.ndarray) -> tuple[str, ...]:
    """Ids of at most `NAMED` ``shapes`` through which most of ``found`` is seen."""
    amounts = np.bincount(shapes, np.where(np.isfinite(found), found, 0))
    order = [i for i in np.argsort(-amounts) if i and amounts[i] > WORTH_A_WORD * amounts.sum()]
    names = [dr.reinterpret_array(mi.ShapePtr, mi.UInt32(int(i)))[0].id() for i in order[:NAMED]]
    # Shapes without an id, and merged shapes, have none or one made up by Mitsuba.
    return tuple(name for name in names if name and not name.startswith("_unnamed_"))


def _warn_of_not_finite(prepared: PreparedScene, indices: np.ndarray):
    """Warn of emitters whose unsampled light cannot be estimated."""
    emitters = prepared.scene.emitters()
    lamps = " and ".join(called(emitters[i]) for i in indices[:NAMED])
    text = (
        f"bdpt: how much light of {lamps} is not sampled is unknown, since its estimate is NaN or infinite; "
        "look for such numbers, or very large ones, in the lamp and in the BSDFs that its light meets"
    )
    warn_once(prepared.scene, prepared.camera.sensor, text)


def shares(lost: LostLight, mean: float) -> dict[int, float]:
    """Shares of the image's light by emitter index.

    ``mean`` of the image's brightest colour.
    """
    whole = mean + sum(lost.radiance.values())
    return {i: radiance / whole for i, radiance in lost.radiance.items()}


def predicted_shares(lost: LostLight, mean: float) -> dict[int, float]:
    """`shares` before the first pass, from the ``mean`` intensity of a pilot.

    Empty if their sum is below twice `WORTH_A_WORD`: a pilot's estimate may be twice too large.
    """
    share = lost.intensity / (mean + lost.intensity)
    if not share >= 2 * WORTH_A_WORD:
        return {}
    whole = sum(lost.radiance.values())
    return {i: share * radiance / whole for i, radiance in lost.radiance.items()}


def in_words(prepared: PreparedScene, plan: Plan, shares: dict[int, float], through: Iterable[str]) -> str:
    """Warning about unsampled light with its remedy; empty below `WORTH_A_WORD`.

    ``shares`` of the image's light by emitter index; ``through``: see `LostLight`.
    """
    lost = sum(shares.values())
    if not lost >= WORTH_A_WORD:
        return ""
    emitters = prepared.scene.emitters()
    order = sorted(shares, key=shares.get, reverse=True)
    lamps = [emitters[i] for i in order if shares[i] >= WORTH_A_WORD * lost][:NAMED]
    what = " and ".join(map(called, lamps)) + (" shine" if len(lamps) > 1 else " shines")
    what += " through glass or mirrors" if prepared.delta else " on what is seen"
    why, remedy = "no ray hits a lamp without area", _remedy(prepared, lamps)
    if plan.splat:
        what += f" on what is seen through {' and '.join(map(repr, through)) or 'them'}"
    elif not prepared.camera.connectible:
        why = f"no light can be traced to the sensor: {prepared.camera.reason}"
    else:
        why = "the render does without light tracing (t=1)"
        remedy = f"leave light_paths and decisions to the integrator, or {remedy}"
    share = "nearly all" if lost > 0.99 else f"about {100 * lost:.0f} %"
    return f"bdpt: not sampled, {share} of the image's light: {what} ({why}); {remedy}"


def called(emitter: mi.Emitter) -> str:
    """Name an emitter by its kind and nearest id."""
    kind, shape = _PLUGINS.get(emitter.class_name(), "emitter"), emitter.get_shape()
    if emitter.id():
        return f"{kind} '{emitter.id()}'"
    on_shape = shape is not None and shape.id()
    return f"the {kind} on shape '{shape.id()}'" if on_shape else f"a {kind} without id"


def _remedy(prepared: PreparedScene, emitters: Iterable[mi.Emitter]) -> str:
    remedy = "give it a small area: an area light on a small sphere or disk"
    if any(emitter.class_name() == "DirectionalEmitter" for emitter in emitters):
        remedy = "give the sun a disk: sunsky, an envmap, or an area light far away"
    return remedy if prepared.space is not None else f"set merging=true, or {remedy}"
