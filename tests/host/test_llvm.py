"""Tests of the choice of the LLVM library (``mitsuba_bdpt.host.llvm``).

Every branch is tried on made-up machines: empty files stand for libraries, for only their names
count. Tests of the real thing, what ``import mitsuba_bdpt`` does to a process, run in children.
"""

import os
import subprocess
import sys
from pathlib import Path
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


def test_variable_wins_over_everything_and_is_not_judged(library, monkeypatch):
    """A user may know that LLVM 15 works on this machine."""
    path = library("libLLVM-15.so.1")
    monkeypatch.setenv(llvm.VARIABLE, str(path))
    monkeypatch.delitem(sys.modules, "drjit", raising=False)
    assert llvm.prepare() == llvm.Choice(path, llvm.NAMED, 15)


def test_the_newest_known_library_of_the_environment_wins_over_the_system(library):
    """Expected: libraries of untested and old versions are passed over."""
    environment = [library(f"env/{name}") for name in ("libLLVM-19.so", "libLLVM.so.22.1", "libLLVM.so.24.1")]
    system = [library(f"usr/{name}") for name in ("libLLVM-15.so.1", "libLLVM.so.23.1", "libLLVM-19.so")]
    for own, path, version in ((environment, environment[1], 22), (environment[2:], system[1], 23)):
        choice = llvm.choose(own, system)
        assert (choice.path, choice.version) == (path, version)


def test_old_and_unknown_libraries_are_named_and_not_taken(library):
    """Expected: the error lists what was found, and how to try it."""
    paths = [library(name) for name in ("libLLVM-14.so.1", "libLLVM-18.so", "libLLVM-21.so", "libLLVM.so")]
    with pytest.raises(llvm.LLVMNotFoundError) as caught:
        llvm.choose(paths[:2], paths[2:])
    for path, version in zip(paths, (14, 18, 21, "of unknown version"), strict=True):
        assert f"{path} (LLVM {version})" in str(caught.value)
    assert f"set {llvm.VARIABLE}" in str(caught.value)


@pytest.mark.parametrize(
    ("system", "architecture", "command"),
    [
        ("Linux", "x86_64", "pip install 'karellen-llvm-core"),
        ("Linux", "aarch64", "apt install libllvm19"),
        ("Darwin", "arm64", "brew install llvm@19"),
        ("Windows", "AMD64", "set DRJIT_LIBLLVM_PATH"),
    ],
)
def test_error_names_the_command_for_the_platform(monkeypatch, system, architecture, command):
    monkeypatch.setattr("platform.system", lambda: system)
    monkeypatch.setattr("platform.machine", lambda: architecture)
    with pytest.raises(llvm.LLVMNotFoundError) as caught:
        llvm.choose([], [])
    assert "none was found" in str(caught.value) and command in str(caught.value)


@pytest.mark.parametrize(
    ("name", "version"),
    [
        ("libLLVM.so.23.1", 23),
        ("libLLVM-15.so.1", 15),
        ("libLLVM-14.0.6.so.1", 14),
        ("llvm-19/lib/libLLVM.so.1", 19),
        ("opt/llvm@19/lib/libLLVM.dylib", 19),
        ("Cellar/llvm/22.1.0/lib/libLLVM.dylib", 22),
        ("lib/libLLVM.so", None),
    ],
)
def test_major_version(library, name, version):
    assert llvm.major_version(library(name)) == version


def test_major_version_of_a_link_is_that_of_its_target(library, tmp_path):
    library("real/libLLVM.so.23.1")
    link = tmp_path / "libLLVM.so"
    link.symlink_to("real/libLLVM.so.23.1")
    assert llvm.major_version(link) == 23


def test_search_finds_libraries_once_and_nothing_else(library, tmp_path, monkeypatch):
    """Expected: those of the wheel, also beside another prefix (``pip install --user``), of the prefix (where
    installers omit the wheel's list of files), and of the system; no links to them, no other libraries."""
    real = library("usr/lib/llvm-19/lib/libLLVM-19.so.1")
    (tmp_path / "usr/lib/libLLVM-19.so").symlink_to(real)
    for name in ("libLLVMSupport.so.19", "libLLVM-19.a"):
        library(f"usr/lib/{name}")
    own, listed = library("env/lib/libLLVM.so.22.1"), library("user/lib/libLLVM.so.23.1")

    class Listed:
        name = listed.name

        def locate(self):
            return listed

    monkeypatch.setattr(sys, "prefix", str(tmp_path / "env"))
    for files, expected in (([Listed()], [listed, own]), (None, [own])):
        wheels = [SimpleNamespace(files=files)]
        monkeypatch.setattr("importlib.metadata.distributions", lambda name, wheels=wheels: wheels)
        assert llvm.libraries(tmp_path) == (expected, [real])


@pytest.mark.parametrize(
    "files, starts",
    [(["axle.lck"], 1), (["axle.lck", "axle.done"], 0), ([], 0)],
    ids=["pending", "done", "none"],
)
def test_a_wheel_installed_by_this_process_is_finished(monkeypatch, files, starts):
    """Rationale: a notebook installs the wheel, whose links to libc++ are made when Python starts next;
    Dr.Jit could not load libLLVM. Expected: a Python is started where these links are pending, only there.
    """

    class Distribution:
        def read_text(self, name):
            return "" if name in files else None

    started = []
    monkeypatch.setattr("importlib.metadata.distributions", lambda name: [Distribution()])
    monkeypatch.setattr(subprocess, "run", lambda command, **_: started.append(command[0]))
    llvm.finish_installation()
    assert started == [sys.executable] * starts


def test_an_imported_drjit_is_checked():
    """Expected: old versions and none are errors with the remedy, newer versions are accepted."""
    for version, words in (
        ((14, 0, 6), "loaded LLVM 14.0.6.*Import mitsuba_bdpt before"),
        ((18, 1, 8), f"loaded LLVM 18.1.8.*set {llvm.VARIABLE} to the path"),
        ((-1, -1, -1), "found no usable LLVM"),
    ):
        with pytest.raises(llvm.LLVMNotFoundError, match=words):
            llvm.check_loaded(version)
    for major in (19, 21, 23):
        choice = llvm.check_loaded((major, 1, 0))
        assert (choice.path, choice.version) == (None, major)


def run(code, *arguments, **env):
    """Run `code` in a new Python process."""
    merged = {key: value for key, value in os.environ.items() if key != llvm.VARIABLE} | env
    return subprocess.run(
        [sys.executable, "-c", code, *arguments], capture_output=True, text=True, env=merged
    )


FAKE_DRJIT = """
import sys, types
drjit = types.ModuleType("drjit")
drjit.detail = types.SimpleNamespace(llvm_version=lambda: (15, 0, 7))
sys.modules["drjit"] = drjit
"""


def test_import_settles_what_drjit_loads():
    """Dr.Jit reports the very version that was chosen."""
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


def test_import_after_drjit_with_an_old_llvm_fails():
    done = run(FAKE_DRJIT + "import mitsuba_bdpt")
    assert done.returncode == 1
    assert "LLVMNotFoundError: drjit was imported first and loaded LLVM 15.0.7" in done.stderr


def test_a_machine_with_cuda_needs_no_llvm(library, monkeypatch):
    """Expected: with a driver of CUDA the choice is none, whatever unusable there is, also in a process that
    inherits the choice of its parent, and where Dr.Jit came first; a usable library is chosen nevertheless.
    """
    with pytest.raises(llvm.LLVMNotFoundError, match="names no file"):
        llvm.named(os.devnull)
    monkeypatch.setattr(llvm, "cuda_driver", lambda: True)
    old, new = library("libLLVM-15.so.1"), library("libLLVM.so.22.1")
    choice = llvm.choose([], [old])
    assert choice.path is choice.version is None
    assert "only variants of CUDA" in str(choice) and "LLVM 15" in str(choice)
    assert llvm.named(os.devnull).path is llvm.check_loaded((-1, 0, 0)).path is None
    with pytest.raises(llvm.LLVMNotFoundError, match="loaded LLVM 15"):
        llvm.check_loaded((15, 0, 7))
    assert llvm.choose([], [old, new]).path == new


@pytest.mark.parametrize("found, named", [((), None), (("libLLVM-15.so.1",), os.devnull)])
def test_unusable_libraries_are_kept_from_drjit(library, monkeypatch, found, named):
    """Rationale: Dr.Jit looks for a library by itself, and old ones abort the process. Expected: where there
    are only such, the variable names an empty file; where there is none, it is left as it was.
    """
    paths = list(map(library, found))
    monkeypatch.setattr(llvm, "cuda_driver", lambda: True)
    monkeypatch.setattr(llvm, "libraries", lambda: ([], paths))
    monkeypatch.delitem(sys.modules, "drjit", raising=False)
    monkeypatch.setenv(llvm.VARIABLE, "")  # counts as unset
    assert llvm.prepare().path is None
    assert (os.environ.get(llvm.VARIABLE) or None) == named


def test_import_after_drjit_does_not_ask_for_llvm_on_a_cuda_variant():
    code = """
mitsuba = types.ModuleType("mitsuba")
mitsuba.variant = lambda: "cuda_ad_rgb"
sys.modules["mitsuba"] = mitsuba
sys.path.insert(0, PATH)
import importlib.util
spec = importlib.util.spec_from_file_location("llvm", PATH)
llvm = importlib.util.module_from_spec(spec)
sys.modules["llvm"] = llvm
spec.loader.exec_module(llvm)
assert llvm.prepare().path is None
"""
    done = run(FAKE_DRJIT + code.replace("PATH", repr(str(Path(llvm.__file__)))))
    assert done.returncode == 0, done.stderr


TWO_KERNELS = """
import sys
import mitsuba_bdpt
import drjit as dr, mitsuba as mi
from mitsuba_bdpt.host.llvm import quick_compilation

def render(steps):
    x = dr.linspace(mi.Float, 0, 1, 64)
    for _ in range(steps):
        x = dr.sin(x) / (1 + x * x)
    print(*x.numpy())

mi.set_variant("llvm_ad_rgb")
if sys.argv[1:] == ["quick"]:
    with quick_compilation():
        render(10)
else:
    render(10)
render(20)
"""


def test_quick_compilation(tmp_path):
    """Expected: other code of the kernel within the block, the usual code of one after it, equal results but
    for the rounding of some sixty operations."""
    printed, kernels = [], []
    for way in ("usual", "again", "quick"):
        cache = tmp_path / way
        cache.mkdir()
        done = run(TWO_KERNELS, way, DRJIT_CACHE_DIR=str(cache))
        assert done.returncode == 0 and not done.stderr, done.stderr
        printed.append(done.stdout)
        kernels.append({file.name: file.read_bytes() for file in cache.glob("*.bin")})
    np.testing.assert_allclose(*(np.array(printed[i].split(), float) for i in (0, 2)), rtol=60 * 2.0**-23)
    assert kernels[0] == kernels[1], "files of kernels are not reproducible: this test shows nothing"
    assert kernels[0].keys() == kernels[2].keys()
    assert sum(kernels[0][name] != kernels[2][name] for name in kernels[0]) == 1


def test_quick_compilation_leaves_unknown_libraries_alone(library, monkeypatch):
    """Untested libraries may print each pass that they skip, or have no such option."""
    for name in ("", os.devnull, str(library("libLLVM-15.so.1")), str(library("libLLVM-23.so"))):
        monkeypatch.setenv(llvm.VARIABLE, name)
        llvm._option_setter.cache_clear()
        assert llvm._option_setter() is None
        with llvm.quick_compilation():
            pass
    llvm._option_setter.cache_clear()
