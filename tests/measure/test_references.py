"""References: what is stored, what a further run goes on with, what is refused."""

from dataclasses import replace
from types import SimpleNamespace

import mitsuba as mi
import numpy as np
import pytest
from mitsuba_bdpt.cli.arguments import build_parser
from mitsuba_bdpt.errors import CommandError
from mitsuba_bdpt.measure import agreement, making, reference, scenes
from mitsuba_bdpt.measure.making import Job
from mitsuba_bdpt.measure.models import PresetFile
from mitsuba_bdpt.measure.preset import read_preset
from repository import PROJECT, ROOT


@pytest.fixture
def renders(monkeypatch):
    """Records the samples and seeds of renders, which take a second per sample, the first one ten more, and
    have a 32nd of their samples."""
    seen, clock, render = [], [0.0], making.mi.render

    def rendered(scene, *, spp, seed, **more):
        clock[0] += spp + (0 if seen else 10)
        seen.append((spp, seed))
        return render(scene, spp=max(spp // 32, 1), seed=seed, **more)

    monkeypatch.setattr(making, "time", SimpleNamespace(perf_counter=lambda: clock[0]))
    monkeypatch.setattr(making.mi, "render", rendered)
    return seen


def stored(project, max_depth, name="cornell_box"):
    return reference.load_reference(project, project.scene(name), 8, max_depth)


def test_a_reference_comes_back_with_its_error_and_provenance(project, job):
    """Half precision: 2^-11 relative; 100 times the samples that it judges."""
    made, reached = making.make(job(2))
    kept = stored(project, 2)
    np.testing.assert_allclose(kept.image, made.image, rtol=2.0**-11, atol=1e-6)
    assert reached and kept.error == pytest.approx(made.error, rel=0.05) and kept.error > 0
    assert kept.means.columns.freedom >= 7
    np.testing.assert_allclose(kept.means.columns.mean, agreement.tile_columns(kept.image), rtol=2e-3)
    np.testing.assert_allclose(kept.means.whole.error, made.means.whole.error, rtol=1e-6)
    assert kept.provenance["integrator"] == {"type": "path", "max_depth": 2}
    assert 400 <= kept.provenance["spp"] <= 800 and kept.provenance["versions"]["mitsuba"].startswith("3.9")


def test_furnaces_are_known_without_error(project, job):
    making.make(job(3, "furnace_emission"))
    kept = stored(project, 3, "furnace_emission")
    assert (kept.image == 0.875).all() and kept.error == 0
    assert (kept.means.columns.error == 0).all() and kept.means.columns.freedom == np.inf
    assert kept.provenance["integrator"] == "known answer"


def test_halves_estimate_the_error_of_their_mean():
    """Of halves r + e and r - e the error is that of r + e against r: e^2 / (r^2 + 0.01 r^2)."""
    halves = making.Halves("box")
    r, e = np.full((4, 4, 3), 2.0), 0.1
    for _ in range(4):
        halves.add([r + e, r - e], 4)
    made = halves.reference({})
    assert made.error == pytest.approx(e**2 / (4 * 1.01))
    assert made.means.columns.error == pytest.approx(e / np.sqrt(7))
    with pytest.raises(CommandError, match="box: round 4 has values that are not finite"):
        halves.add([r, np.full((4, 4, 3), np.inf)], 4)
    assert halves.rounds == 4 and np.isfinite(halves.sums).all()


def test_windows_of_halves_have_more_samples():
    halves, window = making.Halves("box"), (slice(1, 3), slice(0, 1))
    for value in (1.0, 3.0):
        halves.add([np.full((4, 4, 3), value)] * 2, 8)
    halves.add([np.full((2, 1, 3), 5.0), np.full((2, 1, 3), 9.0)], 32, window)
    made = halves.reference({})
    expected, half = np.full((4, 4, 3), 2.0), np.zeros((4, 4, 3))
    expected[window], half[window] = (2 * 2 + 4 * 7) / 6, (4 * 5 - 4 * 9) / 6 / 2
    np.testing.assert_allclose(made.image, expected)
    np.testing.assert_allclose(made.difference, half)
    assert len(halves.columns) == 4 and (halves.spp.min(), halves.spp.max()) == (16, 48)


def test_a_run_goes_on_from_the_stored_reference(tmp_path):
    """Up to half precision (2^-11 of a value)."""
    rng, window = np.random.default_rng(3), (slice(0, 4), slice(4, 8))
    halves, again = making.Halves("box"), making.Halves("box")
    for _ in range(agreement.FEWEST_RUNS):
        halves.add(rng.uniform(1, 2, (2, 16, 16, 3)), 256)
    halves.add(rng.uniform(1, 2, (2, 4, 4, 3)), 1024, window)
    spp = {"spp": 2 * 8 * 256, "spp_in_windows": 2 * 12 * 256, "sources": ["x"]}
    reference.write(tmp_path / "a.exr", halves.reference(spp))
    again.go_on_from(reference.read_reference(tmp_path / "a.exr"), [window])
    np.testing.assert_allclose(again.spp, halves.spp)
    assert again.rounds >= halves.rounds and "x" in again.sources
    for images in rng.uniform(1, 2, (agreement.FEWEST_RUNS, 2, 16, 16, 3)):
        halves.add(images, 256)
        again.add(images, 256)
    np.testing.assert_allclose(again.sums, halves.sums, rtol=2**-10)
    for part in ("columns", "whole"):
        ours, theirs = (getattr(one.means(), part) for one in (again, halves))
        for name in ("mean", "error", "nonzero", "freedom"):
            np.testing.assert_allclose(getattr(ours, name), getattr(theirs, name), rtol=1e-6)


def test_windows_cover_the_glass_and_show_the_same():
    """Depths, which range over 2, agree to 0.02 on average (random positions at the outlines)."""
    job = Job(PROJECT, PROJECT.scene("glass_caustics"), 64)
    scene = job.scene.load(64)
    shares = making.recipe_of(PROJECT, "glass_caustics").windows
    windows = [making.Window(job, share, making.SAMPLER) for share in shares]
    inside = np.zeros((64, 64), bool)
    for window in windows:
        inside[window.slices] = True
    y, x = np.mgrid[:64, :64]
    at = mi.Point2f((x.ravel() + 0.5).tolist(), (y.ravel() + 0.5).tolist()) / 64
    si = scene.ray_intersect(scene.sensors()[0].sample_ray(0, 0.5, at, 0.5)[0])
    delta = np.array(mi.has_flag(si.bsdf().flags(), mi.BSDFFlags.Delta)).reshape(64, 64)
    assert inside.mean() < 0.2 and delta.sum() > 200 and not (delta & ~inside).any()
    depth = mi.load_dict({"type": "depth"})
    whole = np.array(depth.render(scene, spp=256))[windows[0].slices]
    part = np.array(depth.render(windows[0].scene, spp=256))
    assert part.shape == whole.shape and part.std() > 0.1
    assert np.abs(part - whole).mean() < 0.02


def test_an_interrupted_reference_is_gone_on_with(project, job, monkeypatch):
    render, count = making.mi.render, iter(range(99))

    def interrupted(*args, **more):
        if next(count) == 6:  # two that are timed and two rounds
            raise KeyboardInterrupt
        return render(*args, **more)

    with monkeypatch.context() as patched:
        patched.setattr(making.mi, "render", interrupted)
        with pytest.raises(KeyboardInterrupt):
            making.obtained(job(2, seconds=0, by="bdpt"))

    def lack(spp):
        return job(2, spp=spp, share=making.SHARE_ON_THE_WAY).lack

    assert stored(project, 2).provenance["spp"] == 16
    assert lack(1) and "has 16 of 40 samples per pixel; going on" in lack(4)  # too few renders; samples
    assert making.obtained(job(2, seconds=0, by="bdpt")).provenance["spp"] == 48
    assert not lack(4) and lack(64)
    made = making.obtained(job(2, seconds=0, spp=64))  # with the integrator asked for before
    assert 48 < made.provenance["spp"] < 640 and made.provenance["integrator"]["type"] == "bdpt"
    assert not lack(64) and lack(65)  # ended by the limit


def test_a_reference_has_the_samples_that_fit(job, capsys, renders):
    """Of 266 s 236 remain after measuring: 80 % hold eight renders of 16 samples, the rest six more."""
    made = making.obtained(job(2, seconds=266.0, spp=64))
    assert [spp for spp, _ in renders] == [4, 16, *[16] * 14]
    assert made.provenance["spp"] == 224 and made.means.columns.freedom == 13
    said = capsys.readouterr().out
    assert "as many as fit into 266 s, of 640 to judge 64 spp; to go on: mitsuba-bdpt reference" in said
    made, _ = making.make(job(2, seconds=1))
    assert made.means.columns.freedom == 13
    seeds = [seed for _, seed in renders if seed >= making.FIRST_SEED]
    assert len(seeds) == len({*seeds}) == 16
    renders.clear()
    making.obtained(job(3, seconds=20.0))
    assert [spp for spp, _ in renders] == [4, 16, *[4] * 8]
    out = capsys.readouterr().out
    assert "warning: cornell_box: 20 s are too few for its reference, which takes about 62 s" in out


def test_a_reference_on_the_way_has_a_tenth_of_the_samples(job, renders):
    made = making.obtained(job(2, spp=64, by="bdpt", seconds=1e5))
    assert [spp for spp, _ in renders] == [4, 16, *[128] * 8] and made.provenance["spp"] == 1024
    assert made.provenance["share"] == making.SHARE_ON_THE_WAY
    assert making.make(job(2, spp=64, by="bdpt", seconds=1e5))[0].provenance["spp"] >= 6400


def test_a_reference_on_the_way_is_looked_at_once(monkeypatch, job, renders):
    """Rationale: its header was read four times, and write access tested twice. Expected: read before and
    after the integrator that made it is known; tested once."""
    calls = []
    for name in ("header_of", "check_writable"):
        real = getattr(making, name)
        monkeypatch.setattr(making, name, lambda path, n=name, real=real: [calls.append(n), real(path)][1])
    making.obtained(job(2, spp=8, by="bdpt", seconds=1e5))
    assert calls.count("header_of") <= 2 and calls.count("check_writable") == 1
    calls.clear()
    making.obtained(job(2, spp=8, by="bdpt", seconds=1e5))
    assert calls.count("header_of") <= 2 and "check_writable" not in calls


def test_a_better_reference_stays(project, job):
    made, _ = making.make(job(2))
    other = replace(made, provenance=made.provenance | {"sampler": "another"})
    reference.write(job(2).path, other)
    kept, reached = making.make(job(2, seconds=0, spp=8))
    assert not reached and kept.provenance["spp"] == other.provenance["spp"]
    assert not job(2, spp=8).lack and job(2, spp=9).lack
    assert stored(project, 2).provenance["spp"] == other.provenance["spp"]
    assert making.make(job(2))[1]


def test_a_reference_with_merging_replaces_one_without(project, job):
    name = "lamp_behind_glass"
    plain, _ = making.make(job(5, name, by="bdpt"))
    assert not plain.merged and not stored(project, 5, name).merged
    made, reached = making.make(job(5, name, seconds=0))
    assert not reached and made.merged and made.error > plain.error
    assert stored(project, 5, name).merged


def test_what_cannot_be_judged_by_is_refused(monkeypatch, project, job):
    too_bright = reference.Reference(np.full((4, 4, 3), 1e5), np.zeros((4, 4, 3)), None, {})
    with pytest.raises(CommandError, match="radiance 100000 does not fit into half precision"):
        reference.write(project.references / "bright.exr", too_bright)
    command = "mitsuba-bdpt reference cornell_box --resolution 8 --max-depth 2 --seconds 600 "
    command += f"--project {project.root}"
    with pytest.raises(CommandError, match=f"no reference.*{command}"):
        stored(project, 2)
    making.make(job(2, seconds=0))
    monkeypatch.setattr(scenes.SceneFile, "sha256", "another file")
    with pytest.raises(CommandError, match=f"another cornell_box, mesh or texture; {command}"):
        stored(project, 2)


@pytest.mark.parametrize("path", sorted((ROOT / "references").glob("*.exr")), ids=lambda path: path.stem)
def test_committed_references_are_of_their_scenes(path):
    kept = reference.header_of(path)
    name, resolution, _ = path.stem.rsplit("_", 2)
    assert resolution == "128" and kept["scene_sha256"] == PROJECT.scene(name).sha256
    assert kept.get("spp_per_render", making.PASS_SPP) == making.PASS_SPP
    assert kept.get("share", making.SHARE) == making.SHARE


def test_the_command_line_of_references_tells_what_failed(capsys, project):
    def run(*arguments):
        words = ["reference", "--project", str(project.root), *arguments]
        return making.run(build_parser().parse_args(words))

    small = ("--resolution", "8", "--max-depth", "2", "--spp", "4")
    assert run("nowhere", "furnace_point", *small) == 1
    out = capsys.readouterr().out
    assert "nowhere: failed: scene='nowhere' is neither" in out and "furnace_point: known answer" in out
    assert run("cornell_box", *small, "--seconds", "0") == 1
    assert "to go on: mitsuba-bdpt reference" in capsys.readouterr().out
    assert run("cornell_box", *small) == 0
    for wrong in (("--spp", "0"), ("--resolution", "50"), ("--max-depth", "0")):
        with pytest.raises(SystemExit):
            run("cornell_box", *wrong)


def test_a_reference_is_of_the_depth_that_presets_ask_for(project, job):
    depths = [job(None, name).depth for name in ("cornell_box", "pool")]
    preset = read_preset(project.preset("benchmark"), project, ["cornell_box", "pool"])
    assert depths == [cells.max_depth for cells in preset.cells]
    assert depths[0] != project.scene("cornell_box").max_depth
    file = PresetFile.model_validate({"max_depth": 3, "scene": {"pool": {"max_depth": 4}}})
    assert [file.depth(name, 9) for name in ("pool", "cornell_box")] == [4, 3]
