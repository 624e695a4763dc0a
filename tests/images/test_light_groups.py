"""Light groups: layers of the image by emitter."""

import mitsuba as mi
import numpy as np
import pytest
from internals import bdpt
from layered import JOINED, LAMPS, check_sum, layers, scene
from mitsuba_bdpt import mix
from mitsuba_bdpt.emitters.light_groups import LightGroups
from mitsuba_bdpt.emitters.tables import in_order
from sds_scenes import point, under_glass
from snapshots import ROUNDING, stopped
from warned import Warned

GROUPS = "low: globe, b*; high: panel"
OF_GROUPS = {"low": ("globe", "bulb"), "high": ("panel",), "rest": ("sky",)}


def integrator(**parameters):
    return bdpt(**{"max_depth": 4, "light_groups": GROUPS} | parameters)


@pytest.mark.parametrize(
    "parameters",
    [{"connections": "one"}, {"connections": "all"}, {"light_paths": 0}],
    ids=["one", "all", "path tracing"],
)
def test_a_layer_is_the_image_of_its_emitters_alone(parameters):
    """Emitters are selected by their sampling weight, so that a render in which the others are black traces
    the same paths with the same weights. Tolerance: order of atomic additions."""
    window = {"crop_offset_x": 1, "crop_offset_y": 2, "crop_width": 6, "crop_height": 5}
    method = integrator(skip="none", merging=False, **parameters)
    image, groups = layers(method, scene(**window))
    assert image.shape == (5, 6, 3) and list(groups) == list(OF_GROUPS)
    check_sum(image, groups)
    alone = bdpt(max_depth=4, skip="none", merging=False, **parameters)
    for name, lit in OF_GROUPS.items():
        expected, _ = layers(alone, scene(lit, **window))
        np.testing.assert_allclose(groups[name], expected, rtol=1e-4, atol=2e-5 * image.max())


def test_connections_to_several_light_subpaths_know_their_emitter():
    """The panel alone is red: no red light in the layers of the others but the sky's, which is grey."""
    method = integrator(decisions=JOINED)
    image, groups = layers(method, scene(rfilter="box"), spp=64)
    assert method.statistics["decisions"][-1]["joined"] == 4
    check_sum(image, groups)
    assert groups["low"][..., 0].max() == 0 < groups["high"][..., 0].max()
    assert np.ptp(groups["rest"], axis=-1).max() < 1e-5 * image.max()


@pytest.mark.parametrize("plate", ["dielectric", "roughdielectric"])
def test_a_merge_knows_its_emitter(plate):
    """Merges alone sample a point light seen through a plate, smooth or nearly so: each light's layer has its
    colour alone, and the path layer is ``caustic``. The rough plate also shows the lamps themselves
    (``emission``), and its lobes have tails: less than a tenth is elsewhere."""
    glass = {"type": plate, "int_ior": 1.5, "ext_ior": 1.0}
    glass |= {"alpha": 0.005} if plate == "roughdielectric" else {}
    red, blue = (
        point() | {"intensity": {"type": "rgb", "value": value}, "position": [x, 0, 4.5]}
        for value, x in (([9.0, 0, 0], 0.5), ([0, 0, 9.0], -0.5))
    )
    target = mi.load_dict(under_glass(red, plate=glass, other=blue))
    method = bdpt(max_depth=6, merging=True, light_groups="auto", path_layers=True)
    image, groups = layers(method, target, spp=16)
    check_sum(image, groups)
    assert groups["light"][..., 2].max() == 0 < groups["light"][..., 0].max()
    assert groups["other"][..., 0].max() == 0 < groups["other"][..., 2].max()
    image, found = layers(method, target, spp=16, kind="path")
    np.testing.assert_allclose(sum(found.values()), image, rtol=1e-4, atol=2e-5 * image.max())
    share = {name: layer.mean() / image.mean() for name, layer in found.items()}
    if plate == "dielectric":
        assert share["caustic"] == pytest.approx(1, abs=1e-5)
    else:
        assert share["caustic"] > 0.6 and share["caustic"] + share["emission"] > 0.9


def test_mixed_light_is_that_of_other_lamps():
    method, target = bdpt(max_depth=4, skip="none", light_groups="auto"), scene()
    method.render(target, spp=8, seed=3)
    weights = {"panel": 1.5, "globe": (0.2, 0.2, 0.3), "sky": 0}
    mixed = np.array(mix(target.sensors()[0].film().bitmap(), weights))
    lamps = {name: tuple(np.array(LAMPS[name]) * weights.get(name, 1)) for name in LAMPS}
    expected, _ = layers(bdpt(max_depth=4, skip="none"), scene(lamps))
    np.testing.assert_allclose(mixed, expected, rtol=1e-4, atol=2e-5 * expected.max())


def test_each_emitter_has_its_own_group():
    target = scene()
    made = LightGroups.of(target, "auto")
    assert sorted(made.names) == sorted(LAMPS)
    for emitter, group in zip(in_order(target), made.of_emitters, strict=True):
        shape = emitter.get_shape()
        assert made.names[group] == (emitter if shape is None else shape).id()
    lamps = {f"lamp{i}": {"type": "point", "position": [i, 0, 0]} for i in range(12)}
    made = LightGroups.of(mi.load_dict({"type": "scene"} | lamps), "auto")
    assert made.names == (*(f"lamp{i}" for i in range(8)), "rest")
    assert sorted(made.of_emitters) == [0, 1, 2, 3, 4, 5, 6, 7, 8, 8, 8, 8]


def test_emitters_without_id_go_by_their_plugin():
    shape = '<shape type="sphere"><emitter type="area"/></shape>'
    target = mi.load_string(f'<scene version="3.0.0">{shape}{shape}<emitter type="constant"/></scene>')
    made = LightGroups.of(target, "auto")
    assert made.names == ("area", "area_2", "constant")
    assert made.explained()[0] == "light group area: area at (0, 0, 0)"
    assert LightGroups.of(target, "sky: constant").names == ("sky", "rest")
    same = LightGroups.of(target, "area: area; area_2: area_2; constant: constant")
    assert (same.names, same.of_emitters) == (made.names, made.of_emitters)
    assert LightGroups.of(target, "lamps: area*").of_emitters.count(0) == 2


def _points(*ids):
    """A scene of point lights with these ids."""
    lamps = "".join(f'<emitter type="point" id="{i}"/>' for i in ids)
    return mi.load_string(f'<scene version="3.0.0">{lamps}</scene>')


def _ids_of(target, made, group):
    """The ids of the emitters in a group."""
    of_emitters = zip(target.emitters(), made.of_emitters, strict=True)
    return {e.id() for e, number in of_emitters if made.names[number] == group}


def test_an_id_wins_over_a_made_name():
    """Ids may differ only in a character that becomes _. In ``auto`` an id that is a layer's name is the name
    of its emitter."""
    target = _points("Screen.A", "Screen_A", "Screen_A_2", "Screen A", "rest", "rest_2")
    for own in ("Screen.A", "Screen_A", "Screen_A_2", "Screen A"):
        assert _ids_of(target, LightGroups.of(target, f"x: {own}"), "x") == {own}
    made = LightGroups.of(target, "byid: Screen_A; dot: Screen.A")
    assert _ids_of(target, made, "byid") == {"Screen_A"} and _ids_of(target, made, "dot") == {"Screen.A"}
    made = LightGroups.of(target, "auto")
    for own in ("Screen_A", "Screen_A_2", "rest_2"):
        assert _ids_of(target, made, own) == {own}
    assert _ids_of(target, made, "Screen_A_3") | _ids_of(target, made, "Screen_A_4") == {
        "Screen.A",
        "Screen A",
    }
    assert _ids_of(target, made, "rest_3") == {"rest"}


@pytest.mark.parametrize(
    "parameters",
    [{}, {"light_paths": 0}, {"merging": True}, {"connections": "all", "skip": "none", "path_layers": True}],
    ids=["pilot", "path tracing", "merging", "all"],
)
def test_a_pattern_may_match_no_emitter(parameters):
    """One command renders all shots: the group is black, with a warning, and the other layers are those
    without it."""
    target, text = scene(rfilter="box"), "torch: torch*; low: globe, b*"
    method = bdpt(max_depth=4, light_groups=text, spp_per_pass=4, **parameters)
    with Warned() as warnings:
        image, groups = layers(method, target)
    assert list(groups) == ["torch", "low", "rest"] and not groups["torch"].any()
    check_sum(image, groups)
    warnings = [text for text in warnings if "torch" in text]
    assert len(warnings) == 1 and "has an id like 'torch*'" in warnings[0]
    assert "the layer of the group torch is black" in warnings[0] and "Emitters: bulb" in warnings[0]
    _, expected = layers(
        bdpt(max_depth=4, light_groups="low: globe, b*", spp_per_pass=4, **parameters), target
    )
    for name, layer in expected.items():
        np.testing.assert_allclose(groups[name], layer, rtol=1e-4, atol=2e-5 * image.max())
    start = stopped(method, target, 1, spp=8, seed=3)
    resumed = np.array(method.render(target, spp=8, seed=3, start=start), dtype=np.float64)
    np.testing.assert_allclose(resumed[..., :3], image, **ROUNDING)


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("panel", "'panel' has no group; write it like .*; for , and ; in an id write"),
        ("a b: panel", "'a b' cannot be a layer's name; use letters"),
        ("a:", "the group a has no emitters; write it like"),
        ("a: panel; a: globe", "there are two groups a; list"),
        ("rest: panel", "rest is the group of all other emitters; give"),
        (";".join(f"g{i}: panel" for i in range(17)), "there are 17 groups, 16 at most; join"),
        ("a: el", "has the id 'el'; did you mean panel"),
        ("a: pannel", "no emitter, and no shape with one, has the id 'pannel'; did you mean panel.*globe"),
        ("a: floor", "has the id 'floor'"),
        ("a: panel; b: p*", "the emitter 'panel' is in the groups a and b; take it out of one"),
    ],
)
def test_what_is_no_light_group(text, words):
    with pytest.raises(ValueError, match=f"bdpt: light_groups=.*{words}"):
        LightGroups.of(scene(), text)


def test_light_groups_of_a_dark_scene():
    with pytest.raises(ValueError, match="light_groups='auto': the scene has no emitters; leave"):
        LightGroups.of(mi.load_dict({"type": "scene", "s": {"type": "sphere"}}), "auto")
    with pytest.raises(RuntimeError, match="light_groups=3 must be a string"):
        bdpt(light_groups=3)
