"""Which group of emitters each class belongs to, by what its ``class_name()`` returns."""

from __future__ import annotations

from ..host.jit import registered_emitters
from .area import AreaEmitters
from .directional_area import DirectionalAreaEmitters
from .group import Group
from .hit_only import HitOnlyEmitters
from .infinite import InfiniteEmitters
from .position import PositionEmitters
from .third_party import ThirdPartyEmitters

KINDS: dict[str, type[Group]] = {
    "AreaLight": AreaEmitters,
    "DirectionalArea": DirectionalAreaEmitters,
    "PointLight": PositionEmitters,
    "SpotLight": PositionEmitters,
    "Projector": PositionEmitters,
    "DirectionalEmitter": InfiniteEmitters,
    "ConstantBackgroundEmitter": InfiniteEmitters,
    "EnvironmentMapEmitter": InfiniteEmitters,
    "SunskyEmitter": InfiniteEmitters,
    "TimedSunskyEmitter": InfiniteEmitters,
}

# Classes of Mitsuba's own, which have all calls. (Virtual calls visit every emitter in the process: one of
# another class that has a group above still need not have ``sample_position``.)
MITSUBAS = frozenset(KINDS)

# In the order in which a kernel asks them.
GROUPS: tuple[type[Group], ...] = (*dict.fromkeys(KINDS.values()), HitOnlyEmitters, ThirdPartyEmitters)


def group_of(emitter) -> type[Group]:
    """The group of an emitter; raises what `Group.of` does."""
    return KINDS.get(emitter.class_name(), ThirdPartyEmitters).of(emitter)


def is_third_party(class_name: str) -> bool:
    """Whether an emitter's class is not Mitsuba's."""
    return class_name not in MITSUBAS


def third_party_elsewhere(scene) -> int:
    """How many emitters outside of ``scene`` are of a class that is not Mitsuba's.

    Virtual calls visit them too.
    """
    own = sum(is_third_party(emitter.class_name()) for emitter in scene.emitters())
    return sum(map(is_third_party, registered_emitters())) - own


def needs_evaluation(class_name: str) -> bool:
    """Whether calls of such an emitter fail while a kernel is recorded: it asks for the value of a mask."""
    return class_name == "TimedSunskyEmitter"
