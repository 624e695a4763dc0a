"""Renders on a cluster: two worker processes on this machine."""

import json
import os
import signal
from dataclasses import replace
from functools import reduce
from pathlib import Path

import numpy as np
import pytest
import rendered
from mitsuba_bdpt.cli import cluster
from mitsuba_bdpt.cli.arguments import build_parser, main
from mitsuba_bdpt.errors import FailureError
from mitsuba_bdpt.files.loading import load
from mitsuba_bdpt.planning import pilot
from mitsuba_bdpt.run.snapshot import Snapshot
from mitsuba_bdpt.workers import results

SKY = """<scene version="3.0.0"><integrator type="bdpt"/>
<sensor type="perspective"><film type="hdrfilm"><integer name="width" value="8"/>
<integer name="height" value="8"/></film></sensor>
<shape type="sphere"><transform name="to_world"><translate z="5"/></transform></shape>
<emitter type="constant"><rgb name="radiance" value="$radiance"/></emitter></scene>"""

SCENE = Path(__file__).parents[2] / "scenes" / "cornell_box.xml"


def arguments(workers, output, *others, scene=SCENE):
    command = ["render", str(scene), "-D", "resolution=32", "--spp", "256", "--parts", "8", "-o", str(output)]
    return [*command, "--scheduler", workers.scheduler_address, *others]


def test_parts_cover_the_samples_with_seeds_of_their_own():
    parts = cluster.parts_of(1000, 7, 3)
    assert sum(spp for _, spp in parts) == 1000 and len(parts) == len({seed for seed, _ in parts}) == 7
    assert parts[0] == (3, 143) and all(0 <= seed < 2**32 for seed, _ in parts)
    assert len(cluster.parts_of(100, 64, 0)) == 6, "not below the least samples of a part"
    assert cluster.parts_of(5, 64, 0) == [(0, 5)]
    many, neighbour = cluster.parts_of(1 << 16, 1 << 12, 0), cluster.parts_of(1 << 16, 1 << 12, 1)
    assert len({seed for seed, _ in many} | {seed for seed, _ in neighbour}) == 1 << 13


@pytest.mark.parametrize(
    "name, merges", [("cornell_box", False), ("fog_lamp", False), ("smallvcm_cornell_point", True)]
)
def test_a_render_on_a_cluster_is_the_sum_of_its_parts(workers, tmp_path, name, merges):
    """To the rounding of atomic sums and of half precision."""
    path, given = SCENE.with_stem(name), ["-P", "merging=true"] * merges
    assert main(arguments(workers, tmp_path / "a.exr", *given, scene=path)) == 0
    pixels, statistics = rendered.image(tmp_path / "a.exr", "RGB")
    assert np.isfinite(pixels).all() and statistics["unbiased"] != merges
    assert not merges or statistics["merging"]["merges"]
    assert sum(statistics["passes"]) == statistics["spp"] == 256
    (decided,) = statistics["decisions"]
    assert statistics["no_pilot"] == ""
    if name == "cornell_box":  # tables of emission and all else that was decided go to the parts
        assert decided["emission"] and decided["joined"] == 4
    assert main(arguments(workers, tmp_path / "short.exr", "--spp", "15", scene=path)) == 0
    assert "samples, a pilot needs" in rendered.image(tmp_path / "short.exr", "RGB")[1]["no_pilot"]
    options = build_parser().parse_args(["render", str(path), "-D", "resolution=32", *given])
    scene, integrator, _ = load(options)
    job = cluster._job(scene, integrator, options, 256)
    assert json.loads(job)["decisions"] == [decided]
    parts = (cluster.render_part(job, i, *part) for i, part in enumerate(cluster.parts_of(256, 8, 0)))
    merged = reduce(Snapshot.joined, map(Snapshot.from_bytes, parts))
    expected = np.array(integrator.assemble(merged, scene))[..., :3]
    np.testing.assert_allclose(pixels, expected, rtol=2e-3, atol=1e-6)


@pytest.mark.parametrize(
    ("properties", "decided"),
    [([], True), ([("skip", "none")], False), ([("light_paths", 0)], False), ([("merging", True)], True)],
)
def test_parts_get_decisions_where_there_is_a_choice(properties, decided):
    arguments = ["render", str(SCENE), "--spp", "1", "-D", "resolution=8"]
    options = build_parser().parse_args(arguments)
    options.properties = properties
    scene, integrator, _ = load(options)
    job = cluster._job(scene, integrator, options, 1)
    settings = cluster._loaded(job)[2].settings
    assert settings.internals.decisions == (() if decided else None)
    assert settings.merging == dict(properties).get("merging", False)


def test_what_the_pilot_left_is_kept(workers, tmp_path, monkeypatch):
    measure = pilot.measure
    monkeypatch.setattr(pilot, "measure", lambda *a: replace(measure(*a), non_finite=7))
    assert main(arguments(workers, tmp_path / "a.exr")) == 0
    statistics = rendered.image(tmp_path / "a.exr", "RGB")[1]
    seconds = statistics["seconds"]
    assert statistics["non_finite_in_pilot"] == 7 and seconds["pilot"] > 0
    parts = sum(seconds[name] for name in ("compile", "pilot", "render"))
    assert seconds["total"] == pytest.approx(parts, rel=1e-6)
    assert {row["level"] for row in statistics["skipped"]}.isdisjoint({"by hand"})
    given = ["-P", "light_paths=1"]
    assert main(arguments(workers, tmp_path / "b.exr", *given)) == 0
    statistics = rendered.image(tmp_path / "b.exr", "RGB")[1]
    assert statistics["non_finite_in_pilot"] == 0 == statistics["seconds"]["pilot"]


def test_a_lost_worker_does_not_change_the_image(workers, tmp_path, monkeypatch):
    assert main(arguments(workers, tmp_path / "calm.exr")) == 0
    killed = []

    def lossy(client, *given):
        for part in results(client, *given):
            yield part
            if not killed:
                killed.extend(client.run(os.getpid).values())
                os.kill(killed[0], signal.SIGKILL)

    monkeypatch.setattr(cluster, "results", lossy)
    assert main(arguments(workers, tmp_path / "lost.exr")) == 0
    assert killed
    (expected, calm), (found, lost) = (
        rendered.image(tmp_path / "calm.exr", "RGB"),
        rendered.image(tmp_path / "lost.exr", "RGB"),
    )
    np.testing.assert_allclose(found, expected, rtol=2e-3, atol=1e-6)
    assert lost["rays"] == calm["rays"] and lost["passes"] == calm["passes"]


@pytest.mark.parametrize("come", [0, 3])
def test_parts_that_have_come_are_kept(workers, tmp_path, monkeypatch, capsys, come):
    """An image of those that had come before, though the first of all is missing, the error, and exit status
    1; no image where none had."""
    original = cluster.results

    def broken(*given):
        yield from sorted(original(*given))[1:][:come]
        raise FailureError("part 7 failed on the cluster: no memory")

    monkeypatch.setattr(cluster, "results", broken)
    assert main(arguments(workers, tmp_path / "a.exr")) == 1
    assert "part 7 failed on the cluster: no memory" in capsys.readouterr().err
    assert (tmp_path / "a.exr").exists() == (come > 0)
    if come:
        pixels, statistics = rendered.image(tmp_path / "a.exr", "RGB")
        assert np.isfinite(pixels).all() and statistics["spp"] == come * 32 and statistics["interrupted"]


def test_an_edited_scene_is_loaded_anew(workers, tmp_path):
    """10 % for noise."""
    scene = tmp_path / "scene.xml"
    means = []
    for radiance in ("1", "2"):
        scene.write_text(SKY.replace("$radiance", radiance))
        command = ["render", str(scene), "--spp", "32", "-o", str(tmp_path / "a.exr")]
        assert main([*command, "--scheduler", workers.scheduler_address]) == 0
        means.append(rendered.image(tmp_path / "a.exr", "RGB")[0].mean())
    assert means[1] == pytest.approx(2 * means[0], rel=0.1)
