"""Checks of the properties that Python plugins declare.

Strategies, densities and tables follow from flags and methods like ``is_spatially_varying``, whose defaults
are easily left unchanged. A declaration that the plugin's own values contradict makes strategies disagree, so
it raises an error. Mitsuba's own plugins are not checked. Checks yield contradictions with remedies, of
which the first is raised.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator

import drjit as dr
import mitsuba as mi
import numpy as np

from ..errors import UsageError
from ..geometry.boxes import is_finite, points_in, scene_box
from ..geometry.directions import random_directions, symmetric_frame
from ..geometry.mitsubas_choices import spread_points
from ..host.introspection import children, named
from ..host.notices import State, cached

_COUNT = 4096  # samples of a plugin

# Errors that Mitsuba raises for methods that a Python class lacks.
_NOT_IMPLEMENTED = re.compile("pure virtual|not implemented", re.IGNORECASE)

# Tolerated share of differing samples (rounding, edges), and their relative difference. Wrong declarations
# show in most samples.
_OFF, _RELATIVE = 0.05, 0.01


def check_plugins(scene: mi.Scene, sensor: mi.Sensor) -> None:
    """Raise ``UsageError`` if a Python plugin contradicts its declarations.

    Repeated after edits of plugins' parameters. Runs no kernel in scenes without Python plugins.
    """
    if not any(map(_users_classes, _CHECKS)):
        return
    owners = _held(scene)
    users = [owner for owner in owners if _is_users(type(owner)) and _counts(owner, owners)]
    if not users:
        return
    media = any(isinstance(owner, mi.Medium) for owner in owners)

    def check() -> None:
        for owner in users:
            kind = next(base for base in _CHECKS if isinstance(owner, getattr(mi, base)))
            for contradiction in _CHECKS[kind](owner, scene, media):
                raise UsageError(
                    f"{kind.lower()} {named(owner)} of the Python class {type(owner).__name__} contradicts "
                    f"itself, and strategies would disagree about the image: {contradiction}"
                )

    cached(scene, sensor, "plugins", State.of(users), check, most=1)


def _users_classes(base: str) -> bool:
    """Whether there are user-defined subclasses of Mitsuba's class ``base``."""
    left = list(getattr(mi, base).__subclasses__())
    for found in left:  # grows on the way
        left += found.__subclasses__()
    return any(map(_is_users, left))


def _is_users(kind: type) -> bool:
    return kind.__module__ != "mitsuba" and not kind.__module__.startswith("mitsuba.")


def _counts(owner, owners) -> bool:
    """Whether a strategy relies on the declarations of ``owner``.

    Of textures only on those that emitters sample, not those of BSDFs and spots.
    """
    if not isinstance(owner, mi.Texture):
        return True
    emitters = (e for e in owners if isinstance(e, mi.Emitter) and e.class_name() != "SpotLight")
    return any(owner is value for emitter in emitters for value in children(emitter).values())


def _held(scene: mi.Scene) -> list[mi.Object]:
    """Objects of the scene that `_CHECKS` covers, once each."""
    kinds = tuple(getattr(mi, base) for base in _CHECKS)
    left, seen = [scene], {}
    for owner in left:  # grows on the way
        inner = [value for value in children(owner).values() if isinstance(value, mi.Object)]
        if isinstance(owner, mi.Shape):
            inner += filter(None, (owner.bsdf(), owner.interior_medium(), owner.exterior_medium()))
        fresh = [value for value in inner if id(value) not in seen]
        seen |= {id(value): value for value in fresh}
        left += fresh
    return [owner for owner in seen.values() if isinstance(owner, kinds)]


def _numbers(value) -> np.ndarray:
    """Values (channels, samples) of a spectrum or number; intensity if polarized."""
    if isinstance(value, mi.Spectrum) or dr.depth_v(value) > 1:
        value = mi.unpolarized_spectrum(value) if mi.is_polarized and dr.depth_v(value) > 2 else value
    found = np.atleast_2d(np.array(value, dtype=np.float64))
    return np.broadcast_to(found, (len(found), _COUNT)) if found.shape[1] == 1 else found


def _differ(a, b, where) -> bool:
    """Whether finite values differ on more than `_OFF` of the lanes ``where``."""
    a, b = _numbers(a), _numbers(b)
    with np.errstate(all="ignore"):
        known = np.isfinite(a).all(0) & np.isfinite(b).all(0) & where
        off = (np.abs(a - b) > _RELATIVE * np.maximum(np.abs(a), np.abs(b))).any(0)
    return bool(known.any() and off[known].mean() > _OFF)


def _lit(value) -> np.ndarray:
    found = _numbers(value)
    return np.isfinite(found).all(0) & (found != 0).any(0)


def _interaction() -> mi.SurfaceInteraction3f:
    """Points in the unit square of texture coordinates, seen from all directions."""
    si = dr.zeros(mi.SurfaceInteraction3f, _COUNT)
    si.uv = spread_points(_COUNT)
    si.p = mi.Point3f(si.uv.x, si.uv.y, 0)
    si.n, si.sh_frame = mi.Normal3f(0, 0, 1), mi.Frame3f(mi.Vector3f(0, 0, 1))
    si.dp_du, si.dp_dv = mi.Vector3f(1, 0, 0), mi.Vector3f(0, 1, 0)
    si.wi, si.wavelengths = random_directions(np.random.default_rng(0), _COUNT), _wavelengths()
    si.t = mi.Float(0)
    return si


def _wavelengths():
    if not mi.is_spectral:
        return mi.Color0f()
    step = (mi.MI_CIE_MAX - mi.MI_CIE_MIN) / 4
    return mi.UnpolarizedSpectrum(*(mi.MI_CIE_MIN + (i + 0.5) * step for i in range(4)))


def _places(scene: mi.Scene) -> mi.Point3f:
    """Points in the scene's box, or in the unit cube if it has none."""
    box = scene_box(scene)
    if not is_finite(box):
        box = mi.ScalarBoundingBox3f([0, 0, 0], [1, 1, 1])
    u = np.random.default_rng(1).random((3, _COUNT))
    return points_in([box], np.zeros(_COUNT, dtype=int), u.T)


# -- textures ---------------------------------------------------------------------------------


def _check_texture(texture: mi.Texture, scene, media) -> Iterator[str]:
    value = _first_answer((texture.eval, texture.eval_3, texture.eval_1), _interaction())
    if value is None:
        return
    found = _numbers(value)
    found = found[:, np.isfinite(found).all(0)]
    varies = found.size and (np.ptp(found, axis=1) > 1e-5 * np.abs(found).max()).any()
    if not texture.is_spatially_varying():
        if varies:
            yield (
                "is_spatially_varying() returns False (the default), but its values at different texture "
                "coordinates differ. Let it return True."
            )
        return
    uv, pdf = texture.sample_position(spread_points(_COUNT))
    stated = texture.pdf_position(uv)
    if _differ(pdf, stated, _lit(pdf)):
        yield (
            "pdf_position() is not the density that sample_position() returns with its points, but both are "
            "the density over the unit square. Return the same number."
        )
    lit = _lit(value) & (_numbers(texture.pdf_position(_interaction().uv)) <= 0).all(0)
    if lit.mean() > _OFF:
        yield (
            f"pdf_position() is 0 on {lit.mean():.0%} of the unit square, but its values there are not 0. "
            "Sample every point that is not black."
        )


def _first_answer(methods: tuple[Callable, ...], si):
    """Return the value of the first of ``methods`` that is implemented, or None."""
    for method in methods:
        try:
            return method(si, mi.Bool(True))
        except RuntimeError as error:  # among them NotImplementedError
            if not (isinstance(error, NotImplementedError) or _NOT_IMPLEMENTED.search(str(error))):
                raise
    return None


# -- BSDFs ------------------------------------------------------------------------------------

_LOBES = {
    "a delta": mi.BSDFFlags.Delta,
    "a diffuse or glossy": mi.BSDFFlags.Smooth,
    "a reflecting": mi.BSDFFlags.Reflection,
    "a transmitting": mi.BSDFFlags.Transmission,
}


def _check_bsdf(bsdf: mi.BSDF, scene, media) -> Iterator[str]:
    ctx, si, flags = mi.BSDFContext(), _interaction(), int(bsdf.flags())
    u = np.random.default_rng(3).random((3, _COUNT))
    bs, weight = bsdf.sample(ctx, si, mi.Float(u[0]), mi.Point2f(u[1], u[2]), mi.Bool(True))
    drawn = _lit(weight) & (_numbers(bs.pdf) > 0).all(0)
    kind = np.broadcast_to(np.array(bs.sampled_type, dtype=np.int64), _COUNT)
    delta = (kind & int(mi.BSDFFlags.Delta)) != 0
    wo = mi.Vector3f(bs.wo)
    value, pdf = bsdf.eval(ctx, si, wo, mi.Bool(True)), bsdf.pdf(ctx, si, wo, mi.Bool(True))
    anywhere = bsdf.eval(ctx, si, random_directions(np.random.default_rng(4), _COUNT), mi.Bool(True))
    through = np.broadcast_to(np.array(wo.z * si.wi.z < 0), _COUNT) & drawn & ~delta
    back = drawn & ~delta & ~through
    smooth = (drawn & ~delta) | _lit(anywhere)
    for lobe, seen in zip(_LOBES, (drawn & delta, smooth, back, through), strict=True):
        if seen.mean() > _OFF and not flags & int(_LOBES[lobe]):
            yield (
                f"flags() states no {lobe.split(' ', 1)[1]} lobe, but sample() or eval() has {lobe} one. Set "
                "m_flags, and m_components for each lobe."
            )
    black = drawn & ~delta & _known(wo) & _known(value) & _known(pdf) & ~_lit(value) & ~_lit(pdf)
    if black.mean() > _OFF:
        yield (
            "sample() returns sampled_type of a diffuse or glossy lobe, but eval() and pdf() are 0 in the "
            "directions that it draws. Return the type of a delta lobe, or implement eval() and pdf()."
        )
    yield from _check_null(bsdf, si, kind, drawn, flags, media)


def _known(value) -> np.ndarray:
    return np.asarray(np.isfinite(_numbers(value)).all(0))


def _check_null(bsdf, si, kind, drawn, flags: int, media: bool) -> Iterator[str]:
    """Check ``eval_null_transmission`` against the flag ``Null`` in scenes with media."""
    if not media:
        return
    passes = _lit(bsdf.eval_null_transmission(si, mi.Bool(True))).any()
    null = int(mi.BSDFFlags.Null)
    stated = bool(flags & null)
    if passes and not stated:
        yield (
            "flags() states no null lobe, but eval_null_transmission() lets light pass. Set "
            "mi.BSDFFlags.Null in m_flags and m_components."
        )
    if not passes and (drawn & ((kind & null) != 0)).any():
        yield (
            "eval_null_transmission() returns 0 (the default), but sample() lets light pass as a null "
            "event. Implement it: what a surface lets pass straight on."
        )


# -- emitters ---------------------------------------------------------------------------------


def _check_emitter(emitter: mi.Emitter, scene, media) -> Iterator[str]:
    it = dr.zeros(mi.Interaction3f, _COUNT)
    it.p, it.wavelengths = _places(scene), _wavelengths()
    ds, weight = emitter.sample_direction(it, spread_points(_COUNT), mi.Bool(True))
    drawn = _lit(weight) & (_numbers(ds.pdf) > 0).all(0) & _known(ds.pdf)
    if not drawn.any():
        return
    delta, flags = mi.has_flag(emitter.flags(), mi.EmitterFlags.Delta), emitter.flags()
    sampled_delta = np.broadcast_to(np.array(ds.delta), _COUNT) & drawn
    if sampled_delta.any() and not delta:
        yield (
            "flags() states neither DeltaPosition nor DeltaDirection, but sample_direction() returns "
            "samples that are delta. Set m_flags, or ds.delta to False."
        )
    infinite = mi.has_flag(flags, mi.EmitterFlags.Infinite)
    if not infinite and emitter.get_shape() is None:
        return  # nothing can hit it
    radiance = emitter.eval(_hit(it, ds, infinite), mi.Bool(True))
    if delta:
        if (_lit(radiance) & drawn).mean() > _OFF:
            yield (
                "flags() states DeltaPosition or DeltaDirection, but eval() returns radiance for rays that "
                "hit it. Set other m_flags, or let eval() return 0."
            )
        return
    if _differ(emitter.pdf_direction(it, ds, mi.Bool(True)), ds.pdf, drawn):
        yield (
            "pdf_direction() is not the density ds.pdf that sample_direction() returns, but both are the "
            "density over solid angle. Return the same number."
        )
    if _differ(radiance, weight * ds.pdf, drawn):
        yield (
            "eval() is not what sample_direction() returns, times its density, but both are the emitted "
            "radiance. Return the radiance over ds.pdf from sample_direction()."
        )


def _hit(it, ds, infinite: bool) -> mi.SurfaceInteraction3f:
    """The sample ``ds`` as a hit of a ray from ``it``."""
    if infinite:
        si = dr.zeros(mi.SurfaceInteraction3f, _COUNT)
        si.t, si.wi, si.wavelengths = mi.Float(dr.inf), -ds.d, it.wavelengths
        return si
    si = mi.SurfaceInteraction3f(ds, it.wavelengths)
    si.t = ds.dist
    si.wi = si.to_local(-ds.d)
    return si


# -- media ------------------------------------------------------------------------------------


def _volume_vertices(scene) -> mi.MediumInteraction3f:
    mei = dr.zeros(mi.MediumInteraction3f, _COUNT)
    mei.p, mei.wi = _places(scene), random_directions(np.random.default_rng(5), _COUNT)
    mei.sh_frame, mei.wavelengths = symmetric_frame(mei.wi), _wavelengths()
    return mei


def _check_phase(phase: mi.PhaseFunction, scene, media) -> Iterator[str]:
    mei, ctx = _volume_vertices(scene), mi.PhaseFunctionContext(None)
    u = np.random.default_rng(6).random((3, _COUNT))
    wo, weight, pdf = phase.sample(ctx, mei, mi.Float(u[0]), mi.Point2f(u[1], u[2]), mi.Bool(True))
    value, stated = phase.eval_pdf(ctx, mei, wo, mi.Bool(True))
    drawn = _lit(weight) & (_numbers(pdf) > 0).all(0)
    if _differ(pdf, stated, drawn) or _differ(weight * pdf, value, drawn):
        yield (
            "eval_pdf() is not what sample() returns in the directions that it draws, but value and density "
            "of a direction are one. Return value / density and the same density from sample()."
        )


def _check_medium(medium: mi.Medium, scene, media) -> Iterator[str]:
    mei = _volume_vertices(scene)
    _, _, sigma_t = medium.get_scattering_coefficients(mei, mi.Bool(True))
    majorant, sigma_t = _numbers(medium.get_majorant(mei, mi.Bool(True))), _numbers(sigma_t)
    with np.errstate(all="ignore"):
        varies = (np.ptp(sigma_t, axis=1) > 1e-5 * np.abs(sigma_t).max()).any()
        above = (sigma_t > majorant * (1 + 1e-4)).any(0).mean()
    if medium.is_homogeneous() and varies:
        yield (
            "is_homogeneous() returns True, but get_scattering_coefficients() differs from place to place. "
            "Let it return False, and get_majorant() the largest extinction."
        )
    if above > 0:
        yield (
            f"get_majorant() is less than the extinction at {above:.0%} of the points, but flights "
            "take it for the largest. Return the largest extinction."
        )


_CHECKS: dict[str, Callable[..., Iterator[str]]] = {
    "BSDF": _check_bsdf,
    "Texture": _check_texture,
    "Emitter": _check_emitter,
    "PhaseFunction": _check_phase,
    "Medium": _check_medium,
}
