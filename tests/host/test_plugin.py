"""How Mitsuba finds the plugin: its registry and scene files."""

import mitsuba as mi
import numpy as np
import pytest
import variants
from mitsuba_bdpt.settings import PARAMETERS


def written(scene, transformed):
    """The XML text of a dictionary, with or without the transformations that `mi.load_dict` applies."""
    config = mi.parser.ParserConfig(variants.of("rgb"))
    state = mi.parser.parse_dict(config, scene)
    if transformed:
        mi.parser.transform_all(config, state)
    return mi.parser.write_string(state)


@pytest.mark.parametrize("transformed", [False, True], ids=["parsed", "transformed"])
def test_a_dictionary_is_written_as_a_scene_file(transformed):
    """The parser writes an element's name by the type that its plugin has in scalar_rgb. Tolerance: the
    writer splits `to_world` into scale, rotations and translation in single precision."""
    scene = mi.cornell_box()
    scene["sensor"]["film"] |= {"width": 8, "height": 8}
    scene["integrator"] = {"type": "bdpt", "max_depth": 3, "light_paths": "1/4"}
    text = written(scene, transformed)
    assert '<integrator type="bdpt"' in text
    images = [np.array(mi.render(made, spp=2)) for made in (mi.load_dict(scene), mi.load_string(text))]
    assert images[0].mean() > 0.05
    np.testing.assert_allclose(images[1], images[0], rtol=1e-3, atol=1e-4)


# Values other than the defaults; two sets, since some exclude others.
PARAMETER_SETS = (
    {
        "max_depth": 7,
        "rr_depth": 3,
        "hide_emitters": True,
        "heuristic": "power",
        "skip": "none",
        "light_paths": "1/2",
        "connections": "one",
        "points": "independent",
        "merging": True,
        "guiding": "never",
        "layers": "variance,denoised",
        "target_error": 0.01,
        "light_groups": "key: lamp",
        "path_layers": True,
        "aovs": "a:albedo,b:depth",
        "spp_per_pass": 16,
        "timeout": 12.5,
    },
    {"max_depth": 3, "layers": "strategies"},
)


@pytest.mark.parametrize("changed", PARAMETER_SETS, ids=["numbers and texts", "strategies"])
def test_parameters_are_written(changed):
    integrator = {"type": "bdpt", **changed}
    made, read = mi.load_dict(integrator), mi.load_string(written(integrator, False))
    assert read.settings == made.settings
    defaults = mi.load_dict({"type": "bdpt"}).settings
    assert [name for name in changed if getattr(made.settings, name) == getattr(defaults, name)] == []


def test_all_parameters_are_written():
    assert set(PARAMETERS) == {name for changed in PARAMETER_SETS for name in changed}


def test_none_is_the_default_of_texts():
    """As the manual says; ``--denoise`` adds to it."""
    given = {name: "none" for name, parameter in PARAMETERS.items() if parameter.default == ""}
    assert set(given) == {"aovs", "layers", "light_groups"}
    assert mi.load_dict({"type": "bdpt"} | given).settings == mi.load_dict({"type": "bdpt"}).settings
    with pytest.raises(RuntimeError, match="there is no layer 'none'"):
        mi.load_dict({"type": "bdpt", "layers": "variance,none"})


def test_scalar_variants_are_refused():
    mi.set_variant("scalar_rgb")
    mi.set_variant("llvm_ad_rgb")
    config = mi.parser.ParserConfig("scalar_rgb")
    with pytest.raises(RuntimeError, match="the variant scalar_rgb is not supported; use one of LLVM"):
        mi.parser.instantiate(config, mi.parser.parse_dict(config, {"type": "bdpt"}))
