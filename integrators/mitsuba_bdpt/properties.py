"""Reads and checks the plugin's parameters and the arguments of a render."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Sequence
from numbers import Integral, Real

import drjit as dr
import mitsuba as mi
import numpy as np

from .emitters import light_groups
from .errors import UnsupportedError, UsageError, UsageTypeError, did_you_mean
from .host.introspection import named
from .image import denoising, features, film_limits
from .image.accumulator import Channels
from .image.colour import POLARIZED, Bands, film_colours
from .image.layers import GROUP, PATH, film_layers, partitions
from .settings import LAYERS, LIGHT_PATHS, NONE, PARAMETERS, REPLACED, UNLIMITED, Settings

# Valid values of a render's arguments, for messages; for parameters see `settings.PARAMETERS`.
ARGUMENTS = {
    "spp": f"an integer from 1 to {UNLIMITED}, or 0 for the sampler's sample_count",
    "seed": f"an integer from 0 to {UNLIMITED}",
    "part": f"an integer from 0 to {UNLIMITED}",
}


def integer(value, name: str, low: float, high: float = UNLIMITED) -> int:
    """Return an int in [low, high]; raises ``UsageTypeError`` and ``UsageError``."""
    number = isinstance(value, Real) and not isinstance(value, (bool, np.bool_))
    what = f"must be {ARGUMENTS[name]}" if name in ARGUMENTS else ""
    if not number or not math.isfinite(value) or value != int(value):
        raise UsageTypeError(f"{name}={value!r} {what or f'must be an integer: {PARAMETERS[name].what}'}")
    if not low <= value <= high:
        raise UsageError(f"{name}={value!r} {what or f'is out of range; it is {PARAMETERS[name].what}'}")
    return int(value)


def is_index(value) -> bool:
    """Return whether ``value`` is an integer of Python or NumPy, and no boolean."""
    return isinstance(value, Integral) and not isinstance(value, (bool, np.bool_))


def _shown(value) -> str:
    """Format ``value`` in one line, for messages."""
    return " ".join(repr(value).split())


def _integer(value, name: str) -> int:
    return integer(value, name, PARAMETERS[name].low, PARAMETERS[name].high)


def _boolean(value, name: str) -> bool:
    if not isinstance(value, bool):
        raise UsageTypeError(f"{name}={value!r} must be a boolean (true or false)")
    return value


def _number(value, name: str) -> float:
    parameter = PARAMETERS[name]
    if isinstance(value, bool) or not isinstance(value, (int, float)) or math.isnan(value):
        raise UsageTypeError(f"{name}={value!r} must be a number: {parameter.what}")
    # Without a lower bound, infinity is valid.
    if not parameter.low <= value or (parameter.low > -math.inf and value == math.inf):
        raise UsageError(f"{name}={value!r} is out of range; it is {parameter.what}")
    return float(value)


def _string(value, name: str) -> str:
    if not isinstance(value, str):
        raise UsageTypeError(f"{name}={_shown(value)} must be {PARAMETERS[name].what}")
    return "" if value.strip() == NONE else value


def _choice(value, name: str) -> str:
    choices = PARAMETERS[name].choices
    if not isinstance(value, str):
        raise UsageTypeError(f"{name}={_shown(value)} must be a string, one of {', '.join(choices)}")
    if value not in choices:
        raise UsageError(f"{name}={value!r} is not known; use one of {', '.join(choices)}")
    return value


def _light_paths(value, name: str) -> float | str:
    from fractions import Fraction  # takes 3 ms, and the default does not need it

    if isinstance(value, str) and value == "auto":
        return value
    try:
        number = None if isinstance(value, bool) else float(Fraction(value))
    except (TypeError, ValueError, ZeroDivisionError, OverflowError):
        number = None
    if number not in LIGHT_PATHS:
        choices = ", ".join(PARAMETERS[name].choices)
        raise UsageError(f"{name}={_shown(value)} is not possible; use one of {choices}")
    return number


def _merging(value, name: str) -> bool | str:
    word = _choice(str(value).lower() if isinstance(value, bool) else value, name)
    return {"true": True, "false": False}.get(word, word)


def _layers(value, name: str) -> tuple[str, ...]:
    """The layers, in the order of `LAYERS`."""
    text = _string(value, name)
    given = [word.strip() for word in text.split(",")] if text else []
    for word in given:
        if word not in LAYERS:
            remedy = f"{did_you_mean(word, LAYERS)}Layers: {', '.join(LAYERS)}"
            raise UsageError(f"{name}={_shown(value)}: there is no layer {word!r}; {remedy}")
    return tuple(word for word in LAYERS if word in given)


def _aovs(value, name: str) -> str:
    text = features.checked(_string(value, name))
    for layer in features.feature_names(text):
        if layer.startswith((GROUP, PATH)):  # they are told apart by their names alone in a file
            raise UsageError(
                f"{name}={value!r}: {layer} has the name of a light group or path layer; give the feature "
                "another name"
            )
    return text


def _light_groups(value, name: str) -> str:
    text = _string(value, name)
    light_groups.parsed(text)
    return text


# Readers of parameters with their own syntax.
_READERS = {
    "max_depth": lambda value, name: UNLIMITED if (depth := _integer(value, name)) < 0 else depth,
    "light_paths": _light_paths,
    "merging": _merging,
    "aovs": _aovs,
    "layers": _layers,
    "light_groups": _light_groups,
}
_READERS_OF_KINDS = {bool: _boolean, int: _integer, float: _number, str: _choice}


def _not_a_parameter(name: str, value) -> str:
    if isinstance(value, mi.Object):
        return (
            f"{name} ({value.class_name()}) cannot be nested in it: bdpt holds no other object; take it out"
        )
    remedy = REPLACED.get(name) or f"{did_you_mean(name, PARAMETERS)}Parameters: {', '.join(PARAMETERS)}"
    return f"{name}={_shown(value)} is not a parameter; {remedy}"


def read_settings(props) -> Settings:
    """Return the checked parameters; raises ``UsageError`` and ``UsageTypeError``."""
    given = {name: props[name] for name in props.keys()}
    for name, value in given.items():
        if name not in PARAMETERS:
            raise UsageError(_not_a_parameter(name, value))
    values = {}
    for name, parameter in PARAMETERS.items():
        read = _READERS.get(name) or _READERS_OF_KINDS[parameter.kind]
        values[name] = read(given.get(name, parameter.default), name)
    settings = Settings(**values)
    _check_together(settings)
    return settings


def _check_together(settings: Settings):
    """Raise ``UsageError`` for contradictory parameters."""
    if settings.strategy_images and not 0 < settings.max_depth < UNLIMITED:
        depth = -1 if settings.max_depth == UNLIMITED else settings.max_depth
        raise UsageError(
            f"layers=strategies needs a finite max_depth of 1 or greater, not {depth}; "
            "set max_depth, for example to 5"
        )
    named = film_layers(
        settings, light_groups=[*light_groups.parsed(settings.light_groups), light_groups.REST]
    )
    twice = [layer for layer, count in Counter(named).items() if count > 1]
    if twice:
        raise UsageError(
            f"aovs={settings.aovs!r}: there are two layers {twice[0]}; give the feature another name"
        )
    if settings.stokes and not mi.is_polarized:
        raise UsageError(
            f"layers=stokes needs a polarized variant, {mi.variant()} has no Stokes vectors; use one, for "
            "example llvm_ad_spectral_polarized"
        )


def check_variant(variant: str | None = None):
    """Raise ``UnsupportedError`` for variants (default: current) of other backends than LLVM and CUDA."""
    variant = variant or mi.variant() or "none"
    if not variant.startswith(("llvm", "cuda")):
        raise UnsupportedError(
            f"the variant {variant} is not supported; use one of LLVM or CUDA, for example llvm_ad_rgb"
        )


def check_not_frozen():
    """Raise ``UnsupportedError`` while a function is recorded by ``dr.freeze``."""
    if dr.flag(dr.JitFlag.FreezingScope):
        raise UnsupportedError(
            "a render inside of a function under dr.freeze is not supported: its passes are planned "
            "from numbers that it reads; call render outside of the function, without dr.freeze (the kernels "
            "of a second render are reused in any case)"
        )


def check_film(sensor, settings: Settings, groups: Sequence[str] = ()):
    """Check the film against the layers, of light ``groups`` too; returns its colours and `Channels`.

    Raises ``UnsupportedError`` for layers that the film cannot have, ``UsageError`` for a film without pixels
    or too large.
    """
    colour = film_colours(sensor, settings.stokes)
    film = sensor.film()
    rgb_only = [name for name in settings.layers if name != "variance"]
    if rgb_only and isinstance(colour, Bands):
        raise UnsupportedError(
            f"layers={rgb_only[0]} is not possible with film {named(film)} of class SpecFilm: these layers "
            "are RGB, and the film samples the wavelengths of its bands only; use hdrfilm"
        )
    count = len(features.feature_names(settings.aovs))
    if settings.denoise:
        denoising.check_installed()
        count += denoising.GUIDE_CHANNELS
    width, height = (int(x) for x in film.crop_size())
    if width < 1 or height < 1:
        what = "film" if [width, height] == list(film.size()) else "crop window"
        raise UsageError(f"the {what} of {width} x {height} has no pixels; it needs one at least")
    alpha, stokes = int(mi.has_flag(film.flags(), mi.FilmFlags.Alpha)), POLARIZED if settings.stokes else 0
    parts = tuple(len(layers) for layers in partitions(settings, groups))
    channels = Channels(len(colour.names), alpha, count, stokes, parts)
    film_limits.check_film(film, channels, settings.variance)
    film_limits.check_strategies(film, settings.strategy_depth, settings.merge_images)
    return colour, channels
