"""Maps the ``class_name()`` of an emitter to its group."""

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

# Mitsuba's own classes, which have all calls. Virtual calls visit every emitter in the process, and a
# user-defined class may lack ``sample_position``.
MITSUBAS = frozenset(KINDS)

# In the order of dispatch in a kernel.
GROUPS: tuple[type[Group], ...] = (*dict.fromkeys(KINDS.values()), HitOnlyEmitters, ThirdPartyEmitters)


def group_of(emitter) -> type[Group]:
    """Return the group of an emitter; raises as `Group.of` does."""
    return KINDS.get(emitter.class_name(), ThirdPartyEmitters).of(emitter)


def is_third_party(class_name: str) -> bool:
    return class_name not in MITSUBAS


def third_party_elsewhere(scene) -> int:
    """Number of user-defined emitters outside ``scene``; virtual calls visit them."""
    own = sum(is_third_party(emitter.class_name()) for emitter in scene.emitters())
    return sum(map(is_third_party, registered_emitters())) - own


def needs_evaluation(class_name: str) -> bool:
    """Whether calls of such an emitter cannot be recorded, since it evaluates a mask."""
    return class_name == "TimedSunskyEmitter"
