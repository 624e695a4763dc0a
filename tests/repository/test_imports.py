"""Imports inside the package go one way, and annotations of records name what there is."""

import dataclasses
import importlib
import pkgutil
import re
import typing
from pathlib import Path

import mitsuba_bdpt
import pytest
from importlinter import cli

import mitsuba as mi  # isort: skip

ROOT = Path(__file__).resolve().parents[2]


def test_imports_go_one_way(capsys):
    """Expected: every room is in the contract, which is exhaustive, and imports from later rooms."""
    done = cli.lint_imports(config_filename=str(ROOT / "pyproject.toml"), no_cache=True)
    assert done == cli.EXIT_STATUS_SUCCESS, capsys.readouterr().out


def test_one_module_knows_what_mitsuba_renames():
    """Rationale: Mitsuba 3.10 calls data of meshes differently, and has other flags of rays and animated
    transformations. Expected: one module alone names them, `host.renamed`.
    """
    names = re.compile(
        r"vertex_(positions|normals|texcoords)|RayFlags\.All|[\"']faces[\"']|AnimatedTransform|is_animated"
    )
    package = Path(mitsuba_bdpt.__path__[0])
    found = {str(p.relative_to(package)) for p in package.rglob("*.py") if names.search(p.read_text())}
    assert found == {"host/renamed.py"}


def test_the_package_has_no_instruments_of_tests():
    """Rationale: a recorder that replaced functions of the renderer by ``unittest.mock`` was in the wheel.
    Expected: no module of the package imports a framework of tests, or what lies in tests/ and scripts/.
    """
    folders = (ROOT / "tests", ROOT / "scripts")
    beside = {path.stem for folder in folders for path in folder.glob("*.py")}
    beside |= {path.parent.name for folder in folders for path in folder.glob("*/__init__.py")}
    imported = re.compile(r"^\s*(?:from|import)\s+(\w+)", re.MULTILINE)
    package = Path(mitsuba_bdpt.__path__[0])
    assert {"instruments", "stress_cases", "repository"} <= beside
    for path in package.rglob("*.py"):
        found = set(imported.findall(path.read_text()))
        assert not found & (beside | {"unittest", "pytest", "hypothesis"}), path


def _records():
    """All dataclasses of the package."""
    for module in pkgutil.walk_packages(mitsuba_bdpt.__path__, "mitsuba_bdpt."):
        if not module.name.endswith("__main__"):
            held = vars(importlib.import_module(module.name)).values()
            own = (c for c in held if isinstance(c, type) and c.__module__ == module.name)
            yield from filter(dataclasses.is_dataclass, own)


@pytest.mark.parametrize("variant", ["llvm_ad_rgb", "llvm_ad_spectral"])
def test_annotations_of_records_can_be_evaluated(variant):
    """Rationale: Dr.Jit evaluates the annotations of records that a loop or call carries: a name that is
    imported for type checkers alone ends a render. Expected: those of all records can be evaluated.
    """
    mi.set_variant(variant)
    records = list(_records())
    assert len(records) > 50
    for record in records:
        typing.get_type_hints(record)
