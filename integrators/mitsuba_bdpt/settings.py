"""The integrator's parameters: the only table of their names, defaults, bounds and meanings.

`properties.read_settings` reads them, the plugin's manual is `manual` and docs/user/parameters.md is `table`.
"""

from __future__ import annotations

import re
from dataclasses import dataclass, field, fields, replace
from math import inf
from typing import Any

# Path length, or number of samples, that stands for no limit: the largest of Dr.Jit's 32-bit integers.
UNLIMITED = 2**32 - 1

# Most edges of a path that uses all strategies, and so most light vertices per lane, whose local memory lies
# on a thread's stack.
MAX_STORED = 1024

# Longest path in edges that uses all strategies, longer ones use s = 0 and s = 1; with media `MAX_STORED`.
DEFAULT_STORED = 64

HEURISTICS = ("balance", "power")
LIGHT_PATHS = (0, 1, 1 / 2, 1 / 4, 1 / 8, 1 / 16)
POINTS = ("sobol", "independent")
LAYERS = ("variance", "denoised", "stokes", "strategies")


# Text that a parameter may have in place of an empty one.
NONE = "none"

# What is no parameter or option, but was in an earlier version or is elsewhere, and what to use instead.
_OF_06 = "it is of Mitsuba 0.6's bdpt; here all strategies are weighted with one another; leave it out"
REPLACED = {
    "decisions": "set light_paths and connections; checkpoints and clusters hand over what was decided",
    "photon_guiding": "use guiding",
    "emission_guiding": "use guiding",
    "strategy_images": "use layers=strategies",
    "variance": "use layers=variance",
    "denoise": "use layers=denoised",
    "stokes": "use layers=stokes",
    "samples_per_pass": "it is deprecated in Mitsuba; use spp_per_pass",
    "light_image": f"{_OF_06}, or set light_paths=0 for no light tracing",
    "sample_direct": _OF_06,
    "--frames": "render each frame by a command of its own, with --sensor and --seed",
}


@dataclass(frozen=True)
class Parameter:
    """One parameter of the plugin.

    ``default`` as in a scene file; ``meaning``: its entry in the manual, in reStructuredText; ``what``: its
    value, in a few words for error messages; ``low`` and ``high`` bound numbers, both included (of a
    ``float`` infinity is not); ``choices``: all values, the default first.
    """

    default: bool | int | float | str
    meaning: str
    what: str = ""
    low: float = -inf
    high: float = inf
    choices: tuple[str, ...] = ()

    @property
    def kind(self) -> type:
        """Type of the value: ``bool``, ``int``, ``float`` or ``str``."""
        return type(self.default)


Value = bool | int | float | str


def _parameter(default: Value, meaning: str, what: str = "", value: Any = None, **bounds: Any) -> Any:
    """A field of `Settings` that holds ``value`` (None: the same) for the parameter's ``default``."""
    parameter = Parameter(default, " ".join(meaning.split()), what, **bounds)
    return field(default=default if value is None else value, metadata={"parameter": parameter})


@dataclass(frozen=True)
class Internals:
    """Values of the method that no parameter sets; tests, makers of references and clusters vary them."""

    merging_radius: float = 1.0
    """Radius of vertex merging after 64 samples per pixel, in pixels as they are seen directly."""
    stored_vertices: int | None = None
    """Longest path in edges that uses all strategies; None: `DEFAULT_STORED`, with media `MAX_STORED`."""
    decisions: tuple[Any, ...] | None = None
    """In place of a pilot's decisions, each a `planning.configuration.Decision`; None: a pilot decides."""


@dataclass(frozen=True)
class Settings:
    """The parameters, checked: ``max_depth`` `UNLIMITED` for -1, ``layers`` in the order of `LAYERS`."""

    max_depth: int = _parameter(
        -1,
        """Longest path in edges, as in ``path`` (with media as in ``volpath``): 1 is directly visible
        emitters, -1 unlimited.""",
        "the longest path in edges, -1 for unlimited",
        UNLIMITED,
        low=-1,
        high=UNLIMITED,
    )
    rr_depth: int = _parameter(
        5,
        "Russian roulette starts at this depth, as in ``path``.",
        "the depth at which Russian roulette starts, 1 or more",
        low=1,
        high=UNLIMITED,
    )
    hide_emitters: bool = _parameter(False, "Hides directly visible emitters, as in ``path``.")
    heuristic: str = _parameter(
        "balance",
        "Heuristic of multiple importance sampling: ``balance`` or ``power`` (exponent 2).",
        choices=HEURISTICS,
    )
    skip: str = _parameter(
        "auto",
        """Leaves out nothing (``none``), what the scene cannot use (``impossible``), or also what a short
        pilot render predicts not to pay (``auto``).""",
        choices=("auto", "impossible", "none"),
    )
    light_paths: float | str = _parameter(
        "auto",
        """Light subpaths per camera subpath: 0 (path tracing), 1/16, 1/8, 1/4, 1/2 or 1; with ``auto`` the
        pilot chooses, a number switches the pilot off.""",
        choices=("auto", "0", "1", "1/2", "1/4", "1/8", "1/16"),
    )
    connections: str = _parameter(
        "auto",
        """Connections per camera vertex to vertices of light subpaths: ``all``, ``one`` or ``none``; with
        ``auto`` the pilot chooses, the others switch the pilot off.""",
        choices=("auto", "all", "one", "none"),
    )
    points: str = _parameter(
        "sobol",
        "Random numbers: ``sobol`` (Owen-scrambled Sobol' points) or ``independent``.",
        choices=POINTS,
    )
    merging: bool | str = _parameter(
        "auto",
        """Renders SDS paths (light that specular surfaces focus, seen through or in specular surfaces, such
        as the floor of a pool, or shafts of light in its water), also of nearly specular surfaces, by vertex
        merging with photons: consistent, not unbiased. With ``auto`` it merges where the other strategies
        miss 1 % of the image's light or more.""",
        choices=("auto", "true", "false"),
    )
    guiding: str = _parameter(
        "auto",
        """Learned sampling where the pilot predicts a gain (``auto``): photons guide BSDF sampling of SDS
        paths, and tables guide emission; ``photons`` or ``emission`` allows one of them, ``never`` neither;
        ``always`` uses photons wherever it is possible.""",
        choices=("auto", "always", "photons", "emission", "never"),
    )
    aovs: str = _parameter(
        "",
        """Adds feature layers by pairs ``name:kind`` as Mitsuba's ``aov``, for example
        ``albedo:albedo,nn:sh_normal``.""",
        "a string, for example 'albedo:albedo,nn:sh_normal'",
    )
    layers: tuple[str, ...] = _parameter(
        "",
        """Adds layers to the image, separated by commas: ``variance`` (of each pixel), ``denoised`` (by
        Intel's Open Image Denoise), ``stokes`` (Stokes vectors), ``strategies`` (an image of each).""",
        "a text with commas between, such as 'variance,denoised'",
        (),
    )
    light_groups: str = _parameter(
        "",
        """Adds a layer of the light of each group of emitters; their sum is the image. Groups are given by
        ids of emitters or their shapes, ``key: lamp1, lamp2; sky: envmap`` (``*`` for any characters), or
        ``auto``: one per emitter, from the ninth on together.""",
        "a string such as 'key: lamp1, lamp2; sky: envmap', or 'auto'",
    )
    path_layers: bool = _parameter(
        False,
        """Adds four layers of the light by its path; their sum is the image: ``emission`` (visible emitters),
        ``direct``, ``indirect``, and ``caustic`` (direct light by way of specular surfaces).""",
    )
    target_error: float = _parameter(
        0.0,
        """Stops the render when its estimated relMSE is at most this, 0 for never; adds the layer
        ``variance``.""",
        "the relMSE to stop at, or 0 for none",
        low=0,
    )
    spp_per_pass: int = _parameter(
        0,
        "Samples per pixel of a pass, after which progress is shown and checkpoints are written; 0 chooses.",
        "samples per pixel in one pass, 0 to choose",
        low=0,
        high=UNLIMITED,
    )
    timeout: float = _parameter(
        -1.0,
        "Seconds after which no further pass is started, -1 for no limit.",
        "a number of seconds, or -1 for none",
    )

    internals: Internals = Internals()

    def varied(self, **internals: Any) -> Settings:
        """These settings with other values of `Internals`."""
        return replace(self, internals=replace(self.internals, **internals))

    @property
    def variance(self) -> bool:
        """Whether the variance of each pixel is estimated, from replicates of the render."""
        return "variance" in self.layers or self.target_error > 0

    @property
    def denoise(self) -> bool:
        return "denoised" in self.layers

    @property
    def stokes(self) -> bool:
        return "stokes" in self.layers

    @property
    def strategy_images(self) -> bool:
        return "strategies" in self.layers

    @property
    def strategy_depth(self) -> int:
        """The largest path length of the strategy images, 0 for none."""
        return self.max_depth if self.strategy_images else 0

    @property
    def merge_images(self) -> bool:
        """Whether there is a strategy image of merges."""
        return self.strategy_images and self.merging is True


PARAMETERS: dict[str, Parameter] = {
    f.name: f.metadata["parameter"] for f in fields(Settings) if "parameter" in f.metadata
}
_MANUAL_KINDS = {bool: "|bool|", int: "|int|", float: "|float|", str: "|string|"}
_OWN_KINDS = {"light_paths": "|string| or |float|", "merging": "|string| or |bool|"}


def _default(parameter: Parameter) -> str:
    """The default, as a scene file has it."""
    if parameter.default == "":
        return NONE
    if isinstance(parameter.default, float):
        return f"{parameter.default:g}"
    return str(parameter.default).lower()


def manual() -> str:
    """The list of parameters of the plugin's manual, in reStructuredText as in Mitsuba's own."""
    lines = [".. pluginparameters::", ""]
    for name, parameter in PARAMETERS.items():
        kind = _OWN_KINDS.get(name) or _MANUAL_KINDS[parameter.kind]
        lines += [
            f" * - {name}",
            f"   - {kind}",
            f"   - {parameter.meaning} (Default: {_default(parameter)})",
        ]
    return "\n".join(lines)


def table() -> str:
    """The parameters as a table in Markdown."""
    lines = ["| parameter | default | meaning |", "| --- | --- | --- |"]
    for name, parameter in PARAMETERS.items():
        meaning = re.sub(r"``([^`]*)``", r"`\1`", parameter.meaning)
        lines.append(f"| `{name}` | `{_default(parameter)}` | {meaning} |")
    return "\n".join(lines)
