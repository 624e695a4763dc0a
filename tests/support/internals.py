"""Integrators with internals that no parameter sets (`mitsuba_bdpt.settings.Internals`)."""

import json
from dataclasses import fields

import mitsuba as mi
from mitsuba_bdpt.planning.configuration import Decision
from mitsuba_bdpt.settings import Internals

NAMES = tuple(field.name for field in fields(Internals))


def bdpt(**values):
    """The plugin with ``values``: parameters, and internals by their names; decisions as in statistics, or
    their JSON."""
    if "decisions" in values:
        made = values["decisions"]
        made = json.loads(made) if isinstance(made, str) else made
        values["decisions"] = tuple(Decision.read(record) for record in made)
    method = mi.load_dict({"type": "bdpt"} | {k: v for k, v in values.items() if k not in NAMES})
    method.settings = method.settings.varied(**{k: v for k, v in values.items() if k in NAMES})
    return method
