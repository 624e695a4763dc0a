"""Reading and checking the plugin's parameters and the arguments of a render."""

from __future__ import annotations

import math
from fractions import Fraction
from numbers import Integral, Real

import drjit as dr
import mitsuba as mi
import numpy as np

from .errors import UnsupportedError, UsageError, UsageTypeError, did_you_mean
from .host.introspection import all_shapes, named
from .image import features, memory
from .image.channels import Channels
from .image.colour import Bands, film_colours
from .image.layers import layer_names
from .planning.decision import read_decisions
from .settings import (
    CONNECTIONS,
    DEFAULT_STORED,
    HEURISTICS,
    LIGHT_PATHS,
    MAX_STORED,
    POINTS,
    SKIP,
    UNLIMITED,
    Settings,
)

# What numbers mean, for messages.
MEANING = {
    "max_depth": "the longest path in edges, -1 for unlimited",
    "rr_depth": "the depth at which Russian roulette starts, 1 or more",
    "stored_vertices": f"the longest path that uses all strategies, 1 to {MAX_STORED}",
    "spp_per_pass": "samples per pixel in one pass, 0 to choose",
    "spp": f"samples per pixel, at most {UNLIMITED}, 0 for the sampler's sample_count",
    "seed": "any number from 0 to 2^32 - 1",
}

# Parameters that are not ours but could be taken for it, and what to do. Mitsuba's upgrade of old scene files
# writes those of its version 0.6 with underscores.
_LIGHT_IMAGE = (
    "it is of Mitsuba 0.6's bdpt; here light subpaths always reach the camera, weighted with all other "
    "strategies; leave it out, or set light_paths=0 to leave out light tracing"
)
_SAMPLE_DIRECT = (
    "it is of Mitsuba 0.6's bdpt; here emitters and sensors are always sampled directly too, weighted with "
    "all other strategies; leave it out"
)
REMEDIES = {
    "samples_per_pass": "it is deprecated in Mitsuba; use spp_per_pass",
    "lightImage": _LIGHT_IMAGE,
    "light_image": _LIGHT_IMAGE,
    "sampleDirect": _SAMPLE_DIRECT,
    "sample_direct": _SAMPLE_DIRECT,
}


def integer(value, name: str, low: int, high: int = UNLIMITED) -> int:
    """``value`` as an int within [low, high]; raises ``TypeError`` and ``ValueError``."""
    number = isinstance(value, Real) and not isinstance(value, (bool, np.bool_))
    if not number or not math.isfinite(value) or value != int(value):
        raise UsageTypeError(f"{name}={value!r} must be an integer: {MEANING[name]}")
    if not low <= value <= high:
        raise UsageError(f"{name}={value!r} is out of range; it is {MEANING[name]}")
    return int(value)


def is_index(value) -> bool:
    """Whether ``value`` is a whole number of Python or NumPy, and no boolean."""
    return isinstance(value, Integral) and not isinstance(value, (bool, np.bool_))


def _boolean(props, name):
    value = props.get(name, False)
    if not isinstance(value, bool):
        raise UsageTypeError(f"{name}={value!r} must be a boolean (true or false)")
    return value


def _shown(value) -> str:
    """``value`` in one line, for messages."""
    return " ".join(repr(value).split())


def _choice(props, name, choices):
    value = props.get(name, choices[0])
    if not isinstance(value, str):
        raise UsageTypeError(f"{name}={_shown(value)} must be a string, one of {', '.join(choices)}")
    if value not in choices:
        raise UsageError(f"{name}={value!r} is not known; use one of {', '.join(choices)}")
    return value


def _light_paths(props):
    value = props.get("light_paths", "auto")
    if isinstance(value, bool) or not isinstance(value, (int, float, str)):
        raise UsageTypeError(f"light_paths={_shown(value)} must be a number or 'auto'")
    if value == "auto":
        return value
    try:
        number = float(Fraction(value))
    except (TypeError, ValueError, ZeroDivisionError, OverflowError):
        number = None
    if number not in LIGHT_PATHS:
        choices = ", ".join(str(Fraction(n)) for n in LIGHT_PATHS)
        raise UsageError(f"light_paths={value!r} is not possible; use auto, {choices}")
    return number


def _decisions(props):
    value = props.get("decisions", "")
    if not isinstance(value, str):
        raise UsageTypeError(f"decisions={value!r} must be a string of JSON")
    return read_decisions(value) if value else None


def _aovs(props):
    value = props.get("aovs", "")
    if not isinstance(value, str):
        raise UsageTypeError(f"aovs={value!r} must be a string, for example 'albedo:albedo,nn:sh_normal'")
    features.check_syntax(value)
    return value


def _until_error(props):
    value = props.get("until_error", 0.0)
    if isinstance(value, bool) or not isinstance(value, (int, float)):
        raise UsageTypeError(f"until_error={value!r} must be a number, the relMSE to stop at")
    if not 0 <= value < math.inf:
        raise UsageError(f"until_error={value!r} must be a positive relMSE, or 0 for none")
    return float(value)


def _check_layers(settings: Settings):
    """Raise ``ValueError`` if two layers of the film have the same name."""
    seen = set()
    names = features.feature_names(settings.aovs)
    for layer in layer_names(settings.strategy_depth, settings.variance, names):
        if layer in seen:
            raise UsageError(
                f"aovs={settings.aovs!r}: there are two layers {layer}; give the feature another name"
            )
        seen.add(layer)


def _check_names(props):
    """Raise ``ValueError`` for parameters that do not exist."""
    known = [f for f in Settings.__dataclass_fields__]
    for name in props.keys():
        if name in known:
            continue
        if isinstance(props[name], mi.Object):
            raise UsageError(
                f"{name} ({props[name].class_name()}) cannot be nested in it: bdpt holds no other "
                "object; take it out"
            )
        remedy = REMEDIES.get(name)
        if remedy is None:
            remedy = f"{did_you_mean(name, known)}Parameters: {', '.join(known)}"
        raise UsageError(f"{name}={_shown(props[name])} is not a parameter; {remedy}")


def read_settings(props) -> Settings:
    """Read and check the plugin's parameters; raises ``TypeError``, ``ValueError`` and
    ``NotImplementedError``."""
    _check_names(props)
    max_depth = integer(props.get("max_depth", -1), "max_depth", -1)
    timeout = props.get("timeout", -1.0)
    if isinstance(timeout, bool) or not isinstance(timeout, (int, float)) or timeout != timeout:
        raise UsageTypeError(f"timeout={timeout!r} must be a number of seconds, or -1 for none")
    settings = Settings(
        max_depth=UNLIMITED if max_depth < 0 else max_depth,
        rr_depth=integer(props.get("rr_depth", 5), "rr_depth", 1),
        hide_emitters=_boolean(props, "hide_emitters"),
        heuristic=_choice(props, "heuristic", HEURISTICS),
        skip=_choice(props, "skip", SKIP),
        light_paths=_light_paths(props),
        connections=_choice(props, "connections", CONNECTIONS),
        points=_choice(props, "points", POINTS),
        decisions=_decisions(props),
        stored_vertices=integer(
            props.get("stored_vertices", DEFAULT_STORED), "stored_vertices", 1, MAX_STORED
        ),
        strategy_images=_boolean(props, "strategy_images"),
        variance=_boolean(props, "variance"),
        until_error=_until_error(props),
        aovs=_aovs(props),
        spp_per_pass=integer(props.get("spp_per_pass", 0), "spp_per_pass", 0),
        timeout=float(timeout),
    )
    if settings.strategy_images and not 0 < settings.max_depth < UNLIMITED:
        raise UsageError(
            f"strategy_images needs a finite max_depth of 1 or greater, not {max_depth}; "
            "set max_depth, for example to 5"
        )
    by_hand = settings.light_paths != "auto" or settings.connections != "auto" or settings.skip != "auto"
    if settings.decisions and (by_hand or settings.strategy_images):
        raise UsageError(
            "decisions together with light_paths, connections, skip or strategy_images is "
            "contradictory; leave out one or the other"
        )
    _check_layers(settings)
    if settings.until_error and not settings.variance:
        raise UsageError(
            f"until_error={settings.until_error} follows from the variance; set variance to true"
        )
    if settings.until_error and settings.points == "sampler":
        raise UsageError(
            f"until_error={settings.until_error} with points=sampler is not possible: a sampler's "
            "samples are numbered before it is known how many there will be; use points=sobol"
        )
    return settings


def check_variant():
    """Raise ``NotImplementedError`` for variants that the method cannot serve, or is not known to."""
    variant = mi.variant()
    if variant.startswith("scalar"):
        raise UnsupportedError(
            f"the variant {variant} is scalar; use a vectorised one, for example "
            "mi.set_variant('llvm_ad_rgb')"
        )
    if not variant.startswith(("llvm", "cuda")):
        raise UnsupportedError(
            f"the variant {variant} runs on {variant.partition('_')[0]}, where this method was never "
            "tried; use a variant of LLVM or CUDA, for example mi.set_variant('llvm_ad_rgb')"
        )
    if mi.is_polarized:
        raise UnsupportedError(
            f"the variant {variant} is polarized, which is not supported; use "
            f"{variant.replace('_polarized', '')}"
        )


def check_not_frozen():
    """Raise ``NotImplementedError`` while a function is recorded by ``dr.freeze``."""
    if dr.flag(dr.JitFlag.FreezingScope):
        raise UnsupportedError(
            "a render inside of a function under dr.freeze is not supported: its passes are planned "
            "from numbers that it reads; call render outside of the function, without dr.freeze (the kernels "
            "of a second render are reused in any case)"
        )


def check_made_for(integrator, scene):
    """Raise ``TypeError`` if ``integrator`` or ``scene`` belongs to another variant than the present."""
    for name, thing, kind in (("integrator", integrator, mi.Integrator), ("scene", scene, mi.Scene)):
        if not isinstance(thing, kind):
            raise UsageTypeError(
                f"{name}={type(thing).__name__} was not loaded under the present variant "
                f"{mi.variant()}; load it again after mi.set_variant"
            )


def check_scene(scene, sensor):
    """Raise ``NotImplementedError`` for what the method cannot render."""
    if sensor.get_medium() is not None:
        raise UnsupportedError(
            f"sensor {named(sensor)} lies in a participating medium, which is not supported; "
            "use integrator type 'volpath'"
        )
    for shape in all_shapes(scene):
        if shape.is_medium_transition():
            raise UnsupportedError(
                f"shape {named(shape)} bounds a participating medium, which is not supported; "
                "use integrator type 'volpath'"
            )


def check_film(sensor, settings: Settings):
    """Raise ``NotImplementedError`` for layers that the film cannot have, ``ValueError`` for a film without
    pixels or too large; returns its colours."""
    colour = film_colours(sensor)
    if settings.strategy_images and isinstance(colour, Bands):
        raise UnsupportedError(
            f"strategy_images=True is not possible with film {named(sensor.film())} of class SpecFilm: "
            "these layers are RGB, and the film samples the wavelengths of its bands only; use hdrfilm"
        )
    _check_has_pixels(sensor.film())
    channels = Channels.of(sensor.film(), len(colour.names), len(features.feature_names(settings.aovs)))
    memory.check_film(sensor.film(), channels, settings.variance)
    memory.check_strategies(sensor.film(), settings.strategy_depth)
    return colour


def _check_has_pixels(film):
    """Raise ``ValueError`` for a film without pixels."""
    width, height = (int(x) for x in film.crop_size())
    if width < 1 or height < 1:
        what = "film" if [width, height] == list(film.size()) else "crop window"
        raise UsageError(f"the {what} of {width} x {height} has no pixels; it needs one at least")
