"""Light groups: which emitters share a layer of the image."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Sequence
from fnmatch import fnmatchcase

import drjit as dr
import mitsuba as mi

from ..errors import UsageError, did_you_mean, listed
from ..host.introspection import plugin_name
from .tables import in_order

# Value of the parameter that gives each emitter a group, up to this number of emitters.
AUTO, MOST_OWN = "auto", 8

MOST_GROUPS = 16  # most groups that a user can define: each costs three channels of the film
REST = "rest"  # group of the emitters that are in no other
NO_LAMP = "no emitter (black)"  # what is said of a group without emitters

_EXAMPLE = "write it like 'key: lamp1, lamp2; sky: envmap'"
_SEPARATORS = "for , and ; in an id write ?"


def parsed(text: str) -> dict[str, list[str]]:
    """Return the patterns of each group of ``key: lamp1, lamp2; sky: envmap``; raises ``UsageError``."""
    if text.strip() in ("", AUTO):
        return {}
    found: dict[str, list[str]] = {}
    for part in filter(str.strip, text.split(";")):
        name, colon, listed = (word.strip() for word in part.partition(":"))
        patterns = [pattern.strip() for pattern in listed.split(",") if pattern.strip()]
        if not colon:
            raise _error(text, f"{name!r} has no group; {_EXAMPLE}, or use {AUTO}; {_SEPARATORS}")
        if not re.fullmatch(r"[A-Za-z0-9_-]+", name):
            raise _error(text, f"{name!r} cannot be a layer's name; use letters, digits, _ and -")
        if not patterns:
            raise _error(text, f"the group {name} has no emitters; {_EXAMPLE}")
        if name == REST:
            raise _error(text, f"{REST} is the group of all other emitters; give the group another name")
        if name in found:
            raise _error(text, f"there are two groups {name}; list their emitters in one")
        found[name] = patterns
    if len(found) > MOST_GROUPS:
        raise _error(text, f"there are {len(found)} groups, {MOST_GROUPS} at most; join some of them")
    return found


def _error(text: str, what: str) -> UsageError:
    return UsageError(f"light_groups={' '.join(text.split())!r}: {what}")


def called(ids: Sequence[str]) -> str:
    """Return the name of an emitter in messages, with its own id if its shape has another."""
    return f"{ids[0]} ({ids[1]})" if ids[1:] and ids[1] != ids[0] else ids[0]


def is_pattern(name: str) -> bool:
    """Return whether ``name`` has ``*`` or ``?``, which stand for any characters, or for any one."""
    return "*" in name or "?" in name


def _layer_name(emitter_id: str) -> str:
    """Return the name of a layer for an id: other characters than letters, digits, _, - become _."""
    return re.sub("[^A-Za-z0-9_-]", "_", emitter_id)


def _ids(emitter: mi.Emitter) -> list[str]:
    """Return the ids of an emitter's shape and its own, if they have one."""
    return [owner.id() for owner in (emitter.get_shape(), emitter) if owner is not None and owner.id()]


def _place(emitter: mi.Emitter) -> str:
    shape = emitter.get_shape()
    return "" if shape is None else " at ({:.3g}, {:.3g}, {:.3g})".format(*shape.bbox().center())


def _layer_names(emitters: Sequence[mi.Emitter]) -> list[str]:
    """Return names of layers for emitters: their ids or, of those without, their plugins' names.

    An id that is a layer's name is the name of its emitter alone; other names that are taken get a number.
    """
    ids = [_ids(emitter) for emitter in emitters]

    def order(i: int):
        # Emitters of equal names by their place: the order of a scene's shapes may vary.
        shape = emitters[i].get_shape()
        return not ids[i], ids[i], str(emitters[i]) if shape is None else str(shape.bbox())

    in_order = sorted(range(len(emitters)), key=order)
    own: dict[str, int] = {}
    for i in in_order:
        if ids[i] and _layer_name(ids[i][0]) == ids[i][0] != REST:
            own.setdefault(ids[i][0], i)
    found = {i: name for name, i in own.items()}
    last = Counter({REST: 1} | {emitter_id: 1 for of_one in ids for emitter_id in of_one})
    for i in (i for i in in_order if i not in found):
        base = _layer_name((ids[i] or [plugin_name(emitters[i])])[0])
        name = base
        while name in last:
            last[base] += 1
            name = f"{base}_{last[base]}"
        last[name] = 1
        found[i] = name
    return [found[i] for i in range(len(emitters))]


class LightGroups:
    """The light groups of a scene.

    ``names``: of the groups, in the order of their layers; ``of_emitters``: group of each emitter;
    ``lamps``: of each group the ids of each emitter, of its shape and its own, or the name that ``auto``
    gives one without; ``warnings``: of patterns that match no emitter.
    """

    def __init__(self, emitters: list[mi.Emitter], text: str):
        groups, made = parsed(text), _layer_names(emitters)
        first = sorted(enumerate(made), key=lambda item: by_numbers(item[1]))[:MOST_OWN]  # of ``auto``
        chosen, self.warnings = _matched(text, groups, emitters, made) if groups else (dict(first), [])
        names = list(groups) if groups else list(dict.fromkeys(chosen.values()))
        self.names = tuple(names + [REST] * (len(chosen) < len(emitters)))
        self.of_emitters = tuple(self.names.index(chosen.get(i, REST)) for i in range(len(emitters)))
        self._places = {name: _place(e) for e, name in zip(emitters, made, strict=True) if not _ids(e)}
        self.lamps: dict[str, list[list[str]]] = {name: [] for name in self.names}
        for group, emitter, name in zip(self.of_emitters, emitters, made, strict=True):
            self.lamps[self.names[group]].append(_ids(emitter) or [name])
        for of_group in self.lamps.values():
            of_group.sort(key=lambda ids: by_numbers(ids[0]))
        self._table = mi.UInt32(list(self.of_emitters))
        dr.make_opaque(self._table)

    @staticmethod
    def of(scene: mi.Scene, text: str) -> LightGroups | None:
        """Return the groups that ``text`` defines; None if empty. Raises ``UsageError``."""
        if not text.strip():
            return None
        emitters = in_order(scene)
        if not emitters:
            raise _error(text, "the scene has no emitters; leave light_groups out")
        return LightGroups(emitters, text)

    def explained(self) -> list[str]:
        """Describe each group by its emitters, with the places of those without id."""
        placed = {
            name: [called(ids) + self._places.get(ids[0], "") for ids in lamps]
            for name, lamps in self.lamps.items()
        }
        return [f"light group {name}: {listed(lamps, 20) or NO_LAMP}" for name, lamps in placed.items()]

    def at(self, index: mi.UInt32, active: mi.Bool) -> mi.UInt32:
        """Return the groups of the emitters ``index``."""
        return dr.gather(mi.UInt32, self._table, index, active)


def _matched(
    text: str, groups: dict[str, list[str]], emitters: list[mi.Emitter], names: list[str]
) -> tuple[dict[int, str], list[str]]:
    """Return the group of each matched emitter by index, and warnings; ``names``: `_layer_names`."""
    real = [_ids(emitter) for emitter in emitters]
    known = [list(dict.fromkeys([*ids, made])) for ids, made in zip(real, names, strict=True)]
    every = sorted({name for of_one in known for name in of_one})
    there = f"Emitters: {listed(sorted({of_one[0] for of_one in known}), 20)}"
    there += f"; {_SEPARATORS}" if re.search("[,;]", "".join(every)) else ""
    found: dict[int, str] = {}
    unmatched: list[tuple[str, str]] = []
    for name, pattern in [(name, pattern) for name, patterns in groups.items() for pattern in patterns]:
        own = [i for i, ids in enumerate(real) if pattern in ids]
        own = own or [i for i, made in enumerate(names) if made == pattern]
        fits = pattern.replace("[", "[[]")
        own = own or [i for i, of_one in enumerate(known) if any(fnmatchcase(n, fits) for n in of_one)]
        if not own and is_pattern(pattern):
            unmatched.append((name, pattern))
        elif not own:
            colon = "separate groups by ;, not by a comma. " if ":" in pattern else ""
            remedy = f"{colon}{did_you_mean(pattern, every, parts=True)}{there}"
            raise _error(text, f"no emitter, and no shape with one, has the id {pattern!r}; {remedy}")
        for i in own:
            if found.setdefault(i, name) != name:
                raise _error(
                    text,
                    f"the emitter {known[i][0]!r} is in the groups {found[i]} and {name}; take it out of one",
                )
    return found, [
        f"bdpt: light_groups: no emitter, and no shape with one, has an id like {pattern!r}; the layer of "
        f"the group {name} is {'without it' if name in found.values() else 'black'}; if the scene should "
        f"have such an emitter, correct the pattern. {there}"
        for name, pattern in unmatched
    ]


def by_numbers(name: str) -> list[int | str]:
    """Return the key of an order of names by their characters, but with numbers as such."""
    return [int(x) if i % 2 else x for i, x in enumerate(re.split(r"([0-9]+)", name))]
