"""Wrong parameters, broken scene files, odd films, numbers that are none, outputs that can't be written."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable
from functools import partial

import numpy as np
import repository
from hypothesis import HealthCheck, Phase, given, settings
from hypothesis import strategies as st

import mitsuba as mi  # isort: skip

from . import films, outputs, scene_files
from .case import Outcome, of_section
from .counting import counted, short

_case = of_section("Bad input")

# -- parameters -------------------------------------------------------------------------------

ANYTHING = st.one_of(
    st.integers(-(2**63), 2**63 - 1),
    st.integers(-2, 70),
    st.floats(),
    st.booleans(),
    st.text(max_size=12),
    st.sampled_from(
        ["", "auto", "none", "all", "1/4", "1/0", "nan", "[]", "{", "x" * 100_000, "albedo:albedo"]
    ),
)
SENSIBLE = {
    "max_depth": (-1, 0, 1, 2, 5, 9),
    "rr_depth": (1, 3, 100),
    "hide_emitters": (False, True),
    "merging": (False, True),
    "light_paths": ("auto", 0, 1, "1/2", 0.25, "1/16"),
    "layers": ("", "strategies", "variance", "denoised", "variance,denoised"),  # stokes: polarized alone
    "target_error": (0.0, 0.1),
    "spp_per_pass": (0, 1, 3),
    "timeout": (-1.0, 0.0, 1e9),
    "heuristic": ("balance", "power"),
    "skip": ("auto", "impossible", "none"),
    "connections": ("auto", "all", "one", "none"),
    "points": ("sobol", "independent"),
    "guiding": ("auto", "always", "photons", "emission", "never"),
    "aovs": ("", "albedo:albedo", "dd:depth,nn:sh_normal"),
}
NAMES = tuple(SENSIBLE)


# Sensible values, and among them mostly one that is not: of many the first alone would be tried.
PARAMETERS = st.builds(
    lambda sensible, wild: sensible | wild,
    st.fixed_dictionaries({}, optional={name: st.sampled_from(SENSIBLE[name]) for name in NAMES}),
    st.just({}) | st.sampled_from(NAMES).flatmap(lambda name: ANYTHING.map(lambda value: {name: value})),
)


def fuzz(strategy, function: Callable, examples: int) -> None:
    """Call ``function`` with examples that are always the same."""
    settled = settings(
        max_examples=examples,
        derandomize=True,
        database=None,
        deadline=None,
        phases=[Phase.generate],
        suppress_health_check=list(HealthCheck),
    )
    settled(given(strategy)(function))()


def _in_words(error: Exception, names) -> bool:
    """Whether an error is one of ours, about a parameter of these ``names``."""
    text = str(error)
    return "bdpt: " in text and any(name in text for name in names)


def _parameters(examples: int, renders: int) -> Outcome:
    """Fuzz the plugin's parameters; render with the first so many different ones that were accepted."""
    counts, wrong, accepted = Counter(), [], {}

    def load(parameters):
        try:
            bdpt = mi.load_dict({"type": "bdpt", **parameters})
        except (TypeError, ValueError, RuntimeError, NotImplementedError) as error:
            counts["refused in words"] += 1
            if not _in_words(error, parameters):
                wrong.append(f"{short(parameters)}: {short(error)}")
        else:
            counts["accepted"] += 1
            accepted.setdefault(str(bdpt), bdpt)

    fuzz(PARAMETERS, load, examples)
    scene = repository.load_scene("cornell_box", resolution=4)
    for bdpt in list(accepted.values())[:renders]:
        try:
            image = np.array(bdpt.render(scene, spp=8))
        except (ValueError, NotImplementedError) as error:
            counts["rendered: refused in words"] += 1
            if not _in_words(error, NAMES):
                wrong.append(f"{bdpt.settings}: {short(error)}")
        else:
            counts["rendered: finite"] += 1
            # A variance of fewer than two replicates is infinite by contract.
            if not np.isfinite(image[..., :3]).all():
                wrong.append(f"{bdpt.settings}: not finite")
    return counted(counts, wrong)


ARGUMENTS = st.fixed_dictionaries(
    {},
    optional={
        name: ANYTHING | st.none() | st.lists(st.integers(0, 2), max_size=2)
        for name in ("spp", "seed", "sensor")
    },
)


def _render_arguments(examples: int) -> Outcome:
    """Fuzz the arguments of `render`; however many samples are accepted, one pass is made."""
    counts, wrong = Counter(), []
    scene = repository.load_scene("cornell_box", resolution=4)
    bdpt = mi.load_dict(
        {"type": "bdpt", "max_depth": 3, "light_paths": 1, "connections": "one", "timeout": 0}
    )

    def render(arguments):
        try:
            image = np.array(bdpt.render(scene, **{"spp": 1} | arguments))
        except (TypeError, ValueError) as error:
            counts["refused in words"] += 1
            if not _in_words(error, arguments):
                wrong.append(f"{short(arguments)}: {short(error)}")
        else:
            counts["rendered"] += 1
            if image.shape != (4, 4, 3) or not np.isfinite(image).all():
                wrong.append(f"{short(arguments)}: {image.shape}, not finite")

    fuzz(ARGUMENTS, render, examples)
    return counted(counts, wrong)


# -- cases ------------------------------------------------------------------------------------


OR_WORDS = (
    "a finite image, or an error that names what is wrong: while loading the element or its line, its "
    "parameter or its value, while rendering in words of ours; where a process dies or does not end, or an "
    "image is not finite, `path` does alike"
)
AS_PATH = (
    f"{OR_WORDS}. Where `path` renders it too, its mean: within ten standard errors of four seeds and 2 % "
    "(so few seeds have heavy tails; a lost lamp or a doubled light is off by far more), but in scenes "
    "without bounds, where `path` sees its environments through all shapes"
)
VARIED = tuple(path.stem for path in sorted((repository.ROOT / "scenes").glob("*.xml")))
# Scenes whose light `path` finds as well.
EASY = ("cornell_box", "many_lights", "open_sky", "veach_mis", "window_room")

CASES = (
    _case(
        "fuzz-parameters",
        "400 dictionaries of parameters, by hypothesis, most with one value that is anything: a word, a "
        "number, "
        "NaN, an infinity, 10^5 letters; 24 that are accepted are rendered",
        "accepted, or an error that names a parameter; images are finite",
        partial(_parameters, 400, 24),
    ),
    _case(
        "fuzz-arguments",
        "150 times anything for `spp`, `seed` and `sensor` of `render`, by hypothesis",
        "a finite image, or an error that names the argument",
        partial(_render_arguments, 150),
        True,
    ),
    _case(
        "fuzz-scene-file",
        "10 changes by chance of `cornell_box.xml`: elements left out, doubled, of another kind; NaN, "
        "infinite, "
        "huge, negative numbers; words for numbers",
        OR_WORDS,
        partial(scene_files.mutated, ("cornell_box",), 10, False),
        True,
    ),
    _case(
        "fuzz-easy-scene-files",
        f"12 such changes of each of {', '.join(f'`{name}`' for name in EASY)}, also rendered by `path`",
        AS_PATH,
        partial(scene_files.mutated, EASY, 12, True),
    ),
    _case(
        "fuzz-scene-files",
        "one such change of each scene of scenes/, means not compared (`path` can't see the light of some)",
        OR_WORDS,
        partial(scene_files.mutated, VARIED, 1, False),
    ),
    _case(
        "film-sizes",
        "films of 0, 1 x 1, 1 x 4097, 40000 x 2, ... pixels in a room of radiance 1",
        "an error that names width, height, both as `0 x 8` or the crop window, or an image of that "
        "size and radiance: within 20 %, for roulette leaves noise in one pixel, and no row or column below "
        "half of it, as one that lost a side of its pixels would be; path tracing alone",
        partial(films.seen, films.SIZES, {"light_paths": 0}),
        True,
    ),
    _case(
        "film-sizes-light-paths",
        "the same with light subpaths",
        "the same",
        partial(films.seen, films.SIZES, {"skip": "none"}),
    ),
    _case(
        "crop-windows",
        "crop windows of one pixel, of a row, of nothing, beyond the film; of 16 x 16 in a film of 10^10 "
        "pixels",
        "as for films of that size",
        partial(films.seen, films.CROPS, {"skip": "none"}),
    ),
    _case(
        "film-huge",
        "films larger than the memory, or of more than 2^32 numbers",
        "an error before anything is allocated (a process has 8 GiB of address space)",
        films.huge,
    ),
    _case(
        "no-number-transforms",
        "NaN, infinities, 3e38 and 1e30 in transforms of camera, shapes and lamp",
        AS_PATH,
        partial(scene_files.no_numbers, scene_files.TRANSFORMS),
    ),
    _case(
        "no-number-emitters",
        "the same as radiance, intensity, place, direction, scale, `sampling_weight` of emitters",
        AS_PATH,
        partial(scene_files.no_numbers, scene_files.EMITTERS),
    ),
    _case(
        "no-number-materials",
        "the same as reflectance, index of refraction, roughness, opacity, weight of a blend",
        AS_PATH,
        partial(scene_files.no_numbers, scene_files.MATERIALS),
    ),
    _case(
        "no-number-textures",
        "one pixel of the same, or -1, in textures: reflectance, radiance, roughness, sky, bump and normal "
        "map",
        AS_PATH,
        partial(scene_files.no_numbers, scene_files.TEXTURES, scene_files.write_textures),
    ),
    _case(
        "no-number-meshes",
        "the same as coordinate or normal of a vertex, faces without area, faces of vertices that don't "
        "exist",
        AS_PATH,
        partial(scene_files.no_numbers, scene_files.MESHES, scene_files.write_meshes),
    ),
    _case(
        "missing-files",
        "`python -m mitsuba_bdpt render` without scene, mesh, texture, include; with half of one",
        "one line that names it, status 2, nothing written",
        outputs.missing_files,
    ),
    _case(
        "outputs-that-cant-be",
        "an output that is a folder, a pipe, a text, a name too long, in a folder that can't be written, ...",
        "an error before anything is rendered, nothing changed on the disk",
        outputs.output_names,
        True,
    ),
    _case(
        "full-disk-image",
        "images too large for the disk, by a little and by far",
        "an error, the former image as it was, nothing left behind",
        outputs.full_disk_image,
    ),
    _case(
        "full-disk-checkpoint",
        "checkpoints too large for the disk",
        "a warning, the image written, nothing left behind",
        outputs.full_disk_checkpoint,
    ),
    _case(
        "full-disk-sweep",
        "`scripts/sweep.py` whose images don't fit on the disk; again where they do",
        "each render that could not be kept is named, no row is kept; then all of them",
        outputs.full_disk_sweep,
    ),
    _case(
        "read-only-disk",
        "a disk that is read-only when the image is to be written",
        "an error, the former image as it was",
        outputs.read_only_disk,
    ),
)
