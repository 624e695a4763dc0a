"""The parameters are one record: reader, manual and documents are made from it."""

import mitsuba as mi
import pytest
from mitsuba_bdpt import settings
from mitsuba_bdpt.cli.arguments import main
from mitsuba_bdpt.settings import ALIASES, PARAMETERS, Settings


def test_a_plugin_without_parameters_has_the_defaults():
    """Expected: what the reader makes of no parameters is the record with its defaults."""
    assert mi.load_dict({"type": "bdpt"}).settings == Settings()


@pytest.mark.parametrize("name", PARAMETERS)
def test_defaults_can_be_given(name):
    """Expected: each default, given as the manual says it, reads as the default."""
    assert mi.load_dict({"type": "bdpt", name: PARAMETERS[name].default}).settings == Settings()


def test_the_manual_lists_all():
    """Expected: each parameter once in the plugin's manual, with its type and default, and in the table; the
    choices of strings are in their meaning."""
    manual, table = settings.manual(), settings.table()
    assert manual in mi.load_dict({"type": "bdpt"}).__doc__
    for name, parameter in PARAMETERS.items():
        assert manual.count(f" * - {name}\n") == table.count(f"| `{name}` |") == 1
        assert all(f"``{choice}``" in parameter.meaning for choice in parameter.choices)
    assert "| `max_depth` | `-1` | Longest path in edges, as in `path`:" in table


def test_old_names_are_known():
    """Rationale: scene files outlive names. Expected: an old name reads as the new one, both together are an
    error, and the command's option of the new name replaces the scene file's parameter of the old one."""
    old = {"type": "bdpt", "variance": True, "until_error": 0.25}
    assert mi.load_dict(old).settings.target_error == 0.25
    with pytest.raises(
        (ValueError, RuntimeError), match="target_error is given twice, .*_error is its old name"
    ):
        mi.load_dict(old | {"target_error": 0.25})
    assert all(name not in PARAMETERS and present in PARAMETERS for name, present in ALIASES.items())


def test_the_option_replaces_the_old_name_in_a_scene_file(tmp_path):
    """Expected: `--target-error`, and `--until-error`, over a scene file with ``until_error``, whose error no
    render of 32 samples would reach."""
    scene = tmp_path / "scene.xml"
    scene.write_text(
        """<scene version="3.0.0">
        <integrator type="bdpt"><float name="until_error" value="1e-9"/>
        <boolean name="variance" value="true"/>
        <integer name="max_depth" value="2"/></integrator>
        <sensor type="perspective"><film type="hdrfilm"><integer name="width" value="8"/>
        <integer name="height" value="8"/></film></sensor>
        <emitter type="constant"/></scene>"""
    )
    for option in ("--target-error", "--until-error"):
        output = tmp_path / "image.exr"
        assert main(["render", str(scene), option, "1", "-o", str(output)]) == 0
        statistics = mi.Bitmap(str(output)).metadata()["bdptStatistics"]
        assert '"spp": 32' in statistics
