"""Imports inside the package go one way."""

import ast
from pathlib import Path

import mitsuba_bdpt

# From the plugin down to plain arithmetic; a module may import from those after it only.
ORDER = (
    ("__main__",),
    ("doctor", "render"),
    ("checkpoints", "cluster"),
    ("loading",),
    ("__init__",),
    ("integrator",),
    ("rendering",),
    ("parameters", "explain", "passes"),
    ("choice",),
    ("pilot", "lost_light"),
    ("kernel", "film", "sinks", "snapshot"),
    ("connect",),
    ("subpath",),
    ("colour", "features"),
    ("world",),
    ("plan", "emitters", "sensors", "points", "sharing", "strategies", "suspects"),
    ("cameras", "other_sensors"),
    ("emitter_tables", "infinity", "sensor_records"),
    ("emitter_kinds",),
    ("spheres",),
    ("agreement", "bsdf", "edits", "to_world", "rays", "mis", "sobol"),
    ("objects",),
    ("llvm", "files", "spread", "moments", "notices", "similar", "_version"),
)


def imported(path):
    """Names of the package's modules that the file imports, whether at its head or in a function."""
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.ImportFrom) and (node.level or node.module == "mitsuba_bdpt"):
            names = [node.module] if node.level and node.module else [alias.name for alias in node.names]
            yield from names


def test_imports_go_one_way():
    """Expected: every module has a place in `ORDER` and imports from lower places only."""
    place = {name: i for i, names in enumerate(ORDER) for name in names}
    files = sorted(Path(mitsuba_bdpt.__file__).parent.glob("*.py"))
    assert {path.stem for path in files} == set(place)
    for path in files:
        for name in imported(path):
            if name in place:  # anything else is a name in `__init__`
                assert place[path.stem] < place[name], f"{path.stem} imports {name}"
