"""What a user reads last where `mi.render` has wrapped a mistake: the plugin's own message."""

import subprocess
import sys

import mitsuba as mi
import pytest
from mitsuba_bdpt.host import tracebacks

MISTAKES = {
    "moment": ({"type": "moment", "nested": {"type": "bdpt"}}, "cannot be nested in another integrator"),
    "aov": (
        {"type": "aov", "aovs": "d:depth", "nested": {"type": "bdpt"}},
        "cannot be nested in another integrator",
    ),
    "variance": ({"type": "bdpt", "layers": "variance"}, "layers=variance with spp=4 is not possible"),
}

# A cell of a notebook, run by IPython without one, and one whose error has nothing to do with the plugin.
IN_IPYTHON = """
import sys
hook = sys.excepthook
import mitsuba_bdpt
assert sys.excepthook is hook, "importing the package has changed it"
import IPython
shell = IPython.core.interactiveshell.InteractiveShell.instance()
shell.run_cell('''
import mitsuba_bdpt, mitsuba as mi
mi.set_variant("llvm_ad_rgb")
integrator = mi.load_dict({"type": "bdpt", "layers": "variance"})
mi.render(mi.load_dict(mi.cornell_box()), integrator=integrator, spp=4)
''')
shell.run_cell("raise RuntimeError('of the user')")
"""


def scene(integrator):
    """A sky of 2 x 2 pixels."""
    film = {"type": "hdrfilm", "width": 2, "height": 2}
    parts = {"sensor": {"type": "perspective", "film": film}, "sky": {"type": "constant"}}
    return mi.load_dict({"type": "scene", "integrator": integrator, **parts})


@pytest.mark.parametrize("mistake", MISTAKES)
def test_the_last_line_is_the_plugins(mistake, capsys):
    """Rationale: Dr.Jit ends the traceback of whatever `mi.render` raises with "see above". Expected: the
    last line of an uncaught one is the plugin's message, in one line.
    """
    integrator, message = MISTAKES[mistake]
    with pytest.raises(RuntimeError) as caught:
        mi.render(scene(integrator), spp=4)
    sys.excepthook(type(caught.value), caught.value, caught.value.__traceback__)
    lines = capsys.readouterr().err.splitlines()
    assert "see above" in lines[-2]
    assert lines[-1].startswith(f"bdpt: {message}")


def test_other_tracebacks_are_as_they_were(capsys):
    """Expected: nothing is added to errors without a mistake behind them, nor to a mistake itself."""
    for error in (ValueError("bdpt"), RuntimeError("one's own")):
        sys.excepthook(type(error), error, None)
        assert capsys.readouterr().err.splitlines()[-1] == f"{type(error).__name__}: {error}"
    with pytest.raises(ValueError, match="layers=variance") as caught:
        mi.load_dict({"type": "bdpt", "layers": "variance"}).render(scene({"type": "path"}), spp=4)
    assert tracebacks.last_line(caught.value) == ""


def test_the_last_line_in_a_notebook():
    """Rationale: IPython does not use `sys.excepthook`. Expected: the message below its traceback, and other
    errors as ever; before the first integrator the hook of scripts is Python's.
    """
    done = subprocess.run([sys.executable, "-c", IN_IPYTHON], capture_output=True, text=True)
    assert done.stderr.strip().startswith("bdpt: layers=variance with spp=4 is not possible"), done.stderr
    assert "see above" in done.stdout
    assert done.stdout.strip().endswith(": of the user")
