"""What `mitsuba_bdpt` exports."""

import importlib
import re
import typing
from pathlib import Path

import mitsuba_bdpt
import pytest

import mitsuba as mi  # isort: skip

PAGE = Path(__file__).resolve().parents[1] / "docs" / "user" / "api.md"


@pytest.mark.parametrize("variant", ["llvm_ad_rgb", "llvm_ad_spectral"])
def test_integrators_are_instances_of_the_public_class(variant):
    mi.set_variant(variant)
    scene = mi.cornell_box()
    scene["integrator"] = {"type": "bdpt"}
    for integrator in (mi.load_dict({"type": "bdpt"}), mi.load_dict(scene).integrator()):
        assert isinstance(integrator, mitsuba_bdpt.BDPTIntegrator)
    assert not isinstance(mi.load_dict({"type": "path"}), mitsuba_bdpt.BDPTIntegrator)


def documented():
    """The names whose docstrings the page of the API shows, by module."""
    found, module = {}, None
    for kind, name in re.findall(r"^\.\. (currentmodule|auto\w+):: ([\w.]+)", PAGE.read_text(), re.MULTILINE):
        if kind == "currentmodule":
            module = name
        else:
            found.setdefault(module, set()).add(name)
    return found


def test_all_public_names_are_documented():
    assert documented()["mitsuba_bdpt"] == set(mitsuba_bdpt.__all__) - {"__version__", "llvm_choice"}
    for module, names in documented().items():
        assert all(getattr(importlib.import_module(module), name).__doc__ for name in names)


def test_statistics_are_of_their_declared_type():
    integrator = mi.load_dict({"type": "bdpt", "max_depth": 2, "layers": "variance", "skip": "impossible"})
    scene = mi.cornell_box()
    scene["sensor"]["film"].update(width=8, height=8)
    integrator.render(mi.load_dict(scene), spp=8, develop=False)
    declared = typing.get_type_hints(mitsuba_bdpt.Statistics, include_extras=True)
    optional = {key for key, hint in declared.items() if typing.get_origin(hint) is typing.NotRequired}
    found = integrator.statistics
    assert declared.keys() - optional <= found.keys() <= declared.keys() and "error" in found
    for key in found.keys() - {"error"}:
        kind = typing.get_args(declared[key])[0] if key in optional else declared[key]
        assert isinstance(found[key], typing.get_origin(kind) or kind), key
