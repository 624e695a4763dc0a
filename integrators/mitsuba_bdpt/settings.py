"""The integrator's parameters: the one place that knows their names, defaults, bounds and meanings.

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
SKIP = ("auto", "impossible", "none")
LIGHT_PATHS = (0, 1, 1 / 2, 1 / 4, 1 / 8, 1 / 16)
GUIDING = ("auto", "always", "never")
EMISSION_GUIDING = ("auto", "never")
CONNECTIONS = ("auto", "all", "one", "none")
POINTS = ("sobol", "independent")


@dataclass(frozen=True)
class Parameter:
    """One parameter of the plugin.

    ``default`` as in a scene file; ``what``: its value, in a few words for error messages; ``meaning``: its
    entry in the manual, in reStructuredText; ``low`` and ``high`` bound numbers, both included (of a
    ``float`` infinity is not); ``choices`` of a string, the default first.
    """

    default: bool | int | float | str
    what: str
    meaning: str
    low: float = -inf
    high: float = inf
    choices: tuple[str, ...] = ()

    @property
    def kind(self) -> type:
        """Type of the value: ``bool``, ``int``, ``float`` or ``str``."""
        return type(self.default)


Value = bool | int | float | str


def _parameter(default: Value, what: str, meaning: str, **bounds: Any) -> Any:
    """A field of `Settings` that holds the value as it is given."""
    return _converted(default, default, what, meaning, **bounds)


def _converted(default: Value, value: Value | None, what: str, meaning: str, **bounds: Any) -> Any:
    """A field of `Settings` that holds ``value`` for the parameter's ``default``."""
    text = " ".join(meaning.split())
    return field(default=value, metadata={"parameter": Parameter(default, what, text, **bounds)})


@dataclass(frozen=True)
class Internals:
    """Values of the method that no parameter sets; tests and the makers of references vary them."""

    merging_radius: float = 1.0
    """Radius of vertex merging in the first pass, in pixels as they are seen directly."""
    stored_vertices: int | None = None
    """Longest path in edges that uses all strategies; None: `DEFAULT_STORED`, with media `MAX_STORED`."""


@dataclass(frozen=True)
class Settings:
    """The parameters, checked. ``max_depth`` is `UNLIMITED` for -1, ``decisions`` a tuple or None."""

    max_depth: int = _converted(
        -1,
        UNLIMITED,
        "the longest path in edges, -1 for unlimited",
        """Longest path in edges, as in ``path``: 1 is directly visible emitters, -1 unlimited. (In scenes
        with participating media as in ``volpath``, where null surfaces do not count.)""",
        low=-1,
        high=UNLIMITED,
    )
    rr_depth: int = _parameter(
        5,
        "the depth at which Russian roulette starts, 1 or more",
        "Russian roulette starts at this depth, as in ``path``.",
        low=1,
        high=UNLIMITED,
    )
    hide_emitters: bool = _parameter(
        False,
        "true or false",
        "Hide directly visible emitters, as in ``path``.",
    )
    heuristic: str = _parameter(
        "balance",
        "a heuristic",
        "Heuristic of multiple importance sampling: ``balance`` or ``power`` (exponent 2).",
        choices=HEURISTICS,
    )
    skip: str = _parameter(
        "auto",
        "what may be left out",
        """``none``: do everything. ``impossible``: leave out what the scene cannot use, draw one connection
        per camera vertex, drop small contributions by unbiased Russian roulette. ``auto``: as ``impossible``,
        and in renders of 2^14 samples or more (in scenes of ten BSDFs or more: about 2^16 for each kind of
        BSDF) a pilot, or the scene alone where that tells, chooses what pays. What a pilot finds is
        remembered for later renders of the scene, until its parameters are edited.""",
        choices=SKIP,
    )
    light_paths: float | str = _parameter(
        "auto",
        "a number or 'auto'",
        """Light subpaths per camera subpath: 0, 1, 1/2, 1/4, 1/8 or 1/16; one light subpath serves camera
        subpaths of different pixels. ``auto``: the pilot's choice; without one 1/4, but 1 on films of fewer
        than 64 pixels and 0 under an even sky; with ``skip=none`` 1. Given by hand, there is no pilot.""",
    )
    connections: str = _parameter(
        "auto",
        "a kind of inner connections",
        """Inner connections per camera vertex: ``all``, ``one`` (drawn by its unshadowed contribution) or
        ``none``. ``auto``: the pilot's choice; without one ``one``, but ``none`` under an even sky; with
        ``skip=none`` ``all``. Given by hand, there is no pilot.""",
        choices=CONNECTIONS,
    )
    points: str = _parameter(
        "sobol",
        "a kind of sample points",
        """Sample points: ``sobol``, Owen-scrambled Sobol' points, or ``independent`` random numbers.""",
        choices=POINTS,
    )
    merging: bool = _parameter(
        False,
        "true or false",
        """Merge vertices of paths on which no two neighbours can be joined (lamp, glass, wall, glass, camera)
        with photons near them. Such light, which is fireflies or missing otherwise, comes out smooth. The
        render is then consistent, not unbiased: it blurs these paths by about a pixel, less from pass to
        pass.""",
    )
    photon_guiding: str = _parameter(
        "auto",
        "when s = 0 is guided",
        """Guide s = 0 by photons on paths on which no two neighbours can be joined (lamp, glass, wall, glass,
        camera), which are fireflies otherwise; unbiased. ``auto``: where the pilot finds that it pays.
        ``always``: wherever it is possible. ``never``.""",
        choices=GUIDING,
    )
    emission_guiding: str = _parameter(
        "auto",
        "when emission is guided",
        """Guide the emission of light subpaths to where they matter, by tables that the pilot learns from its
        own samples; unbiased. ``auto``: where it finds that it pays, in renders that ask one. ``never``: not
        unless ``decisions`` hold tables.""",
        choices=EMISSION_GUIDING,
    )
    decisions: tuple[Any, ...] | None = _converted(
        "",
        None,
        "a string of JSON",
        """JSON of ``statistics["decisions"]`` of an earlier render, done again instead of asking a pilot.""",
    )
    strategy_images: bool = _parameter(
        False,
        "true or false",
        """Adds the layers ``weighted.s{S}t{T}`` and ``unweighted.s{S}t{T}`` of all *k* + 2 strategies of each
        length *k*, with ``merging`` also ``weighted.merged`` and ``unweighted.merged``; needs a finite
        ``max_depth``.""",
    )
    variance: bool = _parameter(
        False,
        "true or false",
        """Adds the layers ``variance.R``, ``.G``, ``.B`` (on a ``specfilm``: of its bands): the variance of
        each pixel, splats included, estimated from 8 independent parts of the render;
        ``statistics["error"]`` is the relMSE that follows. Needs at least 8 samples per pixel. Under
        ``timeout`` at least two of the parts have to end (four for the error), so ask for no more samples
        than it allows.""",
    )
    denoise: bool = _parameter(
        False,
        "true or false",
        """Adds the layers ``denoised.R``, ``.G``, ``.B``: the image without its noise, by Intel's Open Image
        Denoise (package mitsuba-oidn, extra ``[denoise]``), which is told albedo and normals of what is seen
        first. The image itself stays as it is. For previews: a denoised image is biased.""",
    )
    stokes: bool = _parameter(
        False,
        "true or false",
        """Adds the layers ``S0.R`` to ``S3.B``: the Stokes vector of each pixel in the sensor's frame, as
        Mitsuba's integrator ``stokes`` writes them. In polarized variants only.""",
    )
    target_error: float = _parameter(
        0.0,
        "the relMSE to stop at, or 0 for none",
        """Stop when the estimate of the relMSE is this or less; needs ``variance``. It is looked at after 32
        samples per pixel, 64, 128, …; ``spp`` is the most that is spent. An estimate that is too small by
        chance ends a render too early: see docs/user/long_renders.md for by how much.""",
        low=0,
    )
    aovs: str = _parameter(
        "",
        "a string, for example 'albedo:albedo,nn:sh_normal'",
        """Adds feature layers, named by pairs ``name:kind`` as in Mitsuba's ``aov`` and equal to its layers:
        ``albedo``, ``depth``, ``position``, ``uv``, ``geo_normal``, ``sh_normal``, ``dp_du``, ``dp_dv``,
        ``duv_dx``, ``duv_dy``, ``prim_index``, ``shape_index``. Emitters show in them under
        ``hide_emitters`` too.""",
    )
    spp_per_pass: int = _parameter(
        0,
        "samples per pixel in one pass, 0 to choose",
        "Samples per pixel in one pass; 0: chosen from a budget.",
        low=0,
        high=UNLIMITED,
    )
    timeout: float = _parameter(
        -1.0,
        "a number of seconds, or -1 for none",
        """Seconds after which no further pass is started (passes take about a tenth of it); -1: never.""",
    )

    internals: Internals = Internals()

    def varied(self, **internals: Any) -> Settings:
        """These settings with other values of `Internals`."""
        return replace(self, internals=replace(self.internals, **internals))

    @property
    def strategy_depth(self) -> int:
        """The largest path length of the strategy images, 0 for none."""
        return self.max_depth if self.strategy_images else 0

    @property
    def merge_images(self) -> bool:
        """Whether there is a strategy image of merges."""
        return self.strategy_images and self.merging


PARAMETERS: dict[str, Parameter] = {
    f.name: f.metadata["parameter"] for f in fields(Settings) if "parameter" in f.metadata
}
_MANUAL_KINDS = {bool: "|bool|", int: "|int|", float: "|float|", str: "|string|"}


def _default(parameter: Parameter) -> str:
    """The default, as a scene file has it."""
    if parameter.default == "":
        return "none"
    if isinstance(parameter.default, float):
        return f"{parameter.default:g}"
    return str(parameter.default).lower()


def manual() -> str:
    """The list of parameters of the plugin's manual, in reStructuredText as in Mitsuba's own."""
    lines = [".. pluginparameters::", ""]
    for name, parameter in PARAMETERS.items():
        kind = "|string| or |float|" if name == "light_paths" else _MANUAL_KINDS[parameter.kind]
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
