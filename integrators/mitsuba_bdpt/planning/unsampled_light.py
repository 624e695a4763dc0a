"""Estimates the share of an image's light on SDS paths that no strategy samples, or hardly ever.

Through near-specular lobes a few samples find such light: it is *undersampled* if a render expects too few,
see `merging.undersampled`. The estimate merges camera subpaths with as many photons, see `merging.unsampled`.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import drjit as dr
import mitsuba as mi
import numpy as np

from .. import components
from ..errors import listed
from ..host.introspection import all_shapes, named
from ..host.jit import evaluated_mode, gc_paused
from ..host.llvm import quick_compilation
from ..host.notices import warn_once
from ..sampling.points import Points
from ..scene.diagnostics import NAMED
from ..scene.prepared import PreparedScene
from ..settings import Settings
from ..transport import mis
from ..transport.batch import Batch
from ..transport.inputs import TraceContext
from ..transport.photons.aim import Aim
from ..transport.plan import Plan
from ..transport.sds import FEWEST_EDGES
from .moments import FINE, GuidableLight

if TYPE_CHECKING:
    from ..merging import Estimate, Unsampled

# Subpaths from either end: the fewest, the most, and samples of the render per subpath. The noise of the
# estimate suffices for `WARN_SHARE`, not for a figure to rely on; see experiments, "Vertex merging". Few
# photons from infinity meet a small glass: of 2^13, none did for three of eight seeds.
SUBPATHS, MOST_SUBPATHS, SAMPLES_OF_ONE = 1 << 13, 1 << 18, 64

WARN_SHARE = 0.01  # share of an image's light from which on a warning is given

# Least density of a lobe (solid angle) that may leave light undersampled; the estimate is dear beside a short
# render (see experiments, "Near-specular lobes").
VERY_NARROW = 100.0

# Samples per pixel that are assumed of a shorter render, a preview: all of its light is undersampled.
PREVIEW = 64

# Light of which s = 0 has fewer samples in an image, if all of it were like that, is left to vertex merging
# where ``merging=auto`` can choose it; with `WARN_SHARE` of the image's light, photons guide none.
FEWEST_HITS = 16

SEED = 0x6C6F7374

_SMALL_AREA = "give it a small area: an area light on a small sphere or disk"

# What to do about an emitter, by class; else it can be made larger.
_REMEDIES = {
    **dict.fromkeys(("PointLight", "SpotLight", "Projector", "DirectionalArea"), _SMALL_AREA),
    "DirectionalEmitter": "give the sun a disk: sunsky, an envmap, or an area light far away",
}


@dataclass(frozen=True)
class UnsampledLight:
    """Unsampled and undersampled light: mean over the film by emitter index.

    ``objects``: names of the shapes through which most of it is seen, or whose near-specular lobes leave it
    undersampled. ``never``: share of it of which no sample is expected; ``few``: light of up to one expected
    sample per pixel that is not undersampled, relative to it.
    """

    colours: dict[int, np.ndarray]
    objects: tuple[str, ...] = ()
    never: float = 1.0
    few: float = 0.0

    @property
    def radiance(self) -> dict[int, float]:
        """Brightest colour of the sum, divided in proportion to each lamp's brightest."""
        single = {i: float(colour.max()) for i, colour in self.colours.items()}
        brightest = float(sum(self.colours.values()).max()) if single else 0.0
        scale = brightest / max(sum(single.values()), np.finfo(float).tiny)
        return {i: radiance * scale for i, radiance in single.items()}

    def shares(self, mean: float, of_pilot: bool = False) -> dict[int, float]:
        """Shares of the image's light by emitter index.

        ``mean`` of the image's brightest colour; ``of_pilot``: over the colours, a median without rare light.
        """
        radiance = self.radiance
        size = sum(radiance.values())
        if of_pilot:
            intensity = float(sum(colour.mean() for colour in self.colours.values()))
            mean = (mean / intensity + 1 + self.few - self.never) * size
        whole = max(mean + self.never * size, (1 + self.few) * size)
        return {i: each / whole for i, each in radiance.items()}


@dataclass(frozen=True)
class Missing:
    """What a render lacks: ``shares`` of the image's light by emitter index, with cause and remedy."""

    shares: dict[int, float]
    cause: str
    remedy: str

    @property
    def share(self) -> float:
        return sum(self.shares.values())


def missing(
    prepared: PreparedScene, plan: Plan, light: UnsampledLight, shares: dict[int, float], samples: int
) -> Missing:
    """Describe the ``light`` that a render of ``samples`` per pixel lacks, given its `shares`."""
    whole = sum(shares.values())
    order = sorted(shares, key=shares.__getitem__, reverse=True)
    lamps = [prepared.emitters.objects[i] for i in order if shares[i] >= WARN_SHARE * whole]
    undersampled = light.never < 0.5
    if undersampled:
        why = f"in a render of {max(samples, PREVIEW)} samples per pixel most pixels have no sample of it"
    elif plan.splat:
        why = "no ray hits an emitter without area"
    else:
        why = prepared.camera.reason or "the render does without light tracing (t=1)"
    specular = listed(light.objects, NAMED) or "specular surfaces"
    through = f", through or off {specular}" if prepared.delta or prepared.near_specular else ""
    cause = (
        f"{'undersampled' if undersampled else 'not sampled'}, about {min(100 * whole, 99):.2g} % of the "
        f"image's light: that of {_called(lamps)}{through} ({why})"
    )
    by_hand = any(skipped["why"] == "light_paths=0" for skipped in plan.skipped)
    mergeable = not components.merging.why_not(prepared.camera.sensor)
    remedies = ["leave light_paths to the integrator"] * by_hand + ["set merging=true"] * mergeable
    remedies.append(_REMEDIES.get(lamps[0].class_name(), "make the emitter larger"))
    remedies += ["make the surfaces rougher"] * undersampled
    return Missing(shares, cause, ", or ".join(remedies))


def _called(emitters: Iterable[mi.Emitter]) -> str:
    return listed([f"emitter {named(emitter.get_shape() or emitter)}" for emitter in emitters], NAMED)


def is_possible(prepared: PreparedScene, plan: Plan, settings: Settings) -> bool:
    """Whether emitters, surfaces and sensor of the scene allow such paths."""
    traced = prepared.emitters.traced and not prepared.contradiction
    if plan.merging or components.why_absent("merging") or not traced:
        return False
    never = not plan.arrival and (_has_sds_paths(prepared) or (prepared.emitters.beams and not plan.splat))
    return never or is_undersampling_possible(prepared, plan, settings)


def is_undersampling_possible(prepared: PreparedScene, plan: Plan, settings: Settings) -> bool:
    """Whether near-specular lobes, or a sensor that light subpaths must hit, may leave light undersampled."""
    sharp = prepared.narrowest >= VERY_NARROW or (prepared.delta and plan.hit and not plan.guided)
    by_arrival = plan.arrival and _has_sds_paths(prepared)
    return settings.max_depth >= FEWEST_EDGES and ((sharp and prepared.has_small_emitter) or by_arrival)


def _has_sds_paths(prepared: PreparedScene) -> bool:
    """Whether there are SDS paths that s = 0 does not sample: t = 0 alone may."""
    return prepared.delta and prepared.emitters.unhittable


@quick_compilation()
def estimate(
    prepared: PreparedScene, plan: Plan, settings: Settings, samples: int = PREVIEW
) -> UnsampledLight:
    """Estimate the light that a render of ``samples`` per pixel lacks; warns of non-finite emitters."""
    policy = components.merging.Unsampled()
    if is_undersampling_possible(prepared, plan, settings):
        policy = components.merging.Undersampled.of(max(samples, PREVIEW))
    found, lanes = _merged(prepared, plan, settings, samples, policy)
    # In spectral variants the mean over the wavelengths, of which subpaths have different ones.
    total = np.array(found.by_emitter).reshape(prepared.emitters.count, -1) / lanes
    if mi.is_spectral:
        total = np.repeat(total.mean(axis=1, keepdims=True), total.shape[1], axis=1)
    if np.array(found.seen).any():
        total[np.array(found.broken)] = np.nan
    finite = np.isfinite(total).all(axis=1)
    if not finite.all():
        lamps = _called(prepared.emitters.objects[i] for i in np.flatnonzero(~finite))
        where = "in the emitter and in the BSDFs that its light meets"
        text = f"bdpt: how much light of {lamps} is not sampled is unknown, since its estimate is NaN or "
        text += f"infinite; look for such numbers, or very large ones, {where}"
        warn_once(prepared.scene, prepared.camera.sensor, text)
    total = np.where(finite[:, None], total, 0)
    colours = {int(i): total[i] for i in np.flatnonzero(total.any(axis=1))}
    shapes = _brightest(np.array(found.through), np.array(found.size))
    never, rare, few = np.array(policy.sums)
    size = max(never + rare, np.finfo(np.float32).tiny)
    if never < rare:
        meant, everything = {id(bsdf) for bsdf in prepared.near_specular}, all_shapes(prepared.scene)
        seen, others = ([s for s in of if id(s.bsdf()) in meant] for of in (shapes, everything))
        shapes = seen or (shapes if _has_sds_paths(prepared) else others)
    objects = tuple(dict.fromkeys(f"shape {named(shape)}" for shape in shapes))
    return UnsampledLight(colours, objects, float(never / size), float(few / size))


def guidable(prepared: PreparedScene, plan: Plan, settings: Settings, spp: int, fewest: int) -> GuidableLight:
    """SDS light that photons can guide s = 0 to find; ``fewest``: `FEWEST_HITS`, or 0."""
    rarest = fewest / int(prepared.camera.region.size.prod())
    policy = components.merging.Guidable.of(max(spp, PREVIEW), rarest, FINE)
    _, lanes = _merged(prepared, replace(plan, guided=0, merging=False), settings, spp, policy)
    return GuidableLight(*np.array(policy.sums).reshape(FINE**2, -1).T / lanes)


def _merged(
    prepared: PreparedScene, plan: Plan, settings: Settings, samples: int, policy: Unsampled
) -> tuple[Estimate, int]:
    """Merge subpaths; returns the sums, and over how many camera samples they go.

    The kernel computes no weights; its partial sums, of coefficients 1, are numbers of samples.
    """
    pixels = int(prepared.camera.region.size.prod())
    of_render = 1 << (samples * pixels // SAMPLES_OF_ONE).bit_length()
    count = max(SUBPATHS, min(of_render, MOST_SUBPATHS))
    chosen = min(count, pixels)
    batch = Batch(0, chosen, 0, count // chosen, spread=pixels)
    sharp = policy.only_specular < math.inf
    with gc_paused(), evaluated_mode(prepared.emitters.evaluated):
        plan = replace(plan, kappa_light=1.0, kappa_direct=1.0)
        kernel = TraceContext(prepared, plan, settings, mis.Heuristic("balance"))
        traits = prepared.traits if sharp else prepared.traits.of_delta_lobes()
        kernel = kernel.replaced(traits=traits, last_merged=kernel.max_depth)
        aim = Aim.of(prepared.scene, kernel.emitters, prepared.near_specular if sharp else ())
        drawn = (Points(kind, dr.opaque(mi.UInt32, SEED)) for kind in ("sobol", "independent"))
        return components.merging.estimate(kernel, batch, count, *drawn, aim, policy), batch.size


def _brightest(shapes: np.ndarray, found: np.ndarray) -> list[mi.Shape]:
    """At most `NAMED` of the ``shapes``, by index, through which most of ``found`` is seen."""
    amounts = np.bincount(shapes, np.where(np.isfinite(found), found, 0))
    order = [int(i) for i in np.argsort(-amounts) if i and amounts[i] > WARN_SHARE * amounts.sum()]
    return [dr.reinterpret_array(mi.ShapePtr, mi.UInt32(i))[0] for i in order[:NAMED]]
