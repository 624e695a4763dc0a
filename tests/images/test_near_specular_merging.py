"""Merges through near-specular lobes, between what is a delta lobe and what is none.

The scenes are those of `test_merging` with a rough plate; images beside those without are in
`test_same_mean`.
"""

from types import SimpleNamespace

import internals
import mitsuba as mi
import numpy as np
import pytest
from mitsuba_bdpt.geometry import rays
from mitsuba_bdpt.merging import merging, passes
from mitsuba_bdpt.planning import unsampled_light
from mitsuba_bdpt.run.rendering import Render
from mitsuba_bdpt.transport import light_path, mis, sds
from sds_scenes import (
    matte,
    point,
    rough,
    strategy_images,
    transform,
    under_glass,
)
from warned import Warned

import drjit as dr  # isort: skip

MERGED = {"merging": True, "merging_radius": 0.25}


def small_lamp(half, height, **more):
    """Under glass and a square lamp."""
    to_world = transform().look_at(origin=[0.8, 0, height], target=[0.8, 0, 0], up=[0, 1, 0]).scale(half)
    emitter = {"type": "area", "radiance": 10.0}
    lamp = {"type": "rectangle", "to_world": to_world, "bsdf": matte(0.0), "emitter": emitter}
    return under_glass(lamp, plate=rough(0.02), **more)


def near_pane():
    """A pane below a lamp, close to the camera: its pixels are smaller than the floor's by a factor of 6."""
    described = small_lamp(0.3, 3.4)
    described["plate"]["to_world"] = transform().translate([0, 0, 2.5]).scale([4, 4, 0.05])
    return described


def through_a_lens():
    """t = 0 is an alternative of the camera's side."""
    return small_lamp(0.1, 3.4, kind="thinlens")


@pytest.mark.parametrize(
    "described, slack, ended",
    [(near_pane, 0.2, True), (near_pane, 0.2, False), (through_a_lens, 0.05, True)],
)
def test_bounds_lose_no_light(described, slack, ended, monkeypatch):
    """What bounds leave out still has its weight: 15 % of the image was missing under a pane so close to the
    camera that discs at the floor are 36 times larger. A small ``slack`` leaves out many. Photon subpaths'
    roulette acts first; if they are not ``ended``, that of photons, and through a lens that of camera
    vertices. Tolerance: a few standard errors of the roulette."""
    if not ended:
        never = lambda self, state, partial, p: (mi.Float(1), state)  # noqa: E731
        monkeypatch.setattr(merging.Merging, "survival", never)
    built, found = mi.load_dict(described()), []
    for least in (slack, 1e30):
        monkeypatch.setattr(merging, "SLACK", least)
        _, layers = strategy_images(built, 32, 8, merging_radius=1.0, skip="none")
        found.append(layers["weighted.merged"].mean())
    assert found[0] == pytest.approx(found[1], rel=0.08)
    assert found[1] > 0


def test_undersampled_lamps_that_are_not_finite_are_named():
    described = mi.load_dict(under_glass(point() | {"intensity": 1e38}, plate=rough(0.01)))
    render = Render(described, described.sensors()[0], internals.bdpt(light_paths=0).settings, 0, 64)
    given = render.prepared, render.plan, render.settings
    assert unsampled_light.is_undersampling_possible(*given)
    with Warned() as warnings:
        found = unsampled_light.estimate(*given)
    assert len(warnings) == 1 and "how much light of emitter 'light' is not sampled is unknown" in warnings[0]
    assert not found.radiance


def test_stored_vertices_keep_their_merges():
    sums = [mi.Float(0.1 * i, i) for i in range(1, 5)]
    si = dr.zeros(mi.SurfaceInteraction3f, 2)
    anchor = rays.Anchor(si.p, si.n, mi.Float(0, 0), mi.Float(0, 0))
    vertex = SimpleNamespace(
        si=si,
        bsdf=si.bsdf(),
        cos=mi.Float(1),
        anchor=anchor,
        throughput=mi.Spectrum(1),
        partial=mis.Partial(*sums),
        edges=mi.UInt32(1),
        hit=mi.Bool(True),
        edge=None,
        sds=sds.State(isolated=mi.Bool(True, False), specular=mi.Bool(False, True)),
        layer=None,
        connectible=lambda: mi.Bool(True),
    )
    kernel = SimpleNamespace(
        store_size=2,
        sds=SimpleNamespace(merges=True, near_specular=True),
        heuristic=mis.Heuristic("balance"),
        light_groups=None,
        path_layers=False,
        has_media=False,
        plan=SimpleNamespace(joined=1),
        reach=mi.UInt32(9),
        shape_errors=SimpleNamespace(any=False),
    )
    path = light_path.allocate_light_path(kernel, 2)
    light_path.store_light_vertex(kernel, vertex, path)
    y = light_path.read_light_vertex(kernel, path, mi.UInt32(0))
    found = y.partial
    for a, b in zip((found.d_vcm, found.d_vc, found.d_vm, found.d_vm_newest), sums, strict=True):
        np.testing.assert_array_equal(a, b)
    assert list(y.sds.isolated) == [True, False] and list(y.sds.specular) == [False, True]


@pytest.mark.parametrize(
    ("plate", "parameters", "expected"),
    [
        (rough(0.01), {"skip": "none"}, [16] * 3),
        (None, {"skip": "none"}, [32, 16]),
        (None, {"light_paths": 0}, [16] * 3),
    ],
    ids=["rough", "ideal", "ideal, no light subpaths"],
)
def test_passes_are_short_where_many_paths_are_merged(plate, parameters, expected, monkeypatch):
    """Merges grow with the product of a pass's photons and queries."""
    monkeypatch.setattr(passes, "_LEAST_SAMPLES", 1)
    integrator = internals.bdpt(max_depth=5, **parameters, **MERGED)
    mi.render(mi.load_dict(under_glass(point(), plate=plate)), integrator=integrator, spp=48)
    assert integrator.statistics["passes"] == expected
