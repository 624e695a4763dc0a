"""The parameters are one record: reader, manual and documents are made from it."""

import mitsuba as mi
import pytest
from mitsuba_bdpt import settings
from mitsuba_bdpt.cli.arguments import main
from mitsuba_bdpt.settings import LAYERS, PARAMETERS, REPLACED, Settings


def test_a_plugin_without_parameters_has_the_defaults():
    assert mi.load_dict({"type": "bdpt"}).settings == Settings()


@pytest.mark.parametrize("name", PARAMETERS)
def test_defaults_can_be_given(name):
    assert mi.load_dict({"type": "bdpt", name: PARAMETERS[name].default}).settings == Settings()


def test_the_manual_lists_all():
    """The choices of strings are in their meaning."""
    manual, table = settings.manual(), settings.table()
    assert manual in mi.load_dict({"type": "bdpt"}).__doc__
    for name, parameter in PARAMETERS.items():
        assert manual.count(f" * - {name}\n") == table.count(f"| `{name}` |") == 1
        if name not in ("light_paths", "merging"):  # their values are no strings alone
            assert all(f"``{choice}``" in parameter.meaning for choice in parameter.choices)
    assert all(f"``{layer}``" in PARAMETERS["layers"].meaning for layer in LAYERS)


@pytest.mark.parametrize(
    ("given", "layers"),
    [
        ("", ()),
        ("variance", ("variance",)),
        ("strategies, variance", ("variance", "strategies")),
        ("denoised,denoised", ("denoised",)),
    ],
)
def test_layers_are_a_list(given, layers):
    method = mi.load_dict({"type": "bdpt", "max_depth": 3, "layers": given})
    assert method.settings.layers == layers
    assert f"layers = {','.join(layers)},\n" in str(method)


@pytest.mark.parametrize(
    ("given", "words"),
    [
        ("denoise", "layers='denoise': there is no layer 'denoise'; did you mean denoised?"),
        ("variance;stokes", "there is no layer 'variance;stokes'"),
        ("variance,", "there is no layer ''.*variance, denoised, stokes, strategies"),
        (True, "layers=True must be a text with commas between, such as 'variance,denoised'"),
        (False, "layers=False must be a text"),
    ],
)
def test_bad_layers_are_refused(given, words):
    with pytest.raises((ValueError, TypeError, RuntimeError), match=words):
        mi.load_dict({"type": "bdpt", "layers": given})


def test_a_target_error_estimates_the_variance():
    assert "variance.R" in mi.load_dict({"type": "bdpt", "target_error": 0.1}).aov_names()
    assert mi.load_dict({"type": "bdpt"}).aov_names() == []


@pytest.mark.parametrize("name", REPLACED)
def test_what_was_replaced_is_an_error_with_the_remedy(name, capsys):
    if name.startswith("--"):
        with pytest.raises(SystemExit) as ended:
            main(["render", "scene.xml", name])
        assert ended.value.code == 2 and REPLACED[name] in capsys.readouterr().err
        return
    with pytest.raises((ValueError, RuntimeError), match=f"{name}=1.0 is not a parameter") as error:
        mi.load_dict({"type": "bdpt", name: 1.0})
    assert REPLACED[name] in str(error.value)
