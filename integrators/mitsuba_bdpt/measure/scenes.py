"""Scene files as measurements load them: at any size, with any sampler, whatever parameters they have."""

from __future__ import annotations

import hashlib
import re
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import mitsuba as mi

from ..errors import CommandError, message
from ..files.loading import choose_sensor, in_proportion, parameters
from ..files.named import named_files
from ..media.media import media_of


@dataclass(frozen=True)
class _Look:
    """Of a scene its ``integrator``, `has_media`, and the image's ``size``, or why it has none."""

    integrator: mi.Integrator
    has_media: bool
    size: tuple[int, int] | CommandError


@dataclass(frozen=True)
class SceneFile:
    """A scene by its ``name``, under which references and rows are kept, and its XML ``file``."""

    name: str
    file: Path

    def load(self, resolution: int | None = None, sampler: str | None = None, **definitions):
        """The ``mi.Scene`` with an image so many pixels wide and a sampler of the type ``sampler``.

        The image keeps the film's proportions, the sampler is the first sensor's; what is None stays as in
        the file.

        Where the file has parameters ``$resolution`` and ``$sampler`` these are set, as are those of
        ``definitions``; else film and sampler are changed. Raises ``CommandError`` for a scene without
        sensor, ``RuntimeError`` (of Mitsuba) for a file that cannot be loaded.
        """
        asked = {"resolution": resolution, "sampler": sampler}
        known = parameters(self.file)
        definitions |= {key: value for key, value in asked.items() if value is not None and key in known}
        definitions = in_proportion(self.file, definitions)
        if sampler is None or "sampler" in known:
            scene = mi.load_file(str(self.file), parallel=False, **definitions)
        else:
            scene = _with_sampler(self.file, sampler, definitions)
        if resolution is not None and "resolution" not in known:
            _resize(scene, resolution)
        return scene

    def size(self, resolution: int | None = None) -> tuple[int, int]:
        """Width and height of the image.

        Raises ``CommandError`` for a film without colours, which no measure of errors takes.
        """
        own = self._look.size
        if isinstance(own, CommandError):
            raise own
        if resolution is None:
            return own
        if "resolution" not in parameters(self.file):
            return _widened(own, resolution)
        return _size_of(self.load(resolution), self.file)  # the file may set any size by its parameter

    @cached_property
    def max_depth(self) -> int:
        """That of the file's integrator; -1 (no limit) without one."""
        return depth_of(self._look.integrator)

    @cached_property
    def tells_depth(self) -> bool:
        """Whether the file's integrator has a ``max_depth``."""
        made = self._look.integrator
        return hasattr(made, "max_depth") or "max_depth" in str(made)

    @cached_property
    def has_media(self) -> bool:
        """Whether rays can be in a medium, see `has_media`."""
        return self._look.has_media

    @cached_property
    def _look(self) -> _Look:
        """What one loading of the file, which may take long, tells of it."""
        scene = self.load()
        try:
            size = _size_of(scene, self.file)
        except CommandError as error:  # matters to those alone who ask for it
            size = error
        return _Look(scene.integrator(), has_media(scene), size)

    @property
    def sha256(self) -> str:
        """SHA-256 of the file and of the meshes and textures that it names."""
        return digest(self.file, *named_files(self.file))


def digest(*paths: Path) -> str:
    """SHA-256 of files, one after the other."""
    return hashlib.sha256(b"".join(path.read_bytes() for path in paths)).hexdigest()


def has_media(scene: mi.Scene) -> bool:
    """Whether rays of a scene can be in a medium: some sensor is in one, or some shape bounds one."""
    return bool(media_of(scene, scene.sensors()))


def path_tracers(media: bool) -> tuple[str, ...]:
    """Types of Mitsuba's path tracers that render a scene with or without media (`has_media`) as it is.

    `path` sees no media; without them the others are the same path tracer, but slower.
    """
    return ("volpath", "volpathmis") if media else ("path",)


def depth_of(integrator) -> int:
    """The ``max_depth`` of an integrator, which Mitsuba's own tell in their text alone; -1 without one."""
    depth = getattr(integrator, "max_depth", None)
    if depth is None:
        found = re.search(r"\bmax_depth = (\d+)", str(integrator))
        depth = int(found[1]) if found else -1
    return depth if depth < 2**31 else -1  # Mitsuba's own hold -1 without a sign


def integrator_of(parameters: dict, depth: int):
    """The plugin with these ``parameters``, ``type`` among them, at the ``max_depth`` of the scene."""
    return mi.load_dict({"max_depth": depth} | parameters)


def check_plugins(name: str, parameters: dict, sampler: str | None, depth: int) -> None:
    """Raise ``CommandError`` if a plugin or its sampler cannot be made.

    The plugin has these ``parameters`` and is called ``name``; ``sampler`` is the sampler's type.
    """
    for what, make in (
        (f"integrator {name!r}", lambda: integrator_of(parameters, depth)),
        (f"sampler of {name!r}", lambda: mi.load_dict({"type": sampler}) if sampler else None),
    ):
        try:
            make()
        except (RuntimeError, TypeError) as error:
            last = message(error).strip().splitlines()[-1]
            raise CommandError(f"{what}: {last}") from error


def _size_of(scene: mi.Scene, file: Path) -> tuple[int, int]:
    """Width and height of the first sensor's image; raises ``CommandError`` as `SceneFile.size`."""
    film = choose_sensor(scene, 0).film()
    if film.base_channels_count() < 3:
        raise CommandError(
            f"scene={str(file)!r}: its film has no colours, of which errors are taken; write "
            'pixel_format "rgb" into the scene file'
        )
    width, height = film.size()
    return int(width), int(height)


def _widened(size: tuple[int, int], width: int) -> tuple[int, int]:
    """A film's ``size`` made so many pixels wide."""
    return width, max(round(width * size[1] / size[0]), 1)


def _resize(scene, width: int) -> None:
    """Make the first sensor's film so many pixels wide, in its proportions, without a crop window."""
    old_width, old_height = choose_sensor(scene, 0).film().size()
    size = list(_widened((int(old_width), int(old_height)), width))
    changed = mi.traverse(scene.sensors()[0])
    changed["film.size"] = size
    changed["film.crop_offset"] = [0, 0]
    changed["film.crop_size"] = size
    changed.update()


def _with_sampler(file: Path, kind: str, definitions: dict):
    """The scene of a ``file`` with its first sensor's sampler replaced, which keeps its sample count."""
    config = mi.parser.ParserConfig(mi.variant())
    config.parallel = False
    with _names_resolved_beside(file):
        state = mi.parser.parse_file(config, str(file), **definitions)
        sensors = [node for node in state.nodes if node.type == mi.ObjectType.Sensor]
        if not sensors:
            raise CommandError(f"scene={str(file)!r} has no sensor; add one to the scene file.")
        _replace_sampler(state.nodes, sensors[0], kind)
        mi.parser.transform_all(config, state)
        return mi.parser.instantiate(config, state)


def _replace_sampler(nodes, sensor, kind: str) -> None:
    """Give a ``sensor``, one of the ``nodes`` of a scene file, a sampler of another ``kind``."""
    properties = mi.Properties(kind)
    for key in sensor.props.keys():
        held = sensor.props[key]
        if isinstance(held, mi.Properties.ResolvedReference):
            node = nodes[held.index()]
            if node.type == mi.ObjectType.Sampler:
                if "sample_count" in node.props:
                    properties["sample_count"] = node.props["sample_count"]
                properties.set_id(node.props.id())
                node.props = properties
                return
    node = mi.parser.SceneNode()
    node.type, node.props = mi.ObjectType.Sampler, properties
    # Before the list grows: what Python holds of its entries is then no longer there.
    sensor.props["sampler"] = mi.Properties.ResolvedReference(len(nodes))
    nodes.append(node)


@contextmanager
def _names_resolved_beside(file: Path):
    """Mitsuba looks for meshes and textures beside the ``file`` first."""
    former = mi.file_resolver()
    own = mi.FileResolver(former)
    own.prepend(str(file.resolve().parent))
    mi.set_file_resolver(own)
    try:
        yield
    finally:
        mi.set_file_resolver(former)
