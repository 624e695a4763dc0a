"""The tutorial runs as a notebook, and what it asserts holds."""

import sys
import textwrap
import time

import make_notebook
import nbformat
from jupyter_client.manager import start_new_kernel
from patience import PATIENCE


def printed(cell):
    return "".join(output.get("text", "") for output in cell.get("outputs", []))


def shown(notebook):
    """How many images a notebook shows."""
    outputs = [output for cell in notebook.cells for output in cell.get("outputs", [])]
    return sum("image/png" in output.get("data", {}) for output in outputs)


def test_the_notebook_runs(monkeypatch):
    """Expected: every cell runs at a small size and its assertions hold; it prints what it explains, and
    shows images and a plot.
    """
    monkeypatch.setenv("TUTORIAL_SIZE", "16")
    made = make_notebook.run(make_notebook.notebook(), timeout=PATIENCE)
    text = "".join(map(printed, made.cells))
    for words in ("pilot: time to the same error", "estimated relMSE", "error of path over ours"):
        assert words in text
    assert shown(made) == 3


def test_the_notebook_is_that_of_the_script():
    """Expected: the same cells, and outputs of a whole run: images, and no error."""
    assert make_notebook.main(["--check"]) == 0
    there = nbformat.read(make_notebook.NOTEBOOK, 4)
    outputs = [output for cell in there.cells for output in cell.get("outputs", [])]
    assert not [output for output in outputs if output.output_type == "error"]
    assert shown(there) == 3


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
    """Rationale: a notebook's stop button interrupts its kernel. Expected: the passes that were over are in
    the film and in the statistics.
    """
    manager, client = start_new_kernel(kernel_name="python3")
    try:
        client.execute(textwrap.dedent(STOPPED))
        text, asked, deadline = "", False, time.monotonic() + PATIENCE
        while "kept" not in text and time.monotonic() < deadline:
            message = client.get_iopub_msg(timeout=PATIENCE)
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
