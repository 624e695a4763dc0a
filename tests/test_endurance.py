"""scripts/endurance.py: what a run adds to the record of earlier ones."""

import json
import signal
import subprocess
import sys
import time
from pathlib import Path

import endurance
import mitsuba as mi
import numpy as np
import pytest
import reference

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
        assert entry["renders"] > first["scenes"][name]["renders"] >= 1
        assert entry["seconds"] > first["scenes"][name]["seconds"]
        assert entry["non_finite"] == 0 and entry["peak_memory"] > 1 << 20
    assert sum(second["samples_by_source"].values()) == endurance.samples_of(second)
    assert list(tmp_path.iterdir()) == [path]
    # More than are asked for: nothing is rendered.
    assert run(path, "--samples", 1) == (second, 0)
    assert f"{endurance.samples_of(second):.4g} samples in all" in capsys.readouterr().out


def test_settings_are_varied():
    """Expected: over 48 renders every size with both kinds of skip, every heuristic with both, and every size
    with every heuristic at least once."""
    seen = [endurance.settings(number) for number in range(48)]
    assert {(p["skip"], width) for p, width in seen} >= {
        (s, w) for s in ("auto", "none") for w in endurance.SIZES
    }
    assert len({(p["skip"], p["heuristic"]) for p, _ in seen}) == 8
    assert len({(p["heuristic"], width) for p, width in seen}) == 4 * len(endurance.SIZES)


def test_an_interrupted_run_goes_on(tmp_path):
    """Expected: Ctrl-C in the middle of the second render (a real process) leaves a whole record, with that
    render and the samples of its passes that were done beside those of the first one, and status 130; the
    next run adds to it."""
    path = tmp_path / "record.json"
    command = [sys.executable, str(SCRIPT), "cornell_box", "--record", str(path)]
    first = None
    with (tmp_path / "log").open("w") as log:
        process = subprocess.Popen(
            [*command, "--render-samples", str(1 << 21)],
            stdout=log,
            stderr=log,
            # A shell's background jobs ignore SIGINT, and Python keeps what it inherits.
            preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_DFL),
        )
        try:
            deadline = time.monotonic() + 240
            while process.poll() is None:
                assert time.monotonic() < deadline, (tmp_path / "log").read_text()
                if path.exists():
                    first = json.loads(path.read_text())
                    time.sleep(0.5)  # into the second render, which takes seconds
                    process.send_signal(signal.SIGINT)
                    process.wait(timeout=240)
                time.sleep(0.05)
            assert process.returncode == 130, (tmp_path / "log").read_text()
        finally:
            process.kill()
            process.wait()
    before = json.loads(path.read_text())
    assert endurance.is_clean(before)
    (one,), (both,) = first["scenes"].values(), before["scenes"].values()
    assert both["renders"] == one["renders"] + 1 and both["samples"] > one["samples"] > 0
    assert sorted(p.name for p in tmp_path.iterdir()) == ["log", "record.json"]
    after, status = run(path, "--samples", endurance.samples_of(before) + 3000)
    assert status == 0
    assert endurance.samples_of(after) >= endurance.samples_of(before) + 3000


def test_an_interrupted_render_counts_its_passes(monkeypatch):
    """Expected: of a render that Ctrl-C ends the finished passes count, and no more."""
    from mitsuba_bdpt import rendering

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
    """Expected: values that are not finite, and renders that fail, are in the record and in the exit status;
    a scene that fails three times is left out, and the run ends."""
    path = tmp_path / "record.json"

    def fail(name, **definitions):
        raise RuntimeError("no such thing")

    with monkeypatch.context() as patch:
        patch.setattr(reference, "load_scene", fail)
        record, status = run(path, "--samples", 1000)
    assert status == 1 and [len(e["failed"]) for e in record["scenes"].values()] == [3, 3]
    assert "no such thing" in record["scenes"]["cornell_box"]["failed"][0]
    path.unlink()
    load = reference.load_scene

    def poisoned(name, **definitions):
        scene = load(name, **definitions)
        params = mi.traverse(scene)
        (radiance,) = [key for key in params.keys() if key.endswith("radiance.value")]  # noqa: SIM118
        params[radiance] = mi.Color3f(np.nan, 1, 1)
        params.update()
        return scene

    with monkeypatch.context() as patch:
        patch.setattr(reference, "load_scene", poisoned)
        record, status = run(path, "--samples", 1000)
    assert status == 1 and max(entry["non_finite"] for entry in record["scenes"].values()) > 100


@pytest.mark.parametrize("name", ["no_such_scene"])
def test_unknown_scenes_are_refused(name, capsys):
    with pytest.raises(SystemExit):
        endurance.main([name])
    assert name in capsys.readouterr().err
