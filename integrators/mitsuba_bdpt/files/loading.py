"""Loads a scene and its integrator from command-line options."""

from __future__ import annotations

import re
from argparse import Namespace
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import NamedTuple, TypeVar

import mitsuba as mi

from ..errors import CommandError, did_you_mean, listed
from ..host.jit import two_threads
from ..image import features
from ..settings import NONE
from .whole import from_utf8, utf8

_Made = TypeVar("_Made")

SCENES_OWN = "scene"  # what ``--integrator`` calls the integrator of the scene file

KEPT = ("max_depth", "rr_depth", "hide_emitters", "timeout")
"""What an integrator that replaces the scene's takes over: the same paths, in the same time."""

_ADJOINT = ("prb", "prb_basic", "prb_projective", "prbvolpath")

DEPTHS = {"direct": 2, "direct_projective": 2} | dict.fromkeys(_ADJOINT, 6)
"""``max_depth`` of integrators whose paths end as early where the scene file gives them none."""

CROP = ("crop_offset_x", "crop_offset_y", "crop_width", "crop_height")  # parameters of a film's crop window

METERS = {"irradiancemeter": "IrradianceMeter", "radiancemeter": "RadianceMeter"}
"""Sensors whose films `--size` and `--crop` leave alone: plugins and classes."""

AROUND = ("aov", "stokes", "moment")  # Mitsuba's integrators around another one
LISTED = 8  # names that a message lists, at most


@contextmanager
def searching(scene: Path, folders: Iterable[Path] = ()) -> Iterator[None]:
    """Within, Mitsuba looks for files beside the ``scene`` file first, and in ``folders`` last."""
    former = mi.file_resolver()
    own = mi.FileResolver(former)
    own.prepend(utf8(scene.resolve().parent))
    for folder in folders:
        own.append(utf8(folder.resolve()))
    mi.set_file_resolver(own)
    try:
        yield
    finally:
        mi.set_file_resolver(former)


def parsed(
    scene: Path, definitions: Mapping[str, object], config: mi.parser.ParserConfig | None = None
) -> mi.parser.ParserState:
    """Parse a ``scene`` file with ``definitions`` of its parameters; upgrades names of version 0.6."""
    config = config or mi.parser.ParserConfig(mi.variant() or "llvm_ad_rgb")
    state = mi.parser.parse_file(config, utf8(scene), **definitions)
    mi.parser.transform_upgrade(config, state)  # no change when `transform_all` repeats it
    return state


def parsed_anyway(scene: Path, definitions: Mapping[str, object]) -> mi.parser.ParserState:
    """Like `parsed`, but parameters without value are 1, and unused definitions no error."""
    config = mi.parser.ParserConfig(mi.variant() or "llvm_ad_rgb")
    config.unused_parameters = mi.LogLevel.Debug
    while True:
        try:
            return parsed(scene, definitions, config)
        except RuntimeError as error:
            missing = re.search(r"undefined parameter: \$(\w+)", str(error))
            if missing is None:
                raise
            definitions = {**definitions, missing[1]: "1"}


def contents(scene: Path, definitions: Mapping[str, object], folders: Iterable[Path] = ()) -> Iterator[bytes]:
    """Yield the bytes of the files of a ``scene`` and of the existing ones that it names, each once.

    Tables of spectra follow as text: the parser has read their files. ``folders``: see `searching`.
    """
    with searching(scene, folders):
        state = parsed_anyway(scene, definitions)
        held = [(node.props, name, value) for node in state.nodes for name, value in node.props.items()]
        named = (value for _, name, value in held if name == "filename" and isinstance(value, str))
        names = (from_utf8(str(mi.file_resolver().resolve(name))) for name in named)
        files = [from_utf8(str(file)) for file in state.files]
        paths = dict.fromkeys((*files, *filter(Path.is_file, names)))
    yield from map(Path.read_bytes, paths)
    tables = (value for props, name, value in held if props.type(name) == mi.Properties.Type.Spectrum)
    yield from (repr((list(table.wavelengths), list(table.values))).encode() for table in tables)


def in_proportion(scene: Path, definitions: dict) -> dict:
    """Add to ``definitions`` a ``resolution_y`` that keeps the aspect ratio.

    Only if ``resolution`` is defined, ``resolution_y`` is not, and the scene file uses both.
    """
    if "resolution" not in definitions or "resolution_y" in definitions:
        return definitions

    def sizes(definitions: dict) -> list[tuple]:
        nodes = (n for n in parsed(scene, definitions).nodes if n.type == mi.ObjectType.Film)
        return [(film.props.get("width"), film.props.get("height")) for film in nodes]

    others = {name: value for name, value in definitions.items() if name != "resolution"}
    try:
        with searching(scene):
            pairs = zip(sizes(others), sizes(definitions), strict=True)
            width, height, asked = next(
                (w, h, asked) for (w, h), (asked, y) in pairs if asked != w and y == h
            )
            both = definitions | {"resolution_y": max(round(asked * height / width), 1)}
            sizes(both)
    except (RuntimeError, StopIteration, TypeError, ZeroDivisionError):
        return definitions  # Mitsuba's parser decides
    return both


class Loaded(NamedTuple):
    """A scene and its integrator; ``used`` describes the choice of the integrator."""

    scene: mi.Scene
    integrator: mi.Integrator
    used: str


def load(options: Namespace) -> Loaded:
    """Load the scene and the integrator to render it with."""
    if options.integrator == "":
        raise CommandError("integrator='' names no integrator; use for example bdpt, or leave it out.")
    check_file(options.scene)
    for folder in options.append:
        if not folder.is_dir():
            raise CommandError(
                f"append={str(folder)!r} is no folder; give one that holds files of the scene."
            )
    set_variant(options.variant)
    with searching(options.scene, options.append):
        return unless_incompatible(lambda merges: _load(options, merges))


def set_variant(name: str) -> None:
    """Set Mitsuba's variant; raises ``CommandError`` if there is none of this ``name``, or not here."""
    if name not in mi.variants():
        question = did_you_mean(name, mi.variants())
        known = ", ".join(mi.variants())
        raise CommandError(f"variant={name!r} is not one of Mitsuba's: {known}; {question}".rstrip("; "))
    try:
        mi.set_variant(name)
    except ImportError as error:
        raise CommandError(
            f"variant={name!r} cannot be used on this machine ({str(error).rstrip('.')}); use an LLVM "
            "variant, for example llvm_ad_rgb."
        ) from error


def unless_incompatible(made: Callable[[bool], _Made]) -> _Made:
    """Return ``made(True)``, a scene with the meshes of a BSDF merged, or ``made(False)`` if they cannot be.

    Mitsuba refuses to merge meshes of which some have ``flip_normals``.
    """
    with two_threads():  # for textures in EXR files
        try:
            return made(True)
        except RuntimeError as error:
            if "Mesh::merge()" not in str(error):
                raise
        return made(False)


def _load(options: Namespace, merges: bool) -> Loaded:
    """Like `load`, for an existing scene file and with the variant set; ``merges`` meshes of a BSDF."""
    overrides = dict(options.properties)
    if options.time is not None:
        overrides["timeout"] = options.time
    asked = None if options.integrator == SCENES_OWN else options.integrator
    config = mi.parser.ParserConfig(mi.variant())
    config.merge_meshes = merges
    state = parsed(options.scene, in_proportion(options.scene, dict(options.defines)), config)
    _check_root(state, options.scene)
    for film in _films_of_images(state):
        set_film_size(film.props, options.size, options.crop)
    if len(_meters(state)) > 1:  # equal ones would be merged, and rejected on a second shape
        config.merge_equivalent = False
    # Nodes are in file order: an integrator precedes those nested in it.
    node = next((node for node in state.nodes if node.type == mi.ObjectType.Integrator), None)
    own = node.props.plugin_name() if node is not None else None
    used = asked or own or "bdpt"
    for name in ("target_error", "denoise"):
        if getattr(options, name) and used != "bdpt":
            raise CommandError(f"{name} is for the integrator bdpt, not for {used}; use --integrator bdpt.")
    if options.target_error is not None:
        overrides["target_error"] = options.target_error
    if asked in AROUND and own != asked and (asked != "aov" or not overrides.get("aovs")):
        raise CommandError(
            f"integrator={asked} is for one around another, which the command line cannot "
            "name: write both into the scene file (for bdpt, -P aovs=NAME:KIND and -P layers=stokes do)."
        )
    kept = {} if node is None else replace_integrator(state.nodes, node, asked, overrides)
    if options.denoise:
        given = overrides if node is None else node.props
        given["layers"] = _added(given.get("layers", ""), "denoised")
    choice = _in_place_of(own, used, kept, asked)
    mi.parser.transform_all(config, state)
    # The stub says object; `_check_root` has verified that it is a scene.
    scene: mi.Scene = mi.parser.instantiate(config, state)  # pyright: ignore[reportAssignmentType]
    _check_no_meter(scene, options)
    if node is not None:
        return Loaded(scene, scene.integrator(), choice)
    made = mi.load_dict({"type": used, **overrides})
    if not isinstance(made, mi.Integrator):
        raise CommandError(
            f"integrator={used!r} is a plugin of class {made.class_name()}, no integrator; use bdpt"
        )
    return Loaded(scene, made, choice)


def _in_place_of(own: str | None, used: str, kept: Mapping[str, object], asked: str | None) -> str:
    """Describe the integrator ``used`` in place of the file's ``own``, with the ``kept`` parameters."""
    if own is None:
        return f"{used} (the scene file has no integrator)"
    if asked is None or own == used:
        return f"{used}, the scene file's own"
    values = ", ".join(f"{name}={value}" for name, value in kept.items())
    return (
        f"{used} in place of the scene file's {own}{values and f', with its {values}'}; "
        f"--integrator {SCENES_OWN} renders with {own}"
    )


def _check_root(state: mi.parser.ParserState, scene: Path) -> None:
    """Raise ``CommandError`` if the root of the file ``scene`` is not a scene."""
    root = state.nodes[0]
    if root.type != mi.ObjectType.Scene:
        held = f"{root.type.name.lower()} {root.props.plugin_name()}"
        raise CommandError(
            f"scene={str(scene)!r} holds a single object, {held}, and no <scene>: write one around it, with "
            "a sensor and lights."
        )


def _meters(state: mi.parser.ParserState) -> list:
    """Return the nodes of sensors without image: at a point, along a ray, on a shape."""
    sensors = [node for node in state.nodes if node.type == mi.ObjectType.Sensor]
    return [node for node in sensors if node.props.plugin_name() in METERS]


def _films_of_images(state: mi.parser.ParserState) -> list:
    """Return the nodes of all films but those of meters."""
    values = [value for node in _meters(state) for _, value in node.props.items()]
    held = {value.index() for value in values if isinstance(value, mi.Properties.ResolvedReference)}
    held |= {state.id_to_index.get(v.id(), -1) for v in values if isinstance(v, mi.Properties.Reference)}
    films = ((i, node) for i, node in enumerate(state.nodes) if node.type == mi.ObjectType.Film)
    return [node for i, node in films if i not in held]


def _check_no_meter(scene: mi.Scene, options: Namespace) -> None:
    """Raise ``CommandError`` if ``--size`` or ``--crop`` is given for a meter."""
    given = next((name for name in ("size", "crop") if getattr(options, name)), None)
    if given is None:
        return
    if choose_sensor(scene, options.sensor).class_name() in METERS.values():
        written = ("x" if given == "size" else ",").join(map(str, getattr(options, given)))
        raise CommandError(
            f"{given}={written} is for images, and sensor {options.sensor} is a meter, whose film keeps its "
            f"size; leave out --{given}, or choose another sensor by --sensor."
        )


def set_film_size(film: mi.Properties, size: Sequence[int] | None, crop: Sequence[int] | None) -> None:
    """Set a ``film``'s ``size`` (width, height) and ``crop`` (x, y, width, height).

    Raises ``CommandError`` if the window exceeds the image, or was set for another size.
    """
    of_scene = [name for name in CROP if name in film]
    if size is not None:
        if of_scene and crop is None:
            raise CommandError(
                f"size={size[0]}x{size[1]} is for a film with a crop window ({of_scene[0]}="
                f"{film[of_scene[0]]}), which is one of the scene's own size; give --crop X,Y,W,H too."
            )
        film["width"], film["height"] = size
    if crop is None:
        return
    # Mitsuba's default size.
    width, height = int(film.get("width", 768)), int(film.get("height", 576))
    if crop[0] + crop[2] > width or crop[1] + crop[3] > height:
        raise CommandError(
            f"crop={','.join(map(str, crop))} is not within the image of {width}x{height} pixels; give "
            "X,Y,W,H."
        )
    for name, value in zip(CROP, crop, strict=True):
        film[name] = value


def check_file(scene: Path) -> None:
    """Raise ``CommandError`` if the ``scene`` file does not exist, with the files that do."""
    if not scene.is_file():
        folder = scene if scene.is_dir() else scene.parent
        there = sorted(path.name for path in folder.glob("*.xml"))
        found = f"the folder {str(folder)!r} has {listed(there, LISTED) or 'no scene files (.xml)'}"
        question = did_you_mean(scene.name, there)
        raise CommandError(f"scene={str(scene)!r} is not a file; {question}{found}")


def replace_integrator(
    nodes: Sequence, node, kind: str | None, overrides: Mapping[str, bool | int | float | str]
) -> dict[str, object]:
    """Set the ``kind`` of the integrator ``node``, if given, and ``overrides``; returns what is kept.

    `bdpt` replaces integrators around another (`AROUND`) as a whole, since it has their layers; others
    replace the innermost integrator. Raises ``CommandError`` for layers that cannot be kept.
    """
    given, layers = node.props, {}
    if kind == "bdpt" and given.plugin_name() in AROUND:
        given, layers = _layers(nodes, node)
    while kind not in (None, *AROUND) and given.plugin_name() in AROUND:
        node = _nested(nodes, node)[1]
        given = node.props
    node.props = integrator_properties(given, kind, layers | overrides)
    kept = [name for name in (*KEPT, *layers) if name in node.props and name not in overrides]
    return {name: node.props[name] for name in dict.fromkeys(kept)}


def _added(layers: str, more: str) -> str:
    """Return the parameter ``layers`` with one ``more``; the plugin rejects what is no text."""
    if not isinstance(layers, str):
        return layers
    return more if layers in ("", NONE) else f"{layers},{more}"


def _layers(nodes: Sequence, node) -> tuple[mi.Properties, dict]:
    """Return the innermost properties, and the layers and ``timeout`` that `bdpt` takes from outer ones."""
    aovs, carried, prefix = [], {}, ""
    while (kind := node.props.plugin_name()) in AROUND:
        if kind == "moment":
            raise CommandError(
                "integrator=bdpt cannot replace the scene's integrator moment, which is around another and "
                "adds second moments, which bdpt does not have (its layers=variance is the variance of each "
                f"pixel); render with the scene file's own by --integrator {SCENES_OWN}, or write the inner "
                "integrator alone into the file."
            )
        if kind == "stokes":
            carried["layers"] = "stokes"
        else:
            aovs += [prefix + pair for pair in features.pairs(node.props.get("aovs", ""))]
        if "timeout" in node.props:
            carried.setdefault("timeout", node.props["timeout"])
        name, node = _nested(nodes, node)
        prefix += f"{name}." if kind == "aov" else ""
    if kind == "bdpt":
        aovs += [pair for pair in features.pairs(node.props.get("aovs", "")) if pair != NONE]
        if "layers" in carried:
            carried["layers"] = _added(node.props.get("layers", ""), carried["layers"])
    return node.props, carried | ({"aovs": ",".join(aovs)} if aovs else {})


def _nested(nodes: Sequence, node) -> tuple[str, object]:
    """Return name and node of the single integrator nested in ``node``."""
    held = [(key, node.props[key]) for key in node.props.keys()]
    found = [(key, nodes[v.index()]) for key, v in held if isinstance(v, mi.Properties.ResolvedReference)]
    found = [(key, inner) for key, inner in found if inner.type == mi.ObjectType.Integrator]
    if len(found) != 1:
        names = ", ".join(f"{key!r} ({inner.props.plugin_name()})" for key, inner in found)
        remedy = "leave out the others" if found else "write one inside of it"
        raise CommandError(
            f"integrator: the scene's integrator {node.props.plugin_name()} is around {names or 'none'}; to "
            f"replace the one inside, there has to be just one: in the scene file, {remedy}."
        )
    return found[0]


def integrator_properties(
    given: mi.Properties, kind: str | None, overrides: Mapping[str, bool | int | float | str]
) -> mi.Properties:
    """Return the `given` properties with `overrides`, for a plugin of `kind` if set."""
    if kind is None or kind == given.plugin_name():
        properties = mi.Properties(given)
    else:
        properties = mi.Properties(kind)
        properties.set_id(given.id())
        depth = {"max_depth": DEPTHS.get(given.plugin_name())}
        for key, value in (depth | {key: given[key] for key in KEPT if key in given}).items():
            if value is not None:
                properties[key] = value
                properties.mark_queried(key)  # not every integrator has all of them, which is no error
    for key, value in overrides.items():
        properties[key] = value
    return properties


def choose_sensor(scene: mi.Scene, index: int) -> mi.Sensor:
    sensors = scene.sensors()
    if not sensors:
        raise CommandError("The scene has no sensor; add one to the scene file.")
    if index >= len(sensors):
        raise CommandError(f"sensor={index} is not in the scene; the last one is {len(sensors) - 1}.")
    return sensors[index]
