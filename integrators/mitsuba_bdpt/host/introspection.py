"""What Mitsuba's objects hold."""

from __future__ import annotations

from collections.abc import Iterable
from functools import cache

import drjit as dr
import mitsuba as mi
import numpy as np

from . import renamed


def number(x) -> float:
    """A number of Python from one of Dr.Jit."""
    return float(dr.slice(x) if dr.is_array_v(x) else x)


def named(owner) -> str:
    """What a message calls an object: its id in quotation marks, or that it has none, with what tells it."""
    if owner.id():
        return f"'{owner.id()}'"
    shape = owner.get_shape() if isinstance(owner, (mi.Emitter, mi.Sensor)) else None
    if shape is not None and shape.id():
        return f"without id on shape '{shape.id()}'"
    return f"without id ({owner.class_name()})"


def children(owner) -> dict:
    """What ``owner`` holds, by name: objects and numbers, as its ``traverse`` reports them."""
    return _collector(mi.variant())().of(owner)


def is_instance(shape: mi.Shape) -> bool:
    """Whether ``shape`` is an instance of a shape group."""
    return shape.class_name() == "Instance"


def grouped_shapes(scene: mi.Scene) -> list[mi.Shape]:
    """Return the shapes in the scene's shape groups.

    An instance does not tell which group it is of: groups are found among what the scene holds.
    """
    shapes = [c for c in children(scene).values() if isinstance(c, mi.Shape)]
    groups = [shape for shape in shapes if shape.class_name().startswith("ShapeGroup")]
    return [s for group in groups for s in children(group).values() if isinstance(s, mi.Shape)]


def all_shapes(scene: mi.Scene) -> list[mi.Shape]:
    """The scene's shapes, those in shape groups included."""
    return [*scene.shapes(), *grouped_shapes(scene)]


def own_parameters(owner) -> dict:
    """Return the parameters of ``owner`` alone, by name.

    ``mi.traverse`` goes through all objects that it holds, which takes longer.
    """
    collector = _collector(mi.variant())()
    found = collector.of(owner)
    return {
        name: _value(value, collector.types[name], owner)
        for name, value in found.items()
        if value is not None and (not isinstance(value, mi.Object) or renamed.is_transform(value))
    }


def _value(value, cpptype, owner):
    """The parameter itself, as ``mi.traverse`` reads it.

    A plugin in Python puts the value, one of Mitsuba's a pointer to a value of this C++ type. Raises
    ``UnsupportedError`` if it is an animated transformation."""
    if renamed.is_transform(value):
        return renamed.transform(value, _called(owner))
    return value if cpptype is None else mi.get_property(value, cpptype, owner)


def all_parameters(owners):
    """The parameters of ``owners`` and of all that they hold, each object's once, after its class's name."""
    collector = _collector(mi.variant())()
    left, seen = list(owners), {}
    while left:
        owner = left.pop()
        if id(owner) in seen:
            continue
        seen[id(owner)] = owner  # which lives as long as its number is known
        yield owner.class_name()
        for name, value in collector.of(owner).items():
            if isinstance(value, mi.Object):
                left.append(value)
            elif value is not None:
                yield _value(value, collector.types[name], owner)


def matrix_of(owner) -> np.ndarray:
    """The matrix of the parameter ``to_world`` of ``owner``: (4, 4), in double precision."""
    return _entries(own_parameters(owner)["to_world"].matrix)


def world_transform(endpoint: mi.Emitter | mi.Sensor):
    """The transformation of an emitter or a sensor; raises ``UnsupportedError`` if it is animated."""
    return renamed.transform(endpoint.world_transform(), _called(endpoint))


def world_matrix(endpoint: mi.Emitter | mi.Sensor) -> np.ndarray:
    """The matrix of `world_transform`: (4, 4), in double precision."""
    return _entries(world_transform(endpoint).matrix)


def check_not_animated(owners: Iterable):
    """Raise ``UnsupportedError`` if one of ``owners`` moves while the shutter is open."""
    for owner in owners if renamed.may_be_animated() else ():
        own_parameters(owner)


def _called(owner) -> str:
    return f"{owner.class_name()} {named(owner)}"


def inverse_of(owner) -> np.ndarray:
    """Return what Mitsuba takes to be the inverse of `matrix_of`, kept beside it.

    It is wrong after ``rotate`` about an axis that is not of length 1, which Mitsuba takes for a rotation.
    """
    return _entries(own_parameters(owner)["to_world"].inverse().matrix)


def _entries(matrix) -> np.ndarray:
    """A matrix of Dr.Jit, in double precision. (One by one: no kernel runs, as for the matrix as a whole.)"""
    return np.array([[number(matrix[i, j]) for j in range(4)] for i in range(4)], dtype=np.float64)


@cache
def _collector(variant: str):
    """Return the class that collects parameters, one per variant.

    A class made for each call would be garbage that only the cycle collector frees; until then it keeps
    emitters alive beyond their scene, and the next virtual call of any scene crashes.
    """

    class Collector(mi.TraversalCallback):
        def of(self, owner) -> dict:
            self.found, self.types, self.times = {}, {}, {}
            owner.traverse(self)
            found, self.found = self.found, {}
            return found

        def put(self, name, value, flags, cpptype=None):
            # Shapes of a group that have no id are all called "shape": numbered, as by ``mi.traverse``.
            first, count = name, self.times.get(name, 0)
            while name in self.found:
                count += 1
                name = f"{first}_{count}"
            self.times[first] = count
            self.found[name], self.types[name] = value, cpptype

    return Collector
