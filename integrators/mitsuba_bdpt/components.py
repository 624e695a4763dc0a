"""The table of components: capabilities that the package works without.

A component is a folder. Where it is deleted, with its line in `COMPONENTS`, scenes that do not need it render
as before, and asking for it raises ``UnsupportedError``. Modules that components depend on never import them;
those above use them as attributes of this module::

    components.guided_emission.learn(...)
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

from .errors import UnsupportedError

# The folder of each component.
COMPONENTS = {
    "guided_emission": "mitsuba_bdpt.guided_emission",
    "media": "mitsuba_bdpt.media",
    "merging": "mitsuba_bdpt.merging",
}


def why_absent(name: str) -> str:
    """Why the component ``name`` cannot be used; empty if it is present."""
    return "" if name in COMPONENTS else f"{name.replace('_', ' ')} is not part of this installation"


class _Absent:
    """Stands for a component that is not installed: any use of it raises an error."""

    def __init__(self, name: str):
        self._name = name

    def __getattr__(self, _: str) -> Any:
        raise UnsupportedError(f"{why_absent(self._name)}; install the whole package")


def _find(name: str) -> Any:
    return _Absent(name) if why_absent(name) else import_module(COMPONENTS[name])


if TYPE_CHECKING:
    from . import guided_emission, media, merging
else:
    guided_emission, media, merging = map(_find, ("guided_emission", "media", "merging"))
