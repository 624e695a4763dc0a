"""Scenes for measurements, from files and dictionaries, at any size and sampler."""

from __future__ import annotations

import hashlib
import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any, NamedTuple

import mitsuba as mi
import numpy as np

from ..errors import CommandError, message
from ..files.loading import (
    choose_sensor,
    named_files,
    parsed,
    parsed_anyway,
    searching,
    spectra,
    unless_incompatible,
)
from ..files.whole import from_utf8
from ..host.introspection import media_of


class _Look(NamedTuple):
    """A scene's integrator, `has_media`, the size of its film, and whether that has colours."""

    integrator: mi.Integrator
    has_media: bool
    size: tuple[int, int]
    has_colours: bool


class MeasuredScene:
    """A scene with a ``name``, the key of its references and rows.

    ``called``: its name in messages; ``sha256``: SHA-256 of the scene and of all files that it names.
    """

    name: str
    called: str
    sha256: str

    def _parsed(self, config: mi.parser.ParserConfig) -> mi.parser.ParserState:
        raise NotImplementedError

    def _instantiated(self, sampler: str | None, merges: bool = True) -> mi.Scene:
        """Return the scene; with another type of ``sampler`` unless None. ``merges`` meshes of a BSDF."""
        config = mi.parser.ParserConfig(mi.variant())
        config.parallel, config.merge_meshes = False, merges
        state = self._parsed(config)
        if sampler is not None:
            sensors = [node for node in state.nodes if node.type == mi.ObjectType.Sensor]
            if not sensors:
                raise CommandError(f"scene={self.called} has no sensor; add one to it.")
            _replace_sampler(state.nodes, sensors[0], sampler)
        mi.parser.transform_all(config, state)
        # The stub says object.
        return mi.parser.instantiate(config, state)  # pyright: ignore[reportReturnType]

    def load(self, resolution: int | None = None, sampler: str | None = None) -> mi.Scene:
        """Load the scene, ``resolution`` pixels wide, with a ``sampler`` of this type.

        Size and sampler are of the first sensor; None keeps the scene's own. Raises ``CommandError`` for a
        scene without sensor, ``RuntimeError`` (of Mitsuba) for an invalid one.
        """
        scene = unless_incompatible(lambda merges: self._instantiated(sampler, merges))
        if resolution is not None:
            _resize(scene, resolution)
        return scene

    def size(self, resolution: int | None = None) -> tuple[int, int]:
        """Return width and height of the image that `load` gives.

        Raises ``CommandError`` for a film without colours.
        """
        if not self._look.has_colours:
            raise CommandError(
                f"scene={self.called}: its film has no colours, of which errors are taken; give it the "
                'pixel_format "rgb"'
            )
        return self._look.size if resolution is None else _widened(self._look.size, resolution)

    @cached_property
    def max_depth(self) -> int:
        """The integrator's ``max_depth``; -1 (no limit) without one."""
        return depth_of(self._look.integrator)

    @cached_property
    def has_media(self) -> bool:
        """Whether rays can be in a medium, see `has_media`."""
        return self._look.has_media

    @cached_property
    def _look(self) -> _Look:
        """Loads the scene once, which may be slow."""
        scene = self.load()
        film = choose_sensor(scene, 0).film()
        width, height = map(int, film.size())
        return _Look(scene.integrator(), has_media(scene), (width, height), film.base_channels_count() >= 3)


@dataclass(frozen=True)
class SceneFile(MeasuredScene):
    """A scene in an XML ``file``."""

    name: str
    file: Path

    def __reduce__(self):
        """For workers: without what is cached."""
        return SceneFile, (self.name, self.file.resolve())

    @property
    def called(self) -> str:
        return repr(str(self.file))

    @property
    def sha256(self) -> str:
        with searching(self.file):
            state = parsed_anyway(self.file, {})
            content = [*(file.read_bytes() for file in named_files(state)), *map(str.encode, spectra(state))]
        return hashlib.sha256(b"".join(content)).hexdigest()

    def _instantiated(self, sampler: str | None, merges: bool = True) -> mi.Scene:
        with searching(self.file):
            return super()._instantiated(sampler, merges)

    def _parsed(self, config: mi.parser.ParserConfig) -> mi.parser.ParserState:
        return parsed(self.file, {}, config)


class DictionaryScene(MeasuredScene):
    """A scene as a ``dictionary`` for ``mi.load_dict``.

    Raises ``CommandError`` unless sensors and films are dictionaries too: measurements change their size and
    sampler.
    """

    def __init__(self, name: str, dictionary: Mapping[str, Any]):
        if not isinstance(dictionary, Mapping) or dictionary.get("type") != "scene":
            raise CommandError(f"scene={name!r} must be a dictionary of type 'scene', as of mi.load_dict")
        self.name, self._dictionary = name, _copied(dictionary)
        for key, value in self._dictionary.items():
            held = value if isinstance(value, dict) else {"": value}
            if made := [inner for inner in held.values() if isinstance(inner, mi.Sensor | mi.Film)]:
                raise CommandError(
                    f"scene={name!r}: {key!r} holds a {type(made[0]).__name__} that is made already; give "
                    "sensors and films as dictionaries, since images of other sizes are measured"
                )

    @classmethod
    def named_by_content(cls, dictionary: Mapping[str, Any]) -> DictionaryScene:
        """Name a dictionary by a hash of its content."""
        unnamed = cls("scene", dictionary)
        return cls(f"scene_{unnamed.sha256[:8]}", dictionary)

    @property
    def called(self) -> str:
        return f"the dictionary {self.name!r}"

    @property
    def sha256(self) -> str:
        return hashlib.sha256(b"".join(_bytes_of(self._dictionary, self.name))).hexdigest()

    def _parsed(self, config: mi.parser.ParserConfig) -> mi.parser.ParserState:
        return mi.parser.parse_dict(config, self._dictionary)


def _copied(dictionary: Mapping) -> dict:
    return {key: _copied(value) if isinstance(value, Mapping) else value for key, value in dictionary.items()}


def _bytes_of(value: Any, where: str) -> Iterator[bytes]:
    """Yield the bytes of a scene dictionary's ``value``; ``where``: its key.

    Raises ``CommandError`` for objects whose content cannot be hashed.
    """
    if isinstance(value, Mapping):
        for key, held in value.items():
            yield f"{len(value)} {key}".encode()
            yield from _bytes_of(held, f"{where}.{key}")
        if isinstance(name := value.get("filename"), str):
            path = from_utf8(str(mi.file_resolver().resolve(name)))
            yield path.read_bytes() if path.is_file() else b""
    elif value is None or isinstance(value, str | bool | int | float):
        yield f"{type(value).__name__} {value!r}".encode()
    elif isinstance(value, list | tuple):
        for held in value:
            yield from _bytes_of(held, where)
    elif isinstance(value, mi.Object):
        yield value.class_name().encode()
        parameters = mi.traverse(value)
        for key in parameters.keys():
            yield key.encode()
            yield from _bytes_of(parameters[key], f"{where}.{key}")
    else:
        array = np.array(getattr(value, "matrix", value))
        if array.dtype == object:
            raise CommandError(
                f"{where} is a {type(value).__name__}, of which it cannot be known whether it has changed "
                "since a reference was made; give a dictionary, a number, a text or an array"
            )
        yield f"{array.dtype} {array.shape}".encode()
        yield array.tobytes()


def digest(*paths: Path) -> str:
    return hashlib.sha256(b"".join(path.read_bytes() for path in paths)).hexdigest()


def has_media(scene: mi.Scene) -> bool:
    """Return whether a sensor is in a medium, or a shape bounds one."""
    return bool(media_of(scene, scene.sensors()))


def path_tracers(media: bool) -> tuple[str, ...]:
    """Return Mitsuba's path tracers for a scene with or without media (`has_media`).

    `path` ignores media; without media the others are slower.
    """
    return ("volpath", "volpathmis") if media else ("path",)


def depth_of(integrator) -> int:
    """Return an integrator's ``max_depth``; -1 without one. Mitsuba's only print it."""
    depth = getattr(integrator, "max_depth", None)
    if depth is None:
        found = re.search(r"\bmax_depth = (\d+)", str(integrator))
        depth = int(found[1]) if found else -1
    return depth if depth < 2**31 else -1  # Mitsuba's unlimited depth is unsigned


def integrator_of(parameters: Mapping[str, Any], depth: int) -> mi.Integrator:
    """Return the plugin with ``parameters`` (with ``type``) at ``max_depth``."""
    return mi.load_dict({"max_depth": depth, **parameters})


def samples_taken(scene: mi.Scene, integrator: mi.Integrator, spp: int) -> int:
    """Return the samples per pixel that a render takes if it is asked for ``spp``.

    `bdpt` has points of its own; of other integrators the sensor's sampler may round up, as `multijitter`
    32 to 5 x 7, with a warning that names neither. What is measured is asked for this number.
    """
    if hasattr(integrator, "statistics"):
        return spp
    level = mi.log_level()
    mi.set_log_level(mi.LogLevel.Error)
    try:
        fork = choose_sensor(scene, 0).sampler().fork()
        fork.set_sample_count(spp)
        return int(fork.sample_count())
    finally:
        mi.set_log_level(level)


def check_plugins(name: str, parameters: Mapping[str, Any], sampler: str | None, depth: int) -> None:
    for what, make in (
        (f"integrator {name!r}", lambda: integrator_of(parameters, depth)),
        (f"sampler of {name!r}", lambda: mi.load_dict({"type": sampler}) if sampler else None),
    ):
        try:
            make()
        except (RuntimeError, TypeError) as error:
            last = message(error).strip().splitlines()[-1]
            raise CommandError(f"{what}: {last}") from error


def _widened(size: tuple[int, int], width: int) -> tuple[int, int]:
    return width, max(round(width * size[1] / size[0]), 1)


def _resize(scene: mi.Scene, width: int) -> None:
    """Scale the first sensor's film to a width, however the file sets its size, without crop window."""
    old_width, old_height = map(int, choose_sensor(scene, 0).film().size())
    size = list(_widened((old_width, old_height), width))
    changed = mi.traverse(scene.sensors()[0])
    changed["film.size"] = changed["film.crop_size"] = size
    changed["film.crop_offset"] = [0, 0]
    changed.update()


def _replace_sampler(nodes, sensor, kind: str) -> None:
    """Replace the sampler of ``sensor``, one of the ``nodes``, by another ``kind``.

    Its sample count is Mitsuba's default, since all renders say theirs, see `samples_taken`.
    """
    properties = mi.Properties(kind)
    for key in sensor.props.keys():
        held = sensor.props[key]
        if isinstance(held, mi.Properties.ResolvedReference):
            node = nodes[held.index()]
            if node.type == mi.ObjectType.Sampler:
                properties.set_id(node.props.id())
                node.props = properties
                return
    node = mi.parser.SceneNode()
    node.type, node.props = mi.ObjectType.Sampler, properties
    # Before the list grows, which invalidates Python's references to its entries.
    sensor.props["sampler"] = mi.Properties.ResolvedReference(len(nodes))
    nodes.append(node)
