"""Annotations of records name what there is."""

import dataclasses
import importlib
import pkgutil
import typing

import mitsuba_bdpt
import pytest

import mitsuba as mi  # isort: skip


def _records():
    for module in pkgutil.walk_packages(mitsuba_bdpt.__path__, "mitsuba_bdpt."):
        if not module.name.endswith("__main__"):
            held = vars(importlib.import_module(module.name)).values()
            own = (c for c in held if isinstance(c, type) and c.__module__ == module.name)
            yield from filter(dataclasses.is_dataclass, own)


@pytest.mark.parametrize("variant", ["llvm_ad_rgb", "llvm_ad_spectral"])
def test_annotations_of_records_can_be_evaluated(variant):
    """Dr.Jit evaluates those of records that a loop carries: a name for type checkers alone ends a render."""
    mi.set_variant(variant)
    records = list(_records())
    assert len(records) > 50
    for record in records:
        typing.get_type_hints(record)
