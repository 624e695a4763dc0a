"""References and sweeps: what is stored, what a restart keeps, what is refused."""

import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import mitsuba as mi
import numpy as np
import pyarrow.parquet
import pytest
import reference
import sweep

ROOT = Path(__file__).resolve().parents[1]
PRESET = """
resolution = 8
max_depth = 3
seeds = 2
scenes = ["cornell_box"]
spp = [2, 4]
[[integrator]]
name = "ours"
type = "bdpt"
[[integrator]]
type = "path"
match = "seconds"
"""


@pytest.fixture
def folder(tmp_path, monkeypatch):
    """References and sums in a folder of the test's own."""
    monkeypatch.setattr(reference, "REFERENCES", tmp_path / "references")
    monkeypatch.setattr(reference, "SUMS", tmp_path / "sums")
    return tmp_path


def preset_file(folder, text=PRESET):
    path = folder / "tiny.toml"
    path.write_text(text)
    return path


# -- references -------------------------------------------------------------------------------


def test_a_reference_comes_back_with_its_error_and_provenance(folder):
    """Expected: the stored image is the rendered one within half precision (2^-11 relative), its own error
    is below what was asked for, and the provenance says what made it.
    """
    made = reference.make("cornell_box", 8, 2, error=0.05, seconds=100)
    kept = reference.load_reference("cornell_box", 8, 2)
    np.testing.assert_allclose(kept.image, made.image, rtol=2.0**-11, atol=1e-6)
    assert made.error < 0.05 and kept.error == pytest.approx(made.error, rel=0.01)
    assert kept.provenance["integrator"] == {"type": "path", "max_depth": 2}
    assert kept.provenance["spp"] % 512 == 0 and kept.provenance["versions"]["mitsuba"].startswith("3.9")


def test_halves_estimate_the_error_of_their_mean(folder):
    """Rationale: the halves differ by twice the standard error of their mean. Expected: for halves r + e and
    r - e the mean is r and the error that of r + e against r: e^2 / (r^2 + 0.01 r^2).
    """
    halves = reference.Halves(folder / "sums.npz", "key")
    assert halves.error() == np.inf
    r, e = np.full((2, 2, 3), 2.0), 0.1
    for _ in range(3):
        halves.add([r + e, r - e])
    assert halves.error() == pytest.approx(e**2 / (4 * 1.01))
    again = reference.Halves(folder / "sums.npz", "key")
    assert again.rounds == 3 and again.error() == pytest.approx(halves.error())
    assert reference.Halves(folder / "sums.npz", "another").rounds == 0


def test_references_go_on_where_they_stopped(folder):
    """Expected: a second run adds rounds to those of the first."""
    first = reference.make("cornell_box", 8, 2, error=0.05, seconds=100)
    second = reference.make("cornell_box", 8, 2, error=first.error * 0.3, seconds=100)
    assert second.provenance["spp"] > first.provenance["spp"] and second.error <= first.error * 0.3


def test_missing_and_stale_references_are_refused(folder, monkeypatch):
    """Expected: the command that makes the reference is named."""
    command = "python scripts/reference.py cornell_box --resolution 8 --max-depth 2"
    with pytest.raises(ValueError, match=f"no reference.*{command}"):
        reference.load_reference("cornell_box", 8, 2)
    reference.make("cornell_box", 8, 2, error=1, seconds=100)
    monkeypatch.setattr(reference, "digest", lambda path: "another file")
    with pytest.raises(ValueError, match=f"another cornell_box.xml; {command}"):
        reference.load_reference("cornell_box", 8, 2)
    with pytest.raises(ValueError, match="scene='nowhere' is not in scenes/"):
        reference.scene_file("nowhere")


# -- sweeps -----------------------------------------------------------------------------------


def test_a_sweep_writes_a_row_per_render_and_goes_on(folder, capsys, monkeypatch):
    """Expected: scenes x integrators x samples x seeds rows, the same in CSV and Parquet; a second run
    renders nothing; with one cell removed it renders that one.
    """
    reference.make("cornell_box", 8, 3, error=0.05, seconds=100)
    path, output = preset_file(folder), folder / "out"
    monkeypatch.setattr(sys, "argv", ["sweep.py", str(path), "-o", str(output)])
    assert sweep.main() == 0
    table = pyarrow.parquet.read_table(output / "rows.parquet").to_pylist()
    assert len(table) == 8 and (output / "rows.csv").read_text().count("\n") == 9
    assert {(r["method"], r["budget"], r["seed"]) for r in table} == {
        (m, b, s) for m in ("ours", "path") for b in (2, 4) for s in (1, 2)
    }
    for row in table:
        assert row["seconds"] > 0 and row["rel_mse_trimmed"] <= row["rel_mse"] and row["max_depth"] == 3
        assert row["spp"] == row["budget"] or row["method"] == "path"
        assert json.loads(row["parameters"])["type"] in ("bdpt", "path")
    assert all(r["rays_camera"] > 0 for r in table if r["method"] == "ours")
    (output / "cells" / f"{table[3]['key']}.json").unlink()
    rendered = []
    measure = sweep.measure
    monkeypatch.setattr(sweep, "measure", lambda b, c: rendered.append(c.key) or measure(b, c))
    assert sweep.main() == 0 and rendered == [table[3]["key"]]
    assert len(pyarrow.parquet.read_table(output / "rows.parquet")) == 8


def test_a_failing_cell_does_not_cost_the_others(folder, capsys, monkeypatch):
    """Expected: the cells of a plugin that does not exist fail, are named, and the others are there."""
    reference.make("cornell_box", 8, 3, error=1, seconds=100)
    path = preset_file(folder, PRESET.replace('type = "path"', 'type = "no_such_plugin"\nname = "bad"'))
    monkeypatch.setattr(sys, "argv", ["sweep.py", str(path), "-o", str(folder / "out")])
    assert sweep.main() == 1
    out = capsys.readouterr().out
    assert out.count("failed: cornell_box, bad") == 4 and ": 4 rows" in out


def test_a_killed_sweep_loses_one_cell_at_most(folder):
    """Expected: after kill -9 in the middle every file in cells/ is whole, and the next run completes."""
    reference.make("cornell_box", 8, 3, error=1, seconds=100)
    path, output = preset_file(folder, PRESET.replace("seeds = 2", "seeds = 10")), folder / "out"
    code = (
        f"import sys; sys.path.insert(0, {str(ROOT / 'scripts')!r})\n"
        "import sweep, reference; from pathlib import Path\n"
        f"reference.REFERENCES = Path({str(folder / 'references')!r})\n"
        f"sys.argv = ['sweep.py', {str(path)!r}, '-o', {str(output)!r}]\n"
        "sys.exit(sweep.main())\n"
    )
    process = subprocess.Popen([sys.executable, "-c", code], stdout=subprocess.DEVNULL)
    deadline = time.monotonic() + 300
    while len(list((output / "cells").glob("*.json"))) < 5 and time.monotonic() < deadline:
        time.sleep(0.01)
    process.send_signal(signal.SIGKILL)
    process.wait()
    kept = {p: json.loads(p.read_text()) for p in (output / "cells").glob("*.json")}
    assert 5 <= len(kept) < 40
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=500)
    assert done.returncode == 0, done.stderr
    assert len(list((output / "cells").glob("*.json"))) == 40
    assert all(json.loads(p.read_text()) == row for p, row in kept.items())


def test_a_reference_that_is_too_noisy_judges_nothing():
    """Expected: a row says so where the reference's own error is above 1 % of that measured."""
    image = np.random.default_rng(1).random((8, 8, 3)) + 0.5
    for own, judged in ((1e-9, True), (1.0, False)):
        ref = reference.Reference(np.ones((8, 8, 3)), own, {})
        assert sweep.errors(image, ref)["judged"] is judged


@pytest.mark.parametrize(
    ("edit", "message"),
    [
        (("seeds = 2", "seeds = 0"), "seeds=0 must be a whole number"),
        (("seeds = 2", "sedes = 2"), "sedes is not a key"),
        (("seeds = 2\n", ""), "seeds is missing"),
        (("[2, 4]", "[2.5]"), r"spp=\[2.5\] must be a list of whole numbers"),
        (("cornell_box", "nowhere"), "scene='nowhere'"),
        (('match = "seconds"', 'match = "energy"'), "match='energy'.*'spp' or 'seconds'"),
        (('type = "path"', 'name = "path"'), "an integrator without type"),
        (('type = "path"', 'type = "path"\nmax_depth = 3'), "max_depth of integrator 'path' would compare"),
        (('type = "path"', 'type = "path"\nname = "ours"'), "two integrators have the same name"),
    ],
)
def test_mistakes_in_a_preset_are_named(tmp_path, edit, message):
    with pytest.raises(ValueError, match=message):
        sweep.read_preset(preset_file(tmp_path, PRESET.replace(*edit)))


@pytest.mark.parametrize("path", sorted((ROOT / "presets").glob("*.toml")), ids=lambda p: p.stem)
def test_presets_are_read(path):
    """Expected: every committed preset names scenes and integrators that exist."""
    for method in sweep.read_preset(path).methods:
        mi.load_dict(dict(method.parameters))


def test_cells_are_named_after_all_that_determines_them(tmp_path):
    """Expected: another seed, number of samples, parameter or sampler is another cell."""
    preset = sweep.read_preset(preset_file(tmp_path))
    names = {c.key for c in sweep.cells(preset, "cornell_box")}
    assert len(names) == 8
    other = sweep.read_preset(preset_file(tmp_path, PRESET.replace("max_depth = 3", "max_depth = 4")))
    assert not names & {c.key for c in sweep.cells(other, "cornell_box")}
    assert os.path.basename(sweep.cell_file(tmp_path, sweep.cells(preset, "cornell_box")[0])).endswith(
        ".json"
    )
