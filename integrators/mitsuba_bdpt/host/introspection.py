"""Children and parameters of Mitsuba's objects; versions of the software."""

from __future__ import annotations

import importlib.metadata
import re
from collections.abc import Iterable
from functools import cache

import drjit as dr
import mitsuba as mi
import numpy as np

from .._version import __version__

# Classes of textures, one or more for each BSDF, that hold no other object: not asked for `children`.
LEAVES = frozenset({"SRGBReflectanceSpectrum", "UniformSpectrum"})


def number(x) -> float:
    return float(*x) if dr.is_array_v(x) else float(x)


def given_id(owner) -> str:
    """Return the id of an object, empty if it has none or one that Mitsuba made up."""
    return "" if owner.id().startswith("_unnamed_") else owner.id()


def named(owner) -> str:
    """Identify an object in a message: by its id, that of its shape or BSDF, or its class name."""
    if given_id(owner):
        return f"'{owner.id()}'"
    of = owner.get_shape() if isinstance(owner, (mi.Emitter, mi.Sensor)) else None
    of = owner.bsdf() if isinstance(owner, mi.Shape) else of  # Mitsuba merges the meshes of a BSDF
    if of is not None and given_id(of):
        return f"without id {'on shape' if isinstance(of, mi.Shape) else 'with BSDF'} '{of.id()}'"
    return f"without id ({owner.class_name()})"


def plugin_name(emitter: mi.Emitter) -> str:
    """Return the name of an emitter's plugin, from that of its class."""
    name = re.sub("(Background)?(Emitter|Light)$", "", emitter.class_name()).lower()
    return {"environmentmap": "envmap", "timedsunsky": "timed_sunsky", "": "emitter"}.get(name, name)


def children(owner) -> dict:
    """Return the child objects and numbers that ``owner.traverse`` reports, by name."""
    return _collector(mi.variant())().of(owner)


def parts(plugin: mi.Object, name: str = "") -> list[tuple[str, mi.Object]]:
    """Return ``plugin`` and all that it holds, each after its holder and with its ``name`` there."""
    held = {} if plugin.class_name() in LEAVES else children(plugin)
    inner = (parts(held[key], key) for key in sorted(held) if isinstance(held[key], mi.Object))
    return [(name, plugin), *(part for found in inner for part in found)]


def is_instance(shape: mi.Shape) -> bool:
    return shape.class_name() == "Instance"


def shape_groups(scene: mi.Scene) -> list[mi.Shape]:
    """Return the scene's shape groups."""
    shapes = [c for c in children(scene).values() if isinstance(c, mi.Shape)]
    return [shape for shape in shapes if shape.class_name().startswith("ShapeGroup")]


def shapes_in(group: mi.Shape) -> list[mi.Shape]:
    """Return the shapes of a shape group, in the order of their indices at hits."""
    return [shape for shape in children(group).values() if isinstance(shape, mi.Shape)]


def grouped_shapes(scene: mi.Scene) -> list[mi.Shape]:
    """Return the shapes in the scene's shape groups, which are hit by instances only."""
    if not any(map(is_instance, scene.shapes())):
        return []
    return [shape for group in shape_groups(scene) for shape in shapes_in(group)]


def all_shapes(scene: mi.Scene) -> list[mi.Shape]:
    """Return the scene's shapes, including those in shape groups."""
    return [*scene.shapes(), *grouped_shapes(scene)]


def own_parameters(owner) -> dict:
    """Return the parameters of ``owner`` alone, by name; cheaper than ``mi.traverse``."""
    collector = _collector(mi.variant())()
    found = collector.of(owner)
    return {
        name: _value(value, collector.types[name], owner)
        for name, value in found.items()
        if value is not None and not isinstance(value, mi.Object)
    }


def _value(value, cpptype, owner):
    """Return the value that a plugin puts: of C++ plugins a pointer to a value of type ``cpptype``."""
    return value if cpptype is None else mi.get_property(value, cpptype, owner)


def all_parameters(owners):
    """Yield class name and parameters of ``owners`` and their descendants, each once, then its number."""
    collector = _collector(mi.variant())()
    left, seen = list(owners), {}
    while left:
        owner = left.pop()
        if id(owner) in seen:
            yield seen[id(owner)][0]
            continue
        seen[id(owner)] = len(seen), owner  # kept alive: ids are reused
        yield owner.class_name()
        for name, value in collector.of(owner).items():
            if isinstance(value, mi.Object):
                left.append(value)
            elif value is not None:
                yield _value(value, collector.types[name], owner)


def matrix_of(owner) -> np.ndarray:
    """The ``to_world`` matrix of ``owner``: (4, 4), double precision."""
    return _entries(own_parameters(owner)["to_world"].matrix)


def world_matrix(endpoint: mi.Emitter | mi.Sensor) -> np.ndarray:
    """An endpoint's ``to_world`` matrix: (4, 4), double precision."""
    return _entries(endpoint.world_transform().matrix)


def inverse_of(owner) -> np.ndarray:
    """Mitsuba's inverse of `matrix_of`: wrong after ``rotate`` about a non-unit axis."""
    return _entries(own_parameters(owner)["to_world"].inverse().matrix)


def _entries(matrix) -> np.ndarray:
    """Convert a Dr.Jit matrix to double precision, entry by entry to launch no kernel."""
    return np.array([[number(matrix[i, j]) for j in range(4)] for i in range(4)], dtype=np.float64)


@cache
def _collector(variant: str):
    """Return the class that collects parameters, one per variant.

    One per call would be cyclic garbage that keeps emitters alive beyond their scene; virtual calls crash.
    """

    class Collector(mi.TraversalCallback):
        def of(self, owner) -> dict:
            self.found, self.types, self.times = {}, {}, {}
            owner.traverse(self)
            found, self.found = self.found, {}
            return found

        def put(self, name, value, flags, cpptype=None):
            # Shapes of a group without ids are all called "shape": number them as ``mi.traverse`` does.
            if name in self.found:
                first, count = name, self.times.get(name, 0)
                while name in self.found:
                    count += 1
                    name = f"{first}_{count}"
                self.times[first] = count
            self.found[name], self.types[name] = value, cpptype

    return Collector


def media_of(scene: mi.Scene, sensors: Iterable[mi.Sensor]) -> dict[int, mi.Medium]:
    """Media that rays of a scene and these sensors may be in, by registry index."""
    media = [sensor.get_medium() for sensor in sensors]
    for shape in all_shapes(scene):
        if not is_instance(shape) and shape.is_medium_transition():  # the shapes of instances have them
            media += [shape.interior_medium(), shape.exterior_medium()]
    return {registry_id(medium): medium for medium in media if medium is not None}


def registry_id(plugin: mi.Medium | mi.BSDF | mi.Shape) -> int:
    """Index of an object in Dr.Jit's registry."""
    kind = next(kind for kind in ("Shape", "BSDF", "Medium") if isinstance(plugin, getattr(mi, kind)))
    return int(dr.reinterpret_array(mi.UInt32, getattr(mi, f"{kind}Ptr")(plugin))[0])


def versions() -> dict[str, str]:
    """Return the versions of this package, Mitsuba, Dr.Jit and LLVM."""
    found = {"mitsuba-bdpt": __version__}
    found |= {name: importlib.metadata.version(name) for name in ("mitsuba", "drjit")}
    if "llvm" in mi.variant():
        found["LLVM"] = ".".join(map(str, dr.detail.llvm_version()))
    return found
