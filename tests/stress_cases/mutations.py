"""Scene files with something wrong in them, made by chance from those in scenes/."""

from __future__ import annotations

import copy
import random
import re
import xml.etree.ElementTree as ET
from pathlib import Path

import repository

VALUES = ("nan", "inf", "-inf", "1e39", "1e-39", "-1", "0", "", "x" * 100_000, "true", "1e9", "0.5, 0.5", "7")
TAGS = ("float", "integer", "string", "boolean", "rgb", "spectrum", "point", "vector", "transform", "texture")
PLUGINS = (
    "sphere",
    "rectangle",
    "diffuse",
    "dielectric",
    "point",
    "area",
    "constant",
    "bdpt",
    "hdrfilm",
    "no",
)
NUMBER = re.compile(r"-?\d+(\.\d+)?([eE][-+]?\d+)?")


def _places(root):
    """Elements below the root, each with its parent."""
    return [(parent, child) for parent in root.iter() for child in parent]


def _delete(rng, root):
    parent, child = rng.choice(_places(root))
    parent.remove(child)
    return f"without {_words(child)}", _names(child)


def _double(rng, root):
    parent, child = rng.choice(_places(root))
    parent.append(copy.deepcopy(child))
    return f"two of {_words(child)}", _names(child)


def _number(rng, root):
    found = [(e, k) for _, e in _places(root) for k, v in e.attrib.items() if NUMBER.search(v)]
    element, key = rng.choice(found)
    places = list(NUMBER.finditer(element.get(key)))
    place, value = rng.choice(places), rng.choice(VALUES)
    words, names, text = _words(element), _names(element), element.get(key)
    element.set(key, text[: place.start()] + value + text[place.end() :])
    return f"{key} of {words} with {value[:12]!r} for {place[0]}", (*names, value)


def _attribute(rng, root):
    element, key = rng.choice([(e, k) for _, e in _places(root) for k in e.attrib])
    value, words, names = rng.choice((*VALUES, *PLUGINS)), _words(element), _names(element)
    element.set(key, value)
    return f"{key}={value[:12]!r} in {words}", (*names, value)


def _without_attribute(rng, root):
    element, key = rng.choice([(e, k) for _, e in _places(root) for k in e.attrib])
    words, names = _words(element), _names(element)
    del element.attrib[key]
    return f"no {key} in {words}", (*names, key)


def _tag(rng, root):
    _, element = rng.choice(_places(root))
    words, names = _words(element), _names(element)
    element.tag = rng.choice(TAGS)
    return f"{words} as {element.tag}", (*names, element.tag)


def _words(element) -> str:
    return f"<{element.tag} {element.get('name') or element.get('type') or ''}>".replace(" >", ">")


def _names(element) -> tuple[str, ...]:
    """By which an error may name it: its kind, name, plugin or value."""
    return (element.tag, *element.attrib.values())


# Numbers most often: other mistakes mostly end in the parser.
KINDS = (_delete, _double, _number, _number, _number, _number, _attribute, _without_attribute, _tag)


def mutate(name: str, seed: int, folder: Path) -> tuple[Path, str, tuple[str, ...]]:
    """A file in ``folder`` made of a scene of scenes/, what is wrong with it, and the names of what is."""
    rng = random.Random(f"{name} {seed}")
    tree = ET.parse(repository.scene_file(name))
    words, names = rng.choice(KINDS)(rng, tree.getroot())
    for data in ("meshes", "textures"):
        if not (folder / data).exists():
            (folder / data).symlink_to(repository.ROOT / "scenes" / data)
    path = folder / f"{name}_{seed}.xml"
    tree.write(path)
    return path, f"`{name}`: {words}", names
