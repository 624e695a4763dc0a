"""The parameters are one record: reader, manual and documents are made from it."""

import re

import mitsuba as mi
import pytest
from mitsuba_bdpt import settings
from mitsuba_bdpt.cli.arguments import main
from mitsuba_bdpt.removed import REMOVED
from mitsuba_bdpt.settings import PARAMETERS, Settings


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
    assert "| `max_depth` | `-1` | Longest path in edges, as in `path` (with media as in" in table


@pytest.mark.parametrize("entry", REMOVED)
def test_what_was_removed_is_an_error_with_the_remedy(entry, capsys):
    """Rationale: scene files and scripts outlive parameters. Expected: each entry of the table, as a
    parameter, its value, an option or a command, is an error that names it and says what to use instead."""
    parameter = not entry.startswith("--") and entry != "completion"
    if parameter:
        name, _, value = entry.partition("=")
        with pytest.raises((ValueError, RuntimeError)) as error:
            mi.load_dict({"type": "bdpt", name: value or 1.0})
        said = str(error.value)
        assert name in said and (not value or repr(value) in said)
    else:
        command = [] if entry == "completion" else ["render", "scene.xml"]
        with pytest.raises(SystemExit) as ended:
            main([*command, *entry.split()])
        said = capsys.readouterr().err
        assert ended.value.code == 2 and all(word in said for word in entry.split())
    assert f"was removed; {REMOVED[entry]}" in said


def test_what_was_removed_is_gone():
    """Expected: no entry of the table of removed names is a parameter or a choice of one; where an entry says
    to use a parameter, there is one."""
    for entry, remedy in REMOVED.items():
        name, _, value = entry.partition("=")
        assert value not in PARAMETERS[name].choices if value else name not in PARAMETERS
        if (word := re.match(r"use (\w+)$", remedy)) is not None:
            assert word[1] in PARAMETERS
