"""The choice of the LLVM library: on made-up machines, where empty files stand for libraries, and in children
of this process."""

import os
import subprocess
import sys
from types import SimpleNamespace

import numpy as np
import pytest
from mitsuba_bdpt.host import llvm


@pytest.fixture
def library(tmp_path):
    """A function that makes an empty library file and returns its path."""

    def make(name):
        path = tmp_path / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.touch()
        return path

    return make


@pytest.fixture(autouse=True)
def no_cuda(monkeypatch):
    monkeypatch.setattr(llvm, "cuda_driver", lambda: False)


@pytest.mark.parametrize(
    ("listed", "prefix", "expected"),
    [
        (["libLLVM.so.23.1"], ["libLLVM.so.22.1"], "user/libLLVM.so.23.1"),  # pip install --user
        (None, ["libLLVM.so.22.1"], "env/lib/libLLVM.so.22.1"),  # installers omit the wheel's list of files
        ([], ["libLLVM-19.so", "libLLVM-21.so", "libLLVM.so.24.1"], "env/lib/libLLVM-19.so"),
        ([], ["libLLVM-15.so.1", "libLLVM-18.1.so"], "env/lib/libLLVM-18.1.so"),
        ([], ["libLLVMSupport.so.19", "libLLVM-19.a"], None),
    ],
    ids=["wheel", "prefix", "newest known", "newest", "no other libraries"],
)
def test_library_of_the_environment(library, tmp_path, monkeypatch, listed, prefix, expected):
    files = [library(f"user/{name}") for name in listed or ()]
    for name in prefix:
        library(f"env/lib/{name}")
    held = [SimpleNamespace(name=path.name, locate=lambda path=path: path) for path in files]
    wheel = SimpleNamespace(files=None if listed is None else held)
    monkeypatch.setattr("importlib.metadata.distributions", lambda name: [wheel])
    monkeypatch.setattr(sys, "prefix", str(tmp_path / "env"))
    assert llvm.in_environment() == (expected and tmp_path / expected)


@pytest.mark.parametrize(
    "files, starts",
    [(["axle.lck"], 1), (["axle.lck", "axle.done"], 0), ([], 0)],
    ids=["pending", "done", "none"],
)
def test_a_wheel_installed_by_this_process_is_finished(monkeypatch, files, starts):
    """As by a notebook: the wheel's links to libc++ are made when Python starts next."""
    wheel = SimpleNamespace(read_text=lambda name: "" if name in files else None)
    started = []
    monkeypatch.setattr("importlib.metadata.distributions", lambda name: [wheel])
    monkeypatch.setattr(subprocess, "run", lambda command, **_: started.append(command[0]))
    llvm.finish_installation()
    assert started == [sys.executable] * starts


@pytest.mark.parametrize(
    ("version", "why", "first", "words"),
    [
        ((14, 0, 6), "", False, "loaded LLVM 14.0.6.*Import mitsuba_bdpt before"),
        ((-1, -1, -1), "", False, "imported first and found no usable LLVM"),
        ((18, 1, 8), "", True, "loaded LLVM 18.1.8.*Versions known to work: 19.*pip install 'karellen"),
        ((-1, -1, -1), llvm.NAMED, True, "found no usable LLVM.*Mend it"),
        ((15, 0, 7), llvm.NAMED, True, None),  # the user may know that it works on this machine
        ((21, 1, 0), "", True, None),
        ((19, 1, 0), "", False, None),
    ],
)
def test_loaded_version_is_checked(monkeypatch, version, why, first, words):
    monkeypatch.setattr("platform.system", lambda: "Linux")
    monkeypatch.setattr("platform.machine", lambda: "x86_64")
    if words is None:
        assert llvm.checked(version, None, why, first) == llvm.Choice(None, why, version[0])
    else:
        with pytest.raises(llvm.LLVMNotFoundError, match=words):
            llvm.checked(version, None, why, first)


def test_a_machine_with_cuda_needs_no_llvm(monkeypatch):
    monkeypatch.setattr(llvm, "cuda_driver", lambda: True)
    assert "only variants of CUDA" in str(llvm.checked((-1, 0, 0), None, ""))
    with pytest.raises(llvm.LLVMNotFoundError, match="loaded LLVM 15"):
        llvm.checked((15, 0, 7), None, "")


def run(code, *arguments, **env):
    """Run `code` in a new Python process."""
    merged = {key: value for key, value in os.environ.items() if key != llvm.VARIABLE} | env
    return subprocess.run(
        [sys.executable, "-c", code, *arguments], capture_output=True, text=True, env=merged
    )


def test_import_settles_what_drjit_loads():
    done = run(
        "import mitsuba_bdpt, drjit\n"
        "assert mitsuba_bdpt.llvm_choice.path.is_file()\n"
        "assert drjit.detail.llvm_version()[0] == mitsuba_bdpt.llvm_choice.version"
    )
    assert done.returncode == 0, done.stderr


def test_import_with_a_bad_variable_fails_before_drjit_is_imported():
    code = "import sys\ntry:\n  import mitsuba_bdpt\nfinally:\n  print('drjit' in sys.modules)"
    done = run(code, **{llvm.VARIABLE: "/no/such.so"})
    assert done.returncode == 1 and done.stdout == "False\n"
    assert "LLVMNotFoundError: DRJIT_LIBLLVM_PATH='/no/such.so'" in done.stderr


FAKE_DRJIT = """
import sys, types
drjit, mitsuba = types.ModuleType("drjit"), types.ModuleType("mitsuba")
drjit.detail = types.SimpleNamespace(llvm_version=lambda: (15, 0, 7))
mitsuba.variant = lambda: VARIANT
sys.modules |= {"drjit": drjit, "mitsuba": mitsuba}
try:
    import mitsuba_bdpt
except Exception as error:
    print(type(error).__name__, error)
"""


@pytest.mark.parametrize(("variant", "stopped"), [(None, True), ("cuda_ad_rgb", False)])
def test_import_after_drjit_with_an_old_llvm(variant, stopped):
    done = run(FAKE_DRJIT.replace("VARIANT", repr(variant)))
    words = "LLVMNotFoundError drjit was imported first and loaded LLVM 15.0.7"
    assert done.stdout.startswith(words) == stopped and done.stdout, done.stderr


TWO_KERNELS = """
import sys
import mitsuba_bdpt
import contextlib, drjit as dr, mitsuba as mi
from mitsuba_bdpt.host.llvm import quick_compilation

def render(steps):
    x = dr.linspace(mi.Float, 0, 1, 64)
    for _ in range(steps):
        x = dr.sin(x) / (1 + x * x)
    print(*x.numpy())

mi.set_variant("llvm_ad_rgb")
ways = {"quick": quick_compilation(), "quick, kept": quick_compilation(once=False)}
with ways.get(sys.argv[1], contextlib.nullcontext()):
    render(10)
render(20)
"""


def test_quick_compilation(tmp_path):
    """Other code of the kernel within the block, the usual code after it; results equal but for rounding of
    some sixty operations. A kernel that is kept has again other code."""
    printed, kernels = [], []
    for way in ("usual", "again", "quick", "quick, kept"):
        cache = tmp_path / way
        cache.mkdir()
        done = run(TWO_KERNELS, way, DRJIT_CACHE_DIR=str(cache))
        assert done.returncode == 0 and not done.stderr, done.stderr
        printed.append(done.stdout)
        kernels.append({file.name: file.read_bytes() for file in cache.glob("*.bin")})
    assert kernels[0] == kernels[1], "files of kernels are not reproducible: this test shows nothing"
    usual, numbers = kernels[0], [np.array(text.split(), float) for text in printed]
    for one, other in ((0, 2), (0, 3), (2, 3)):
        np.testing.assert_allclose(numbers[one], numbers[other], rtol=60 * 2.0**-23)
        assert usual.keys() == kernels[one].keys() == kernels[other].keys()
        assert sum(kernels[one][name] != kernels[other][name] for name in usual) == 1


@pytest.mark.parametrize("named", ["", os.devnull, "an untested version"])
def test_quick_compilation_leaves_unknown_libraries_alone(monkeypatch, named):
    """Untested libraries may print each pass that they skip, or have no such option."""
    if named in ("", os.devnull):
        monkeypatch.setenv(llvm.VARIABLE, named)
    else:
        monkeypatch.setattr(llvm, "KNOWN_GOOD", (19,))
    assert not llvm._set_options()
