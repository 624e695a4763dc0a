"""scripts/endurance.py: what a run adds to the record of earlier ones."""

import json
import os
import signal
import subprocess
import sys
from pathlib import Path

import endurance
import mitsuba as mi
import numpy as np
import pytest
import repository
from mitsuba_bdpt.measure import reference

SCRIPT = Path(endurance.__file__)
TINY = ["--render-samples", "2048"]
SCENES = ["cornell_box", "furnace_white"]


def run(path, *more):
    """The record after a run, and its exit status."""
    status = endurance.main([*SCENES, *TINY, "--record", str(path), *map(str, more)])
    return json.loads(path.read_text()), status


def test_runs_add_up(tmp_path, capsys):
    """Expected: a second run goes on where the first one ended, with other settings and seeds; sums of all
    samples, and of those of each setting, agree; the scene that had the least time is next."""
    path = tmp_path / "record.json"
    first, status = run(path, "--samples", 70_000)  # a pixel has one sample at least, a film 256^2 pixels
    assert status == 0
    total = endurance.samples_of(first)
    assert total >= 70_000
    second, status = run(path, "--samples", total + 70_000)
    assert status == 0 and endurance.samples_of(second) >= total + 70_000
    for name, entry in second["scenes"].items():
        assert entry["samples"] == sum(entry["samples_by"].values())
        assert entry["renders"] >= first["scenes"][name]["renders"] >= 1
        assert entry["non_finite"] == 0 and entry["peak_memory"] > 1 << 20
    # How long each took is the machine's; which of them is next follows from it.
    least = min(SCENES, key=lambda name: first["scenes"][name]["seconds"])
    for key in ("renders", "seconds", "samples"):
        assert second["scenes"][least][key] > first["scenes"][least][key]
    assert sum(second["samples_by_source"].values()) == endurance.samples_of(second)
    assert list(tmp_path.iterdir()) == [path]
    # More than are asked for: nothing is rendered.
    assert run(path, "--samples", 1) == (second, 0)
    assert f"{endurance.samples_of(second):,} camera samples in " in capsys.readouterr().out


INTERRUPTED = """
import os, signal, sys
from pathlib import Path
import endurance, mitsuba_bdpt.run.rendering
kept, record, traced = [], Path(sys.argv[1]), mitsuba_bdpt.run.rendering.Render._pass

def interrupted(self, step):
    traced(self, step)
    if record.exists() and not kept:  # of the first render: this is the second one
        kept.append(record.read_text())
        Path(sys.argv[2]).write_text(kept[0])
        os.kill(os.getpid(), signal.SIGINT)

mitsuba_bdpt.run.rendering.Render._pass = interrupted
sys.exit(endurance.main(["cornell_box", "--record", sys.argv[1], "--render-samples", str(1 << 21)]))
"""


def test_an_interrupted_run_goes_on(tmp_path):
    """Rationale: half a second after the first render the second one had not begun where the machine was
    busy. Expected: Ctrl-C in the second render (a real process, which sends it to itself after a pass) leaves
    a whole record, with that render and the samples of its passes that were done beside those of the first
    one, and status 130; the next run adds to it."""
    path, former = tmp_path / "record.json", tmp_path / "former.json"
    done = subprocess.run(
        [sys.executable, "-c", INTERRUPTED, str(path), str(former)],
        env=os.environ | {"PYTHONPATH": os.pathsep.join([str(SCRIPT.parent), *sys.path])},
        capture_output=True,
        text=True,
        # A shell's background jobs ignore SIGINT, and Python keeps what it inherits.
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_DFL),
    )
    assert done.returncode == 130, done.stdout + done.stderr
    first = json.loads(former.read_text())
    before = json.loads(path.read_text())
    assert endurance.is_clean(before)
    (one,), (both,) = first["scenes"].values(), before["scenes"].values()
    assert both["renders"] == one["renders"] + 1 and both["samples"] > one["samples"] > 0
    assert sorted(p.name for p in tmp_path.iterdir()) == ["former.json", "record.json"]
    after, status = run(path, "--samples", endurance.samples_of(before) + 3000)
    assert status == 0
    assert endurance.samples_of(after) >= endurance.samples_of(before) + 3000


def test_an_interrupted_render_counts_its_passes(monkeypatch):
    """Expected: of a render that Ctrl-C ends the finished passes count, and no more."""
    from mitsuba_bdpt.run import rendering

    original, calls, interruption = rendering.Render._pass, [], endurance.Interruption()

    def one(self, step):
        calls.append(step.size)
        interruption.asked = len(calls) == 2
        original(self, step)

    monkeypatch.setattr(rendering.Render, "_pass", one)
    found = endurance.rendered("cornell_box", 1, 1 << 23, -1, interruption)
    _, width = endurance.settings(1)
    assert len(calls) == 2 and found["samples"] == width**2 * sum(calls)


def test_what_is_wrong_is_kept(tmp_path, monkeypatch):
    """Expected: values that are not finite, of images and of pilots, and renders that fail, are in the record
    and in the exit status."""
    path = tmp_path / "record.json"

    load = repository.load_scene

    def poisoned(name, **definitions):
        scene = load(name, **definitions)
        params = mi.traverse(scene)
        (radiance,) = [key for key in params.keys() if key.endswith("radiance.value")]
        params[radiance] = mi.Color3f(np.nan, 1, 1)
        params.update()
        return scene

    with monkeypatch.context() as patch:
        patch.setattr(repository, "load_scene", poisoned)
        record, status = run(path, "--samples", 1000)
        # Two samples for each of the 256^2 pixels of a first render: enough for a pilot.
        other = tmp_path / "other.json"
        arguments = ["cornell_box", "--record", str(other), "--samples", "1000"]
        assert endurance.main([*arguments, "--render-samples", str(1 << 17)]) == 1
    assert json.loads(other.read_text())["scenes"]["cornell_box"]["non_finite_in_pilot"] > 100
    assert status == 1 and max(entry["non_finite"] for entry in record["scenes"].values()) > 100


def no_scene(name, **definitions):
    raise RuntimeError("no such thing")


def failures(record):
    return [len(entry["failed"]) for entry in record["scenes"].values()]


def test_a_scene_that_fails_is_left_out_until_the_source_is_mended(tmp_path, monkeypatch, capsys):
    """Expected: after three failures a scene is left out, which each run and the table say; the run ends;
    with another source of the plugin, or a record that does not tell the source, it is tried again."""
    path = tmp_path / "record.json"
    monkeypatch.setattr(repository, "load_scene", no_scene)
    for _ in range(2):
        record, status = run(path, "--samples", 1000)
        assert status == 1 and failures(record) == [3, 3]
        out = capsys.readouterr().out
        for name in SCENES:
            assert f"{name}: left out after 3 failures: render 2" in out
        assert "Left out after 3 failures with this version of the source: `cornell_box`, `furn" in out
    assert "no such thing" in record["scenes"]["cornell_box"]["failed"][0]
    monkeypatch.setattr(reference, "source_digest", lambda: "mended")
    record, _ = run(path, "--samples", 1000)
    assert failures(record) == [6, 6]
    assert record["scenes"]["cornell_box"]["failed_by_source"]["mended"] == 3
    for entry in record["scenes"].values():
        del entry["failed_by_source"]
    path.write_text(json.dumps(record))
    assert failures(run(path, "--samples", 1000)[0]) == [9, 9]


@pytest.mark.parametrize("name", ["no_such_scene"])
def test_unknown_scenes_are_refused(name, capsys):
    with pytest.raises(SystemExit):
        endurance.main([name])
    assert name in capsys.readouterr().err
