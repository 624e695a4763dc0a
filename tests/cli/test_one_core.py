"""The command on one processor, where Dr.Jit alone has one thread."""

import os
import subprocess
import sys

import pytest

SCENE = """<scene version="3.0.0">
    <sensor type="perspective"><film type="hdrfilm">
        <integer name="width" value="4"/><integer name="height" value="4"/>
    </film></sensor>
    <emitter type="envmap" id="sky"><string name="filename" value="sky.exr"/></emitter>
</scene>"""

PINNED = """import os, sys
os.sched_setaffinity(0, {min(os.sched_getaffinity(0))})
import mitsuba_bdpt
import drjit as dr, mitsuba as mi, numpy as np
from mitsuba_bdpt.cli.arguments import main
from mitsuba_bdpt.host.jit import two_threads
if sys.argv[1] == "own":
    dr.set_thread_count(1)
    first, second = two_threads(), two_threads()
    first.__enter__(), second.__enter__(), first.__exit__(None, None, None)
    assert dr.thread_count() == 2
    second.__exit__(None, None, None)
else:
    mi.set_variant("llvm_ad_rgb")
    mi.Bitmap(np.ones((4, 8, 3), np.float32)).write("sky.exr")
    mi.Bitmap("sky.exr")
status = main(["render", "scene.xml", "--spp", "1", "-P", "light_groups=sky: sky", "-o", "a.exr"])
status = status or main(["mix", "a.exr", "sky=2", "-o", "b.exr"])
print(dr.thread_count(), status)
"""


@pytest.mark.skipif(not hasattr(os, "sched_setaffinity"), reason="processes cannot be pinned here")
def test_images_are_read_and_written_on_one_processor(tmp_path):
    (tmp_path / "scene.xml").write_text(SCENE)
    for threads, count in (("default", 2), ("own", 1)):
        command = [sys.executable, "-c", PINNED, threads]
        done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, timeout=600)
        assert done.stdout.splitlines()[-1] == f"{count} 0", done.stderr
        assert (tmp_path / "b.exr").exists()
        (tmp_path / "b.exr").unlink()
