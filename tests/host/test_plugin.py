"""The module by which Mitsuba 3.10 finds the plugin: `mitsuba_bdpt_plugin`, in processes of its own."""

import os
import subprocess
import sys

# What Mitsuba does for everybody who has the package, and then a scene without `bdpt` and one with it.
STEPS = """
import mitsuba as mi
import mitsuba_bdpt_plugin
mi.set_variant({variant!r})
mi.render(mi.load_dict(mi.cornell_box()), spp=1)
print("rendered")
try:
    print(type(mi.load_dict({{"type": "bdpt"}})).__name__)
except Exception as error:
    print(error)
"""


def answers(variant, **environment):
    """Lines that the steps print with these variables of the environment."""
    command = [sys.executable, "-c", STEPS.format(variant=variant)]
    done = subprocess.run(
        command, env=os.environ | environment, capture_output=True, text=True, timeout=300, check=False
    )
    assert done.returncode == 0, done.stderr
    return done.stdout.splitlines()


def test_mitsuba_is_not_hurt_where_there_is_no_llvm():
    """Rationale: Mitsuba imports the module in every process, whatever variant it runs. Expected: without a
    library of LLVM scalar renders are what they were; who loads the plugin is told why it cannot be.
    """
    rendered, *words = answers("scalar_rgb", DRJIT_LIBLLVM_PATH="/no/such.so")
    assert rendered == "rendered"
    words = " ".join(words)
    assert "bdpt: drjit was imported first and found no usable LLVM" in words
    assert "python -m mitsuba_bdpt doctor" in words


def test_the_plugin_is_there():
    """Expected: where LLVM is, the plugin is loaded without an import of its own."""
    path = os.environ["DRJIT_LIBLLVM_PATH"]  # which the package has chosen in this process
    assert answers("llvm_ad_rgb", DRJIT_LIBLLVM_PATH=path) == ["rendered", "BDPTIntegrator"]
