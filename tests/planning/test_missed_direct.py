"""Light of delta emitters on a sensor with area, direct or by delta events: said where it is not sampled."""

import mitsuba as mi
import pytest
import scene_parts as parts
from mitsuba_bdpt.planning import missed_direct
from mitsuba_bdpt.run.rendering import Render

T = parts.T
LAMPS = {
    "point": {"type": "point", "id": "bulb", "position": [0, 0, 1], "intensity": 3.0},
    "spot": {"type": "spot", "id": "bulb", "to_world": T().look_at([0, 0, 1], [0, 0, 0], [0, 1, 0])},
    "directional": {"type": "directional", "id": "bulb", "direction": [0.1, 0, -1]},
}
AREA_LAMP = {
    "type": "rectangle",
    "to_world": T().translate([0, 0, 1]).rotate([1, 0, 0], 180).scale(0.2),
    "emitter": {"type": "area", "radiance": 3.0},
}
LENS = parts.thinlens(0.3, 3.0, origin=(0, 0, -3), target=(0, 0, 1), size=4)
CAMERA = parts.perspective(origin=(0, 0, -3), target=(0, 0, 1), size=4)
FLOOR = {"type": "rectangle", "to_world": T().translate([0, 0, -0.3])}
BLIND = {"type": "rectangle", "to_world": T().translate([0, 0, 0.5])}


def meter(x=0.0):
    plate = {"type": "rectangle", "to_world": T().translate([x, 0, 0]).scale(0.2)}
    return parts.meter(plate)


def batch(**views):
    return {"type": "batch", "film": parts.film(size=1, width=2), **views}


def said(capfd, sensor, lamp, method=None, **others):
    """Warnings of a render of one sample, and what `explain` says is lost."""
    scene = {"type": "scene", "sensor": sensor, "lamp": lamp} | others
    scene = mi.load_dict(scene, optimize=False)
    method = mi.load_dict({"type": "bdpt", "max_depth": 4} | (method or {}))
    method.render(scene, spp=1)
    lines = capfd.readouterr().out.splitlines()
    warnings = [line for line in lines if "bdpt: not sampled: " in line]
    return warnings, [line for line in method.explain(scene, spp=1).splitlines() if "not sampled: " in line]


WITHOUT = {"light_paths": 0}
LOST = {
    "a meter without light subpaths": (meter, WITHOUT, "leave light_paths at auto"),
    "a batch of meters without them": (
        lambda: batch(a=meter(-0.1), b=meter(0.1)),
        WITHOUT,
        "leave light_paths at auto",
    ),
    "a meter beside a camera": (lambda: batch(a=CAMERA, b=meter()), {}, "render the views one by one"),
}


@pytest.mark.parametrize("lamp", LAMPS)
@pytest.mark.parametrize("case", LOST)
def test_missing_direct_light_is_said(case, lamp, capfd):
    """Rationale: only (1,1) and t = 0 sample direct light of a delta emitter on a sensor with area; without
    them a meter reads 0, which looks like a measurement.

    Expected: one warning that names the lamp, and the remedy; a line of `explain`.
    """
    sensor, method, remedy = LOST[case]
    warnings, lost = said(capfd, sensor(), LAMPS[lamp], method, floor=FLOOR)
    assert len(warnings) == 1
    assert "'bulb' shines directly on" in warnings[0] and remedy in warnings[0]
    assert "not sampled: delta emitter - sensor (needs (1,1))" in lost


GLASS = {"type": "rectangle", "to_world": T().translate([0, 0, 0.3]), "bsdf": {"type": "thindielectric"}}
BEAM = {
    "type": "rectangle",
    "to_world": T().translate([0, 0, 1]).rotate([1, 0, 0], 180).scale(0.2),
    "emitter": {"type": "directionalarea", "id": "bulb", "radiance": 3.0},
}


def of_plan(sensor, lamp, method=None, **others):
    """The warnings before a render, which is not made."""
    return of_scene(
        mi.load_dict({"type": "scene", "sensor": sensor, "lamp": lamp} | others, optimize=False), method
    )


def of_scene(scene, method):
    """The same, of a loaded scene."""
    settings = mi.load_dict({"type": "bdpt", "max_depth": 4} | (method or {})).settings
    render = Render(scene, scene.sensors()[0], settings, 0, 1)
    found = missed_direct.warnings(render.prepared, render.plan, settings, render.findings)
    return [text for text in found if text]


@pytest.mark.parametrize("lamp", [LAMPS["point"], BEAM], ids=["point", "beam"])
def test_missing_light_through_glass_is_said(lamp):
    """Rationale: through a pane, or from a lamp that emits into one direction, only t = 0 samples it.

    Expected: one warning that names lamp and remedy, none of direct light, which the pane stops; none where
    t = 0 takes part, or where a wall stops the light.
    """
    (warning,) = of_plan(meter(), lamp, WITHOUT, pane=GLASS)
    assert "'bulb' shines through glass or mirrors on" in warning and "leave light_paths at auto" in warning
    assert of_plan(meter(), lamp, pane=GLASS) == []
    assert of_plan(meter(), lamp, WITHOUT, pane=GLASS, blind=BLIND) == []


def test_each_render_of_a_scene_has_its_own_hidden_emitters():
    """Rationale: what an earlier render of the scene found is cached. Expected: direct light of a beam is
    missing where emitters are shown, and only there, in every order of renders.
    """
    hidden = [{"hide_emitters": value} for value in (True, False, True)]
    scene = mi.load_dict({"type": "scene", "sensor": meter(), "lamp": BEAM}, optimize=False)
    found = [len(of_scene(scene, WITHOUT | parameters)) for parameters in hidden]
    assert found == [0, 1, 0]


def test_missing_light_through_glass_in_fog_is_said():
    """Rationale: media were left out. Expected: as without the fog, which lies between glass and meter; in an
    opaque one nothing arrives.
    """
    pane = GLASS | {"bsdf": {"type": "dielectric"}}  # edges pass a thin one where there are media

    def fog(sigma_t):
        to_world = T().translate([0, 0, 0.15]).scale([1, 1, 0.1])
        medium = {"type": "homogeneous", "sigma_t": sigma_t, "albedo": 0.5}
        return {"type": "cube", "to_world": to_world, "bsdf": {"type": "null"}, "interior": medium}

    (warning,) = of_plan(meter(), LAMPS["point"], WITHOUT, pane=pane, fog=fog(0.5))
    assert "'bulb' shines through glass or mirrors on" in warning
    assert of_plan(meter(), LAMPS["point"], WITHOUT, pane=pane, fog=fog(1e4)) == []


def test_a_lamp_that_starts_no_light_subpath_is_not_looked_for():
    """Rationale: a user's own lamp without area has none to follow. Expected: no warning, no error."""
    parts.register_plugins()
    assert of_plan(meter(), parts.EMITTERS["own lamp"](), WITHOUT, pane=GLASS) == []


def test_a_batch_of_meters_behind_glass():
    """Expected: a warning by default too: t = 0 does not look which of the meters light hits."""
    a, b = (mi.load_dict(meter(x)) for x in (-0.1, 0.1))
    (warning,) = of_plan(batch(a=a, b=b), LAMPS["point"], pane=GLASS, plate_a=a, plate_b=b)
    assert "through glass or mirrors on" in warning and "render the views one by one" in warning


def test_a_lens_without_light_subpaths(capfd):
    """Rationale: a point light before an open lens is a disk on the film, which camera subpaths miss.

    Expected: a warning if the lens sees it, none if it is outside the image or behind a surface.
    """
    for lamp, blind, count in (("point", {}, 1), ("point", {"blind": BLIND}, 0), ("behind", {}, 0)):
        source = LAMPS["point"] | ({"position": [0, 0, -8]} if lamp == "behind" else {})
        warnings, _ = said(capfd, LENS, source, WITHOUT, **blind)
        assert len(warnings) == count, lamp


@pytest.mark.parametrize(
    "sensor, lamp, method, others",
    [
        (meter, LAMPS["point"], {}, {}),
        (lambda: batch(a=meter(-0.1), b=meter(0.1)), LAMPS["directional"], {}, {}),
        (meter, AREA_LAMP, WITHOUT, {}),
        (meter, {"type": "constant"}, WITHOUT, {}),
        (meter, LAMPS["point"], WITHOUT, {"blind": BLIND}),
        (meter, AREA_LAMP, WITHOUT, {"pane": GLASS}),
        (meter, LAMPS["point"] | {"position": [0, 0, -1]}, WITHOUT, {}),
        (meter, LAMPS["point"], WITHOUT | {"hide_emitters": True}, {}),
        (lambda: CAMERA, LAMPS["point"], WITHOUT, {}),
        (lambda: batch(a=CAMERA, b=parts.orthographic(size=4)), LAMPS["point"], {}, {}),
    ],
)
def test_nothing_is_said_where_nothing_is_missing(sensor, lamp, method, others, capfd):
    """Rationale: a warning about light that is not missing teaches to overlook them.

    Expected: none where (1,1) takes part, where s = 0 finds the lamp, where a surface or the back of the
    meter stops the light, where the lamp is hidden on purpose, and of pinhole sensors.
    """
    assert said(capfd, sensor(), lamp, method, **others)[0] == []
