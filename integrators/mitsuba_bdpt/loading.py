"""From a command line to a scene and the integrator that renders it."""

from __future__ import annotations

import codecs
import re
from argparse import Namespace
from collections.abc import Mapping, Sequence
from pathlib import Path
from xml.etree import ElementTree

import mitsuba as mi

from . import features

KEPT = ("max_depth", "rr_depth", "hide_emitters", "timeout")
"""What an integrator that replaces the scene's takes over: the same paths, in the same time."""

NOT_CARRIED = {
    "moment": "second moments, which bdpt has not: its parameter variance adds the variance of each pixel",
    "stokes": "Stokes vectors, which bdpt has not: it is not polarized",
}
"""Integrators around another whose layers `bdpt` cannot have."""

AROUND = ("aov", *NOT_CARRIED)
"""Mitsuba's integrators around another one."""

# What files in other encodings than UTF-8 begin with: a byte order mark, or the first "<" of a file without.
# Of two that fit the first counts.
_STARTS = (
    (codecs.BOM_UTF32_LE, "utf-32"),
    (codecs.BOM_UTF32_BE, "utf-32"),
    (codecs.BOM_UTF16_LE, "utf-16"),
    (codecs.BOM_UTF16_BE, "utf-16"),
    (b"<\0\0\0", "utf-32-le"),
    (b"\0\0\0<", "utf-32-be"),
    (b"<\0", "utf-16-le"),
    (b"\0<", "utf-16-be"),
)


def elements(file: Path) -> list[ElementTree.Element]:
    """All elements of a scene file, in its order; raises ``ValueError`` if it is not XML."""
    text = _decoded(file.read_bytes())
    try:
        # Mitsuba takes comments that hold two hyphens, XML does not.
        return list(ElementTree.fromstring(re.sub(r"<!--.*?-->", "", text, flags=re.DOTALL)).iter())
    except (ElementTree.ParseError, ValueError) as error:
        raise ValueError(f"{str(file)!r} is not well-formed XML: {error}") from error


def _decoded(data: bytes) -> str:
    """The text of a scene file, whose encoding Mitsuba tells by its first bytes."""
    if re.match(rb"<\?xml[^>]*encoding\s*=\s*[\"'](iso-8859-1|latin1)[\"']", data, re.IGNORECASE):
        return data.decode("latin-1")
    encoding = next((name for start, name in _STARTS if data.startswith(start)), "utf-8-sig")
    return data.decode(encoding, errors="replace")


def in_proportion(scene: Path, definitions: dict) -> dict:
    """``definitions`` with the height ``resolution_y`` that belongs to the ``resolution`` among them, if the
    scene file has such defaults and it is not given: the image keeps its proportions."""
    if "resolution" not in definitions or "resolution_y" in definitions:
        return definitions
    try:
        defaults = [element for element in elements(scene) if element.tag == "default"]
    except ValueError:  # Mitsuba, which takes more for XML, has the last word
        return definitions
    # Of several with one name Mitsuba takes the first.
    known = {element.get("name"): element.get("value", "") for element in reversed(defaults)}
    texts = str(definitions["resolution"]), known.get("resolution", ""), known.get("resolution_y", "")
    if not all(text.strip().isdecimal() for text in texts) or not int(texts[1]):
        return definitions
    asked, width, height = map(int, texts)
    return definitions | {"resolution_y": max(round(asked * height / width), 1)}


def load(options: Namespace) -> tuple[mi.Scene, mi.Integrator]:
    """Load the scene and the integrator to render it with."""
    if options.variant not in mi.variants():
        known = ", ".join(mi.variants())
        raise ValueError(f"variant={options.variant!r} is not one of Mitsuba's: {known}.")
    if not options.scene.is_file():
        raise ValueError(f"scene={str(options.scene)!r} is not a file.")
    try:
        mi.set_variant(options.variant)
    except ImportError as error:
        raise ValueError(
            f"variant={options.variant!r} cannot be used on this machine ({error}); "
            "use an LLVM variant, for example llvm_ad_rgb."
        ) from error
    mi.file_resolver().prepend(str(options.scene.resolve().parent))
    overrides = dict(options.properties)
    if options.time is not None:
        overrides["timeout"] = options.time
    config = mi.parser.ParserConfig(options.variant)
    defines = in_proportion(options.scene, dict(options.defines))
    state = mi.parser.parse_file(config, str(options.scene), **defines)
    # Nodes are in the order of the file: an integrator comes before those nested in it.
    kind = mi.ObjectType.Integrator
    node = next((node for node in state.nodes if node.type == kind), None)
    if options.until_error is not None:
        used = options.integrator or (node.props.plugin_name() if node is not None else "bdpt")
        if used != "bdpt":
            raise ValueError(
                f"until_error is for the integrator bdpt, not for {used}; use --integrator bdpt."
            )
        overrides |= {"until_error": options.until_error, "variance": True}
    if node is not None:
        replace_integrator(state.nodes, node, options.integrator, overrides)
    mi.parser.transform_all(config, state)
    scene = mi.parser.instantiate(config, state)
    if node is not None:
        return scene, scene.integrator()
    return scene, mi.load_dict({"type": options.integrator or "bdpt", **overrides})


def replace_integrator(
    nodes: Sequence, node, kind: str | None, overrides: Mapping[str, bool | int | float | str]
) -> None:
    """Make the integrator ``node``, one of ``nodes``, one of another ``kind`` if that is set, with
    ``overrides``.

    Of integrators around another one (`AROUND`), with their layers, `bdpt` takes the place of all of them,
    for it has layers of its own; others take the place of the innermost. Raises ``ValueError`` for layers
    that cannot be kept."""
    given = node.props
    if kind == "bdpt" and given.plugin_name() in AROUND:
        given, layers = _layers(nodes, node)
        overrides = layers | overrides
    while kind not in (None, *AROUND) and given.plugin_name() in AROUND:
        node = _nested(nodes, node)[1]
        given = node.props
    node.props = integrator_properties(given, kind, overrides)


def _layers(nodes: Sequence, node) -> tuple[mi.Properties, dict]:
    """The properties of the innermost integrator of ``node``, which is around others, and what `bdpt` takes
    over from those: layers, named as in Mitsuba's film, and the outermost ``timeout``, which counts there."""
    aovs, carried, prefix = [], {}, ""
    while (kind := node.props.plugin_name()) in AROUND:
        if kind in NOT_CARRIED:
            raise ValueError(
                f"integrator=bdpt cannot replace the scene's integrator {kind}, which is around another and "
                f"adds {NOT_CARRIED[kind]}; in the scene file, write the inner integrator alone."
            )
        aovs += [prefix + pair for pair in features.pairs(node.props.get("aovs", ""))]
        if "timeout" in node.props:
            carried.setdefault("timeout", node.props["timeout"])
        name, node = _nested(nodes, node)
        prefix += f"{name}."
    if kind == "bdpt":
        aovs += features.pairs(node.props.get("aovs", ""))
    return node.props, carried | ({"aovs": ",".join(aovs)} if aovs else {})


def _nested(nodes: Sequence, node) -> tuple[str, object]:
    """Name and node of the one integrator inside of ``node``, which is around it."""
    held = {key: node.props[key] for key in node.props.keys()}  # noqa: SIM118 (not a dict)
    held = {key: value for key, value in held.items() if isinstance(value, mi.Properties.ResolvedReference)}
    found = [(key, nodes[reference.index()]) for key, reference in held.items()]
    found = [(key, inner) for key, inner in found if inner.type == mi.ObjectType.Integrator]
    if len(found) != 1:
        names = ", ".join(f"{key!r} ({inner.props.plugin_name()})" for key, inner in found)
        raise ValueError(
            f"integrator: the scene's integrator {node.props.plugin_name()} is around {names or 'none'}; to "
            "replace the one inside, there has to be just one: in the scene file, leave out the others."
        )
    return found[0]


def integrator_properties(
    given: mi.Properties, kind: str | None, overrides: Mapping[str, bool | int | float | str]
) -> mi.Properties:
    """The `given` properties with `overrides`, for an integrator of another `kind` if it is set."""
    if kind is None or kind == given.plugin_name():
        properties = mi.Properties(given)
    else:
        properties = mi.Properties(kind)
        properties.set_id(given.id())
        for key in KEPT:
            if key in given:
                properties[key] = given[key]
                # Not every integrator has all of them; that is no mistake of the user's.
                properties.mark_queried(key)
    for key, value in overrides.items():
        properties[key] = value
    return properties


def choose_sensor(scene: mi.Scene, index: int) -> mi.Sensor:
    """The sensor with this `index`."""
    sensors = scene.sensors()
    if not sensors:
        raise ValueError("The scene has no sensor; add one to the scene file.")
    if index >= len(sensors):
        raise ValueError(f"sensor={index} is not in the scene; the last one is {len(sensors) - 1}.")
    return sensors[index]
