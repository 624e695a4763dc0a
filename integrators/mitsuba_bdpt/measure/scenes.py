"""Scene files for measurements, at any size and with any sampler."""

from __future__ import annotations

import hashlib
import re
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import mitsuba as mi

from ..errors import CommandError, message
from ..files.loading import choose_sensor, contents, parsed, searching, unless_incompatible
from ..host.introspection import media_of


@dataclass(frozen=True)
class SceneFile:
    """A scene in an XML ``file``, with a ``name``, the key of its references and rows."""

    name: str
    file: Path

    @property
    def sha256(self) -> str:
        """SHA-256 of the scene and of all files that it names."""
        return hashlib.sha256(b"".join(contents(self.file, {}))).hexdigest()

    def _instantiated(self, sampler: str | None, merges: bool) -> mi.Scene:
        """Return the scene, with a ``sampler`` unless None; ``merges`` meshes of a BSDF."""
        config = mi.parser.ParserConfig(mi.variant())
        config.parallel, config.merge_meshes = False, merges
        with searching(self.file):
            state = parsed(self.file, {}, config)
            if sampler is not None:
                sensors = [node for node in state.nodes if node.type == mi.ObjectType.Sensor]
                if not sensors:
                    raise CommandError(f"scene={str(self.file)!r} has no sensor; add one to it.")
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
        _, _, size, channels = self._look
        if channels < 3:
            raise CommandError(
                f"scene={str(self.file)!r}: its film has no colours, of which errors are taken; give it the "
                'pixel_format "rgb"'
            )
        return size if resolution is None else _widened(size, resolution)

    @property
    def max_depth(self) -> int:
        """The integrator's ``max_depth``; -1 (no limit) without one."""
        return self._look[0]

    @property
    def has_media(self) -> bool:
        """Whether a sensor is in a medium, or a shape bounds one."""
        return self._look[1]

    @cached_property
    def _look(self) -> tuple[int, bool, tuple[int, int], int]:
        """`max_depth`, `has_media`, the film's size and number of channels."""
        scene = self.load()
        film = choose_sensor(scene, 0).film()
        width, height = map(int, film.size())
        has_media = bool(media_of(scene, scene.sensors()))
        return depth_of(scene.integrator()), has_media, (width, height), film.base_channels_count()


def digest(*paths: Path) -> str:
    return hashlib.sha256(b"".join(path.read_bytes() for path in paths)).hexdigest()


def path_tracers(media: bool) -> tuple[str, ...]:
    """Return Mitsuba's path tracers for a scene with or without media."""
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
    """Scale the first sensor's film to a width; removes its crop window."""
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
    held = [sensor.props[key] for key in sensor.props.keys()]
    named = {one.id() for one in held if isinstance(one, mi.Properties.Reference)}  # by <ref id="..."/>
    inside = {one.index() for one in held if isinstance(one, mi.Properties.ResolvedReference)}
    for i, node in enumerate(nodes):
        if node.type == mi.ObjectType.Sampler and (i in inside or node.props.id() in named):
            properties.set_id(node.props.id())
            node.props = properties
            return
    node = mi.parser.SceneNode()
    node.type, node.props = mi.ObjectType.Sampler, properties
    # Before the list grows, which invalidates Python's references to its entries.
    sensor.props["sampler"] = mi.Properties.ResolvedReference(len(nodes))
    nodes.append(node)
