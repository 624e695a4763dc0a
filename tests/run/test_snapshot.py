"""Renders that go on from a snapshot, and renders that are joined from several."""

import io
import json
import zlib

import internals
import mitsuba as mi
import numpy as np
import pytest
from mitsuba_bdpt.image.replicates import halves_of
from mitsuba_bdpt.planning import budget, choice
from mitsuba_bdpt.run.schedule import REPLICATES, _replicates
from mitsuba_bdpt.run.snapshot import FORMAT, Snapshot
from snapshots import ROUNDING, stopped


def scene(rfilter="box", size=16):
    box = mi.cornell_box()
    film = {"type": "hdrfilm", "width": size, "height": size, "rfilter": {"type": rfilter}}
    box["sensor"]["film"] = film | {"pixel_format": "rgb", "component_format": "float32"}
    return mi.load_dict(box)


def bdpt(**parameters):
    return internals.bdpt(**{"max_depth": 4, "spp_per_pass": 4} | parameters)


@pytest.mark.parametrize(
    ("rfilter", "parameters", "after"),
    [
        ("box", {}, 1),
        ("box", {"skip": "impossible"}, 1),
        ("gaussian", {"skip": "none"}, 3),
        ("box", {"layers": "variance", "aovs": "dd:depth"}, 5),
        ("box", {"target_error": 1e-9}, 9),
        ("box", {"layers": "strategies"}, 2),
        ("box", {"light_paths": 0, "points": "independent"}, 2),
    ],
)
def test_a_resumed_render_is_the_uninterrupted_one(rfilter, parameters, after):
    """Expected: the image, its layers and the counts of a render that was stopped and went on in a new
    integrator are those of the render that never stopped. Tolerance: the rounding of atomic sums."""
    target = scene(rfilter)
    whole = bdpt(**parameters)
    expected = np.array(whole.render(target, seed=3, spp=64))
    start = stopped(bdpt(**parameters), target, after, seed=3, spp=64)
    assert 0 < start.spp < 64
    resumed = bdpt(**parameters)
    image = np.array(resumed.render(target, seed=3, spp=64, start=start))
    np.testing.assert_allclose(image, expected, **ROUNDING)
    for name in ("rays", "connections", "passes", "decisions", "skipped"):
        assert resumed.statistics[name] == whole.statistics[name], name
    if whole.settings.variance:
        assert resumed.statistics["error"] == pytest.approx(whole.statistics["error"], rel=1e-3)


@pytest.mark.parametrize("blind", [False, True])
def test_pilots_and_decisions_go_on(monkeypatch, blind):
    """Expected: a render stopped after 41 spp or so goes on as the uninterrupted one, its decision included;
    also where the pilot is ``blind`` and decides nothing, so that a small pass comes first."""
    monkeypatch.setattr(budget, "LEAST_SAMPLES", 0)
    if blind:
        monkeypatch.setattr(choice, "choose", lambda *of: [])
    target = scene()
    whole = bdpt(spp_per_pass=8)
    expected = np.array(whole.render(target, seed=1, spp=128))
    assert len(whole.statistics["decisions"]) == 1 - blind
    start = stopped(bdpt(spp_per_pass=8), target, 6, seed=1, spp=128)
    resumed = bdpt(spp_per_pass=8)
    anew = scene()  # of which no pilot is remembered
    image = np.array(resumed.render(anew, seed=1, spp=128, start=start))
    assert resumed.statistics["decisions"] == whole.statistics["decisions"]
    assert resumed.statistics["passes"] == whole.statistics["passes"]
    np.testing.assert_allclose(image, expected, **ROUNDING)


@pytest.mark.parametrize(("rfilter", "tolerance"), [("box", 1e-5), ("gaussian", 0.02)])
def test_joined_renders_are_their_mean(rfilter, tolerance):
    """Renders of seeds of their own, made anywhere, add up by their raw sums. Expected: the mean of the three
    images, weighted by their samples. Tolerance: the mean relative difference is rounding with the box
    filter; with others the sums of filter weights differ by some per cent from render to render, which the
    mean of images does not know."""
    target, parts = scene(rfilter), ((5, 8), (6, 16), (7, 8))
    snapshots = [part(target, seed, spp) for seed, spp in parts]
    images = [np.array(bdpt(skip="impossible").render(target, seed=seed, spp=spp)) for seed, spp in parts]
    joined = snapshots[0].joined(snapshots[1]).joined(snapshots[2])
    assert joined.spp == 32 and joined.identity["seed"] == [5, 6, 7]
    assert joined.progress.work.counts["camera"] == sum(s.progress.work.counts["camera"] for s in snapshots)
    image = np.array(bdpt(skip="impossible").assemble(joined, target))
    expected = sum(spp * image for (_, spp), image in zip(parts, images, strict=True)) / 32
    assert abs(image - expected).mean() < tolerance * expected.mean()


def part(target, seed: int, spp: int, **parameters) -> Snapshot:
    """The snapshot of a whole render, reduced to what is joined."""
    integrator = bdpt(skip="impossible", **parameters)
    return stopped(integrator, target, after=None, seed=seed, spp=spp).image_only()


def test_joined_variance_is_that_of_all_replicates():
    """Expected: the variance that follows from 8 replicates of one render and 8 of another is that of the 16
    images, whose weighted mean and squares are taken here in one go; the joined order does not matter."""
    target = scene()
    a, b = (part(target, seed, spp, layers="variance") for seed, spp in ((1, 16), (2, 32)))
    image = np.array(bdpt(skip="impossible", layers="variance").assemble(a.joined(b), target))
    swapped = np.array(bdpt(skip="impossible", layers="variance").assemble(b.joined(a), target))
    np.testing.assert_allclose(image, swapped, **ROUNDING)
    halves = [half for s in (a, b) for half in halves_of(s.arrays)]
    assert [(half.count, half.spp) for half in halves] == [(4, 8), (4, 8), (4, 16), (4, 16)]
    mean = sum(half.spp * half.mean for half in halves) / 48
    total = sum(half.squares + half.spp * (half.mean - mean) ** 2 for half in halves)
    np.testing.assert_allclose(image[..., 3:], total / (48 * 15), rtol=1e-3, atol=1e-9)


def test_what_does_not_belong_together_is_refused():
    target = scene()
    start = stopped(bdpt(), target, 1, seed=0, spp=16)
    for arguments, parameters, name in (
        ({"seed": 1, "spp": 16}, {}, "seed"),
        ({"seed": 0, "spp": 32}, {}, "spp"),
        ({"seed": 0, "spp": 16}, {"max_depth": 5}, "max_depth"),
        ({"seed": 0, "spp": 16}, {"heuristic": "power"}, "heuristic"),
    ):
        with pytest.raises(ValueError, match=f"its {name} is"):
            bdpt(**parameters).render(target, start=start, **arguments)
    with pytest.raises(ValueError, match="its film is"):
        bdpt().render(scene(size=12), seed=0, spp=16, start=start)
    with pytest.raises(ValueError, match="its filter is"):
        bdpt().render(scene("gaussian"), seed=0, spp=16, start=start)
    with pytest.raises(TypeError, match="start=dict must be a snapshot"):
        bdpt().render(target, start={})
    with pytest.raises(ValueError, match="seed=0 is in both"):
        start.joined(start)
    with pytest.raises(ValueError, match="not a snapshot"):
        Snapshot.from_bytes(b"PK\x03\x04 and then nothing")
    with pytest.raises(ValueError, match="only assemble"):
        bdpt().render(target, seed=0, spp=16, start=start.image_only())
    # When a render is looked at is not what is in it.
    timed = np.array(bdpt(timeout=1e6).render(target, seed=0, spp=16, start=start))
    np.testing.assert_allclose(timed, np.array(bdpt().render(target, seed=0, spp=16)), **ROUNDING)


def test_another_format_is_refused():
    """Rationale: a later version may hold other things. Expected: of a snapshot in another format, whatever
    is in it, the format is named."""
    other = json.dumps({"identity": {"format": 0}, "passes": [1], "progress": {"unknown": 1}})
    file = io.BytesIO()
    np.savez(file, snapshot=np.array(other))
    with pytest.raises(ValueError, match=f"another version.*: its format is 0, here it is {FORMAT}"):
        Snapshot.from_bytes(file.getvalue())


def test_the_format_has_a_new_number_where_names_change():
    """Expected: a checkpoint with a pilot has the names, and rows of the sizes, of the format's number; if
    not, increase `snapshot.FORMAT`, and write down both here."""
    start = stopped(bdpt(), scene(size=32), 1, spp=64)
    with np.load(io.BytesIO(start.to_bytes())) as file:
        sizes = {name: file[name].shape[1:] for name in sorted(file.files)}
        found = json.loads(str(file["snapshot"]))["progress"]
    names = [sorted(part) for part in (found, found["counts"], found["decisions"][0])]
    assert (FORMAT, zlib.crc32(repr((names, sizes)).encode())) == (13, 2998143257)


def test_decide_is_the_pilot_of_a_render():
    """Expected: the decisions that a client asks for once are those of the render itself, and a render
    that replays them is the same."""
    target = scene(size=32)
    integrator = bdpt()
    decisions = integrator.decide(target, seed=4, spp=1024)
    integrator.render(scene(size=32), seed=4, spp=1024, develop=False)
    assert decisions and decisions[0] == integrator.statistics["decisions"][0]
    assert integrator.decide(target, spp=1) == []
    replayed = bdpt(decisions=decisions)
    replayed.render(target, seed=4, spp=8, develop=False)
    assert replayed.statistics["decisions"] == decisions


def test_replicates_of_a_render_until_an_error_grow():
    assert _replicates(19, growing=False) == [3, 3, 3, 2, 2, 2, 2, 2]
    sizes = _replicates(1024, growing=True)
    assert sum(sizes) == 1024 and len(sizes) % REPLICATES == 0
    assert sizes[:9] == [4] * 9 and sizes[-8:] == [64] * 8
    assert _replicates(35, growing=True) == [4] * 8 + [1, 1, 1]


def test_a_render_ends_at_the_error_that_is_asked_for():
    """Expected: a render until an error stops at 32, 64, 128, … spp, the first at which its estimate is
    small enough; what it reports is that estimate, also in its last report."""
    target, reports = scene(), []
    integrator = bdpt(target_error=0.004)
    integrator.on_pass = reports.append
    integrator.render(target, seed=2, spp=1 << 14, develop=False)
    done = sum(integrator.statistics["passes"])
    assert done in (64, 128, 256, 512, 1024)
    assert integrator.statistics["error"] == reports[-1].error <= 0.004
    errors = [report.error for report in reports if report.error is not None]
    assert all(error > 0.004 for error in errors if error != errors[-1])
