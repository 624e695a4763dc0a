"""Estimates the share of an image's light on SDS paths that no strategy samples, or hardly ever.

Such a path leaves a delta emitter, passes delta surfaces, one diffuse or glossy surface, delta surfaces, and
reaches the sensor; no two neighbouring vertices can be connected. `possible.unsampled_paths` decides
whether such paths are possible. Through near-specular lobes in place of delta lobes a few samples find such
light: it is *undersampled* if a render expects too few of them, see `merging.undersampled`. The estimate
merges camera subpaths with as many photons, see `merging.unsampled` for what it leaves out,
and lamps seen in a mirror.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace

import drjit as dr
import mitsuba as mi
import numpy as np

from .. import components
from ..host.introspection import all_shapes, given_id
from ..host.jit import evaluated_mode, gc_paused
from ..host.notices import warn_once
from ..sampling.points import Points
from ..scene.prepared import PreparedScene
from ..settings import Settings
from ..transport import mis
from ..transport.batch import Batch
from ..transport.inputs import Kernel
from ..transport.photons.aim import Aim
from ..transport.plan import Plan
from .possible import SHORTEST, Start, unsampled_paths

# Subpaths from either end: the fewest, the most, and samples of the render per subpath. The noise of the
# estimate suffices for `WARN_SHARE`, not for a figure to rely on; see experiments, "Vertex merging". Few
# photons from infinity meet a small glass: of 2^13, none did for three of eight seeds.
SUBPATHS, MOST_SUBPATHS, SAMPLES_OF_ONE = 1 << 13, 1 << 18, 64

# Share of an image's light from which on a warning is given.
WARN_SHARE = 0.01

# Least density of a lobe (solid angle) that may leave light undersampled; the estimate is dear beside a short
# render (see experiments, "Near-specular lobes").
NARROW = 100.0

# Samples per pixel that are assumed of a shorter render, a preview: all of its light is undersampled.
PREVIEW = 64

# Most lamps named in a message.
NAMED = 3

SEED = 0x6C6F7374

# Key under which dictionaries hold the BSDF of a shape, its id there.
_KEY = "bsdf"

_PLUGINS = {
    "PointLight": "point light",
    "SpotLight": "spot",
    "Projector": "projector",
    "DirectionalEmitter": "directional light",
    "DirectionalArea": "directionalarea",
}


@dataclass(frozen=True)
class UnsampledLight:
    """Unsampled and undersampled light: mean over the film by emitter index.

    ``through``: names of the shapes through which most of it is seen, the brightest first. In scenes with
    near-specular lobes ``never``: share of it of which no sample is expected; ``few``: light of which more
    samples are expected, but few, over it; ``sharp``: names of the objects with such lobes through which it
    is seen; of all if it is seen through none.
    """

    colours: dict[int, np.ndarray]
    through: tuple[str, ...] = ()
    never: float = 1.0
    few: float = 0.0
    sharp: tuple[str, ...] = ()

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

    @property
    def is_undersampled(self) -> bool:
        """Whether a few samples are expected of most of it."""
        return self.never < 0.5


def is_possible(prepared: PreparedScene, plan: Plan, settings: Settings) -> bool:
    """Whether emitters, surfaces and sensor of the scene allow such paths."""
    if not prepared.emitters.traced:  # the estimate traces light subpaths
        return False
    if prepared.light_media is not None and prepared.light_media.contradiction:  # it would see another scene
        return False
    if plan.merging or components.why_absent("merging"):  # which samples or estimates it
        return False
    if is_undersampling_possible(prepared, plan, settings):
        return True
    # Light without a vertex in between: see `messages.warn_of_missing_direct`.
    unsampled = () if plan.arrival else unsampled_paths(prepared, plan, settings)
    return any(Start.DIRECT_DELTA_EMITTER not in paths.starts for paths in unsampled)


def is_undersampling_possible(prepared: PreparedScene, plan: Plan, settings: Settings) -> bool:
    """Whether near-specular lobes, or a sensor that light subpaths must hit, may leave light undersampled."""
    narrow = prepared.narrowest >= NARROW and prepared.has_small_emitter
    return settings.max_depth >= SHORTEST and (narrow or _is_left_to_arrival(prepared, plan))


def _is_left_to_arrival(prepared: PreparedScene, plan: Plan) -> bool:
    """Whether t = 0 alone samples SDS paths."""
    emitters = prepared.emitters
    return plan.arrival and prepared.delta and bool(emitters.unhittable or emitters.beams)


def key(prepared: PreparedScene, plan: Plan, settings: Settings, samples: int) -> tuple:
    """All that the estimate for a render of ``samples`` per pixel depends on besides the scene."""
    known = plan.splat, plan.direct, settings.max_depth, settings.hide_emitters, _subpaths(prepared, samples)
    if not is_undersampling_possible(prepared, plan, settings):
        return known
    strategies = plan.arrival, plan.endpoints, plan.connections, plan.joined, plan.camera_paths_per_light_path
    return *known, *strategies, plan.emission is None, plan.guided > 0, max(samples, PREVIEW)


def estimate(
    prepared: PreparedScene, plan: Plan, settings: Settings, samples: int = PREVIEW
) -> UnsampledLight:
    """Estimate the light that a render of ``samples`` per pixel lacks.

    Skips emitters whose estimate or photons are non-finite and warns; the render itself may not meet that
    value.
    """
    pixels, count = int(prepared.camera.region.size.prod()), _subpaths(prepared, samples)
    chosen = min(count, pixels)
    batch = Batch(0, chosen, 0, count // chosen, spread=pixels)
    with gc_paused(), evaluated_mode(prepared.emitters.evaluated):
        undersampled = is_undersampling_possible(prepared, plan, settings)
        kernel = (counting_kernel if undersampled else delta_kernel)(prepared, plan, settings)
        aim = Aim.of(prepared.scene, kernel.emitters, prepared.near_specular if undersampled else ())
        drawn = points("sobol"), points("independent")
        of = max(samples, PREVIEW) if undersampled else None
        found = components.merging.estimate(kernel, batch, count, *drawn, aim, of)
    # In spectral variants the mean over the wavelengths, of which subpaths have different ones.
    total = np.array(found.by_emitter).reshape(prepared.emitters.count, -1) / batch.size
    if mi.is_spectral:
        total = np.repeat(total.mean(axis=1, keepdims=True), total.shape[1], axis=1)
    if np.array(found.seen).any():
        total[np.array(found.broken)] = np.nan
    finite = np.isfinite(total).all(axis=1)
    if not finite.all():
        _warn_of_not_finite(prepared, np.flatnonzero(~finite))
    total = np.where(finite[:, None], total, 0)
    colours = {int(i): total[i] for i in np.flatnonzero(total.any(axis=1))}
    shapes = _brightest(np.array(found.through), np.array(found.size))
    through = _names(shapes)
    if found.kinds is None or not colours:
        return UnsampledLight(colours, through)
    never, rare, few = np.array(found.kinds)
    size = max(never + rare, np.finfo(np.float32).tiny)
    meant = {id(bsdf) for bsdf in prepared.near_specular}
    seen, others = ([s for s in of if id(s.bsdf()) in meant] for of in (shapes, all_shapes(prepared.scene)))
    sharp = seen if _is_left_to_arrival(prepared, plan) else seen or others
    return UnsampledLight(colours, through, float(never / size), float(few / size), _names(sharp)[:NAMED])


def _subpaths(prepared: PreparedScene, samples: int) -> int:
    """Number of subpaths from either end, for a render of ``samples`` per pixel: a power of 2."""
    whole = samples * int(prepared.camera.region.size.prod())
    return max(SUBPATHS, min(1 << (whole // SAMPLES_OF_ONE).bit_length(), MOST_SUBPATHS))


def delta_kernel(prepared: PreparedScene, plan: Plan, settings: Settings) -> Kernel:
    """A kernel whose subpaths follow delta lobes only; weights are not computed."""
    kernel = Kernel(prepared, plan, settings, mis.Heuristic("balance"))
    kernel.reverse, kernel.traits = False, prepared.traits.of_delta_lobes()
    kernel.last_light = kernel.last_arrival = kernel.last_merged = kernel.max_depth
    return kernel


def counting_kernel(prepared: PreparedScene, plan: Plan, settings: Settings) -> Kernel:
    """A kernel whose partial sums are those of numbers of samples: coefficients that are counts."""
    counts = replace(plan, kappa_light=1.0, kappa_direct=1.0)
    kernel = Kernel(prepared, counts, settings, mis.Heuristic("balance"))
    kernel.reverse, kernel.traits = True, prepared.traits
    kernel.last_light = kernel.last_arrival = kernel.last_merged = kernel.max_depth
    return kernel


def points(kind: str) -> Points:
    """Random numbers of an estimate, the same for all renders."""
    return Points(kind, dr.opaque(mi.UInt32, SEED))


def _brightest(shapes: np.ndarray, found: np.ndarray) -> list[mi.Shape]:
    """At most `NAMED` of the ``shapes``, by index, through which most of ``found`` is seen."""
    amounts = np.bincount(shapes, np.where(np.isfinite(found), found, 0))
    order = [i for i in np.argsort(-amounts) if i and amounts[i] > WARN_SHARE * amounts.sum()]
    return [dr.reinterpret_array(mi.ShapePtr, mi.UInt32(int(i)))[0] for i in order[:NAMED]]


def _names(shapes: Iterable[mi.Shape]) -> tuple[str, ...]:
    """Names of the ``shapes`` that have one, once each."""
    return tuple(dict.fromkeys(filter(None, map(_called_shape, shapes))))


def _called_shape(shape: mi.Shape) -> str:
    """Name a shape by its id and that of its BSDF; empty if neither has one."""
    bsdf = shape.bsdf()
    name = "" if bsdf is None else given_id(bsdf)
    if given_id(shape):
        return f"'{shape.id()}'" + (f" (BSDF '{name}')" if name not in ("", _KEY) else "")
    if not name:
        return ""
    if shape.class_name() == "Mesh":
        merged = "Mitsuba merges meshes of a BSDF unless optimize=False"
        return f"meshes without id (BSDF '{name}', {bsdf.class_name()}; {merged})"
    return f"a {shape.class_name().lower()} without id (BSDF '{name}')"


def _warn_of_not_finite(prepared: PreparedScene, indices: np.ndarray):
    """Warn of emitters whose unsampled light cannot be estimated."""
    emitters = prepared.emitters.objects
    lamps = " and ".join(called(emitters[i]) for i in indices[:NAMED])
    text = (
        f"bdpt: how much light of {lamps} is not sampled is unknown, since its estimate is NaN or infinite; "
        "look for such numbers, or very large ones, in the lamp and in the BSDFs that its light meets"
    )
    warn_once(prepared.scene, prepared.camera.sensor, text)


def shares(unsampled: UnsampledLight, mean: float) -> dict[int, float]:
    """Shares of the image's light by emitter index.

    ``mean`` of the image's brightest colour, which includes light that is not absent.
    """
    size = sum(unsampled.radiance.values())
    whole = max(mean + unsampled.never * size, size)
    return {i: radiance / whole for i, radiance in unsampled.radiance.items()}


def predicted_shares(unsampled: UnsampledLight, mean: float) -> dict[int, float]:
    """`shares` before the first pass, from the ``mean`` intensity of a pilot, a median without rare light."""
    share = unsampled.intensity / (mean + (1 + unsampled.few) * unsampled.intensity)
    whole = sum(unsampled.radiance.values())
    return {i: share * radiance / whole for i, radiance in unsampled.radiance.items()}


def in_words(
    prepared: PreparedScene, plan: Plan, shares: dict[int, float], unsampled: UnsampledLight, samples: int
) -> str:
    """Warning about unsampled light with its remedy; empty where it is not worth a word.

    ``shares`` of the image's light by emitter index, in a render of ``samples`` per pixel.
    """
    all_of_it = sum(shares.values())
    if all_of_it < WARN_SHARE:
        return ""
    cause, remedy = _in_words(prepared, plan, shares, unsampled, samples, _share(all_of_it))
    return f"bdpt: {cause}; {remedy}"


def _share(share: float) -> str:
    return ("nearly all" if share > 0.99 else f"about {100 * share:.0f} %") + " of the image's light"


def reason(
    prepared: PreparedScene, plan: Plan, shares: dict[int, float], unsampled: UnsampledLight, samples: int
) -> str:
    """Why light with these ``shares`` is merged; arguments as of `in_words`."""
    cause, _ = _in_words(prepared, plan, shares, unsampled, samples, _share(sum(shares.values())))
    return f"without it {cause}"


def explained(
    prepared: PreparedScene,
    plan: Plan,
    unsampled: UnsampledLight,
    samples: int,
    shares: dict[int, float] | None,
) -> str:
    """`in_words` of light of any share; its radiance if the ``shares`` are not known."""
    parts = unsampled.radiance if shares is None else shares
    all_of_it = sum(parts.values())
    share = f"light of mean radiance {all_of_it:.2g}"
    if shares is not None:
        share = f"{max(100 * all_of_it, 0.01):.2g} % of the image's light"
    cause, remedy = _in_words(prepared, plan, parts, unsampled, samples, share)
    return f"bdpt: {cause}; {remedy}"


def _in_words(
    prepared: PreparedScene,
    plan: Plan,
    parts: dict[int, float],
    unsampled: UnsampledLight,
    samples: int,
    share: str,
) -> tuple[str, str]:
    """What is lacking of this ``share`` and why, and the remedy; ``parts`` of it by emitter index."""
    emitters = prepared.emitters.objects
    order = sorted(parts, key=parts.__getitem__, reverse=True)
    least = WARN_SHARE * sum(parts.values())
    lamps = [emitters[i] for i in order if parts[i] >= least][:NAMED]
    what = " and ".join(map(called, lamps)) + (" shine" if len(lamps) > 1 else " shines")
    if unsampled.is_undersampled:
        remedy = _remedy(prepared, lamps)
        if any(skipped["why"] == "light_paths=0" for skipped in plan.skipped):  # no pilot's choice
            remedy = f"leave light_paths to the integrator, {remedy}"
        by_arrival = _is_left_to_arrival(prepared, plan)
        cause, remedy = _undersampled(what, unsampled, samples, remedy, by_arrival)
        return f"undersampled, {share}: {cause}", remedy
    what += " through glass or mirrors" if prepared.delta else " on what is seen"
    why, remedy = "no ray hits a lamp without area", _remedy(prepared, lamps)
    if plan.splat:
        what += f" on what is seen through {' and '.join(unsampled.through) or 'them'}"
    elif not prepared.camera.connectible:
        why = f"no light can be traced to the sensor: {prepared.camera.reason}"
    else:
        why = "the render does without light tracing (t=1)"
        remedy = f"leave light_paths to the integrator, or {remedy}"
    return f"not sampled, {share}: {what} ({why})", remedy


def _undersampled(
    what: str, unsampled: UnsampledLight, samples: int, remedy: str, by_arrival: bool
) -> tuple[str, str]:
    """Cause and remedy of light of which a few samples are expected; ``by_arrival``: by t = 0 alone."""
    why = f"in a render of {max(samples, PREVIEW)} samples per pixel most pixels have no sample of it"
    objects = " and ".join(unsampled.sharp)
    if by_arrival and not objects:
        through = " and ".join(unsampled.through) or "glass or mirrors"
        return f"{what} on what is seen through {through}; few light subpaths hit the sensor ({why})", remedy
    off = f"off {objects}, whose narrow lobes" if objects else "off surfaces whose narrow lobes"
    rougher = f"or make the {'surface' if len(unsampled.sharp) == 1 else 'surfaces'} rougher"
    return f"{what} through or {off} connections rarely sample ({why})", f"{remedy}, {rougher}"


def called(emitter: mi.Emitter) -> str:
    """Name an emitter by its kind and nearest id."""
    kind, shape = _PLUGINS.get(emitter.class_name(), "emitter"), emitter.get_shape()
    on_shape = shape is not None and given_id(shape)
    if emitter.class_name() == "AreaLight":  # its id says little: a dictionary's key
        return (
            f"the area light on shape '{shape.id()}'" if on_shape else "an area light on a shape without id"
        )
    if emitter.id():
        return f"{kind} '{emitter.id()}'"
    return f"the {kind} on shape '{shape.id()}'" if on_shape else f"a {kind} without id"


def _remedy(prepared: PreparedScene, emitters: Iterable[mi.Emitter]) -> str:
    emitters = list(emitters)
    remedy = "give it a small area: an area light on a small sphere or disk"
    if not any(emitter.class_name() in _PLUGINS for emitter in emitters):
        remedy = "make the emitter larger"
    if any(emitter.class_name() == "DirectionalEmitter" for emitter in emitters):
        remedy = "give the sun a disk: sunsky, an envmap, or an area light far away"
    media = prepared.space is not None
    mergeable = not components.merging.why_not(prepared.camera.sensor, media)
    return f"set merging=true, or {remedy}" if mergeable else remedy
