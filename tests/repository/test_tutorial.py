"""The tutorial runs as a notebook, and what it asserts holds."""

import importlib.util
import re
import subprocess
import sys
import textwrap
import tomllib
from pathlib import Path

import jupytext
import nbformat
import pytest
from jupyter_client.manager import start_new_kernel
from nbclient import NotebookClient

SCRIPT = Path(__file__).resolve().parents[2] / "docs" / "user" / "tutorial.py"
IMAGES = 5


def check_outputs(notebook):
    """Images, text and a bar; no errors, no warnings, no paths of the machine."""
    outputs = [output for cell in notebook.cells for output in cell.get("outputs", [])]
    data = [output.get("data", {}) for output in outputs]
    assert {output.get("name", output.output_type) for output in outputs} == {"stdout", "display_data"}
    assert sum("image/png" in kinds for kinds in data) == IMAGES
    shown = zip(outputs, data, strict=True)
    text = "\n".join(output.get("text", "") + kinds.get("text/plain", "") for output, kinds in shown)
    assert "256/256 spp, " in text
    assert not re.search(r"warn|(?<![\w.])/\w+/|\\\\Users", text, re.IGNORECASE)


def test_the_notebook_runs(tmp_path):
    """In an empty folder, at a small size, in a Jupyter without extensions."""
    notebook = jupytext.read(SCRIPT)
    (first,) = [cell for cell in notebook.cells if "SIZE = 128 " in cell.source]
    first.source = first.source.replace("SIZE = 128 ", "SIZE = 16 ")
    hidden = "import sys; sys.modules['ipywidgets'] = None"
    notebook.cells.insert(0, nbformat.v4.new_code_cell(hidden))
    resources = {"metadata": {"path": str(tmp_path)}}
    NotebookClient(notebook, startup_timeout=1000, kernel_name="python3", resources=resources).execute()
    check_outputs(notebook)
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("installed", [False, True])
@pytest.mark.parametrize("wheels", [["mitsuba_bdpt-1.0.0-py3-none-any.whl", "other-1-py3-none-any.whl"], []])
def test_the_first_cell_installs_the_package(tmp_path, monkeypatch, wheels, installed):
    """Expected: pip installs the wheel beside the notebook, without one the repository of pyproject.toml."""
    called = []
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(subprocess, "run", lambda command, check: called.append(command[-2:]))
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: name if installed else None)
    for name in wheels:
        (tmp_path / name).touch()
    cell = next(cell for cell in jupytext.read(SCRIPT).cells if cell.cell_type == "code")
    exec(cell.source, {})
    project = tomllib.loads((SCRIPT.parents[2] / "pyproject.toml").read_text())["project"]
    source = wheels[0] if wheels else "git+" + project["urls"]["Homepage"]
    assert called == ([] if installed else [[source, "matplotlib"]])


def test_the_notebook_is_that_of_the_script():
    """Else `make notebook`."""
    there = nbformat.read(SCRIPT.with_suffix(".ipynb"), 4)
    own, expected = ([(c.cell_type, c.source) for c in b.cells] for b in (there, jupytext.read(SCRIPT)))
    assert own == expected
    check_outputs(there)


STOPPED = """
    import mitsuba_bdpt
    import mitsuba as mi
    mi.set_variant("llvm_ad_rgb")
    scene = mi.load_dict(mi.cornell_box())
    integrator = mi.load_dict({"type": "bdpt", "max_depth": 4, "spp_per_pass": 1})
    integrator.on_pass = lambda report: print("pass", report.spp_done, flush=True)
    try:
        integrator.render(scene, spp=1 << 16)
    except KeyboardInterrupt:
        image = scene.sensors()[0].film().develop()
        print("kept", sum(integrator.statistics["passes"]), float(mi.TensorXf(image).array[0]) >= 0)
"""


def test_the_stop_button_keeps_what_is_done():
    """Expected: the passes that were over are in the film and in the statistics."""
    manager, client = start_new_kernel(startup_timeout=1000, kernel_name="python3")
    try:
        client.execute(textwrap.dedent(STOPPED))
        text, asked = "", False
        while "kept" not in text:
            message = client.get_iopub_msg()
            text += message["content"].get("text", "")
            assert message["msg_type"] != "error", message["content"]
            if "pass 3" in text and not asked:
                manager.interrupt_kernel()
                asked = True
    finally:
        client.stop_channels()
        manager.shutdown_kernel(now=True)
    done = int(text.rsplit("kept ", 1)[1].split()[0])
    assert 3 <= done < 1 << 16 and text.rstrip().endswith("True"), sys.version
