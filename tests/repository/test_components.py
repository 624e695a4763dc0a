"""Components: without the folder of one the package renders the rest as before, and says what is missing.

Run as a script, this module is a process that renders with another copy of the package: see `_render`.
"""

import os
import re
import shutil
import subprocess
import sys
from dataclasses import dataclass, field
from pathlib import Path

import internals
import mitsuba as mi
import mitsuba_bdpt
import numpy as np
import pytest
import variants
from mitsuba_bdpt.components import COMPONENTS

TESTS = Path(__file__).resolve().parents[1]


@dataclass(frozen=True)
class Component:
    """Its own ``tests``, and an expression of pytest for the ``others`` in `REST`; ``never``: parameters of a
    render without it; ``asked``: parameters that ask for it, or ``things`` of a scene that needs it."""

    tests: tuple[str, ...]
    others: str = ""
    never: dict = field(default_factory=dict)
    asked: dict = field(default_factory=dict)
    things: dict = field(default_factory=dict)


# A decision that names tables of guided emission.
_TABLES = {"side": 4, "left": 0.5, "levels": "eJxjYGhgGAUEAAAAgIAB"}
_DECISION = {"light_paths": 1, "connections": "one", "emission": _TABLES, "cost": 1, "variance": 1, "mean": 1}
_DECISION["coefficients"] = {"t<=1": 1, "s=1": 1}

FOG = {"type": "sphere", "bsdf": {"type": "null"}, "interior": {"type": "homogeneous"}}

KNOWN = {
    "guided_emission": Component(
        never={"guiding": "photons"},
        asked={"decisions": [_DECISION]},
        tests=("guided_emission", "images/test_guided_emission.py"),
    ),
    "merging": Component(
        asked={"merging": True},
        tests=(
            *("images/test_merging.py", "images/test_sds_paths.py"),
            *("planning/test_undersampled.py", "transport/test_media_oracle.py"),
        ),
    ),
    "media": Component(
        things={"fog": FOG},
        others="not fog and not slab and not mask",
        tests=(
            "images/test_media.py",
            "images/test_media_boundaries.py",
            "run/test_media_runs.py",
            "transport/test_media_oracle.py",
            "transport/test_media_counters.py",
        ),
    ),
}

# Tests of the rest that a copy has to pass: densities, shared light subpaths.
REST = ("emitters/test_endpoints.py", "transport/test_sharing.py")


def without(name: str, folder: Path) -> Path:
    """The folder of a copy of the package without the component's folder and line."""
    package = Path(mitsuba_bdpt.__file__).parent
    copy = folder / "integrators" / "mitsuba_bdpt"
    shutil.copytree(package, copy, ignore=shutil.ignore_patterns("__pycache__"))
    shutil.rmtree(copy.joinpath(*COMPONENTS[name].split(".")[1:]))
    table = copy / "components.py"
    lines, removed = re.subn(rf'^    "{name}": .*\n', "", table.read_text(), flags=re.MULTILINE)
    assert removed == 1
    table.write_text(lines)
    return copy.parent


def run(sources: Path, *arguments) -> str:
    paths = os.pathsep.join(map(str, (sources, TESTS, TESTS / "support")))
    done = subprocess.run(
        [sys.executable, *map(str, arguments)],
        env=os.environ | {"PYTHONPATH": paths, "PYTHONDONTWRITEBYTECODE": "1"},
        cwd=TESTS.parent,
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stdout[-5000:] + done.stderr[-5000:]
    return done.stdout


def scene(things: dict):
    import scene_parts as parts  # once there is a variant

    lamp = parts.EMITTERS["rectangle"]()
    return mi.load_dict(parts.open_scene(lamp=lamp, **things), parallel=False, optimize=False)


def images(parameters: dict) -> dict[str, np.ndarray]:
    """Images of all strategies, and of those that a pilot chooses."""
    loaded, made = scene({}), {}
    for skip, spp in (("none", 4), ("auto", 64)):
        integrator = mi.load_dict({"type": "bdpt", "max_depth": 4, "skip": skip} | parameters)
        made[skip] = np.array(integrator.render(loaded, seed=3, spp=spp))
        assert skip == "none" or integrator.statistics["decisions"]
    return made


def _render(name: str, out: str):
    """Render without the component ``name``, and ask for it."""
    import short_pilots  # noqa: F401  (imported by conftest.py elsewhere)

    mi.set_variant(variants.of("rgb"))
    said, known = "", KNOWN[name]
    try:
        internals.bdpt(**known.asked).render(scene(known.things), spp=1)
    except Exception as error:  # Mitsuba wraps what is raised
        said = str(error)
    np.savez(out, said=said, package=mitsuba_bdpt.__file__, **images({}))


def test_every_component_is_known_here():
    assert set(KNOWN) == set(COMPONENTS)


@pytest.mark.parametrize("name", KNOWN)
def test_the_rest_renders_as_before(name, tmp_path):
    """Expected: the image of a render that does not use the component, up to the order of atomic sums, with
    all strategies and as a pilot chooses; who asks for it gets an error."""
    known, sources, out = KNOWN[name], without(name, tmp_path), tmp_path / "made.npz"
    run(sources, __file__, name, out)
    found = np.load(out)
    assert Path(str(found["package"])).is_relative_to(sources)
    assert f"{name.replace('_', ' ')} is not part of this installation" in str(found["said"])
    for skip, expected in images(known.never).items():
        np.testing.assert_allclose(found[skip], expected, rtol=2e-4, atol=1e-6)


@pytest.mark.parametrize("name", KNOWN)
def test_tests_that_import_a_component_are_known_here(name):
    """Without the component they cannot be collected."""
    imports = re.compile(rf"^(from|import) mitsuba_bdpt(\.| import ){name}\b", re.MULTILINE)
    known = [TESTS / path for path in KNOWN[name].tests]
    for file in TESTS.rglob("test_*.py"):
        assert any(map(file.is_relative_to, known)) or not imports.search(file.read_text()), file


@pytest.mark.slow
@pytest.mark.parametrize("name", KNOWN)
def test_the_rest_passes_its_tests(name, tmp_path):
    """Expected: without the component the tests of `REST` pass."""
    pytest_of = ("-m", "pytest", "-q", "-p", "no:cacheprovider", "-k", KNOWN[name].others)
    assert "passed" in run(without(name, tmp_path), *pytest_of, *(TESTS / path for path in REST))


if __name__ == "__main__":
    _render(*sys.argv[1:])
