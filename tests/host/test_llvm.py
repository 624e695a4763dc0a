"""Tests of the choice of the LLVM library (``mitsuba_bdpt.host.llvm``).

Every branch is tried on made-up machines: empty files stand for libraries, for only their names
count. Tests of the real thing, what ``import mitsuba_bdpt`` does to a process, run in children.
"""

import os
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

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


BARE = llvm.Machine(env={}, wheel=(), system=())


def test_variable_wins_over_everything_and_is_not_judged(library):
    """A user may know that LLVM 15 works on this machine."""
    named, wheel = library("libLLVM-15.so.1"), library("env/libLLVM.so.23.1")
    machine = llvm.Machine({llvm.VARIABLE: str(named)}, (wheel,), (wheel,))
    choice = llvm.choose(machine)
    assert (choice.path, choice.origin, choice.version) == (named, "variable", 15)


def test_variable_that_names_no_file_is_refused_in_words():
    with pytest.raises(llvm.LLVMNotFoundError, match=r"DRJIT_LIBLLVM_PATH='/no/such.so'.*Unset"):
        llvm.choose(replace(BARE, env={llvm.VARIABLE: "/no/such.so"}))


def test_empty_variable_counts_as_unset(library):
    wheel = library("libLLVM.so.23.1")
    machine = llvm.Machine({llvm.VARIABLE: ""}, (wheel,), ())
    assert llvm.choose(machine).origin == "wheel"


def test_wheel_wins_over_the_system(library):
    wheel, system = library("env/libLLVM.so.22.1"), library("usr/libLLVM.so.23.1")
    choice = llvm.choose(replace(BARE, wheel=(wheel,), system=(system,)))
    assert (choice.path, choice.origin, choice.version) == (wheel, "wheel", 22)


def test_newest_known_system_library_is_taken(library):
    names = ["libLLVM-15.so.1", "libLLVM-19.so", "libLLVM.so.22.1", "libLLVM.so.24.1"]
    paths = [library(name) for name in names]
    choice = llvm.choose(replace(BARE, system=tuple(paths)))
    assert (choice.path, choice.origin, choice.version) == (paths[2], "system", 22)


def test_wheel_of_an_untested_version_is_passed_over(library):
    wheel, system = library("env/libLLVM.so.24.1"), library("usr/libLLVM-19.so")
    assert llvm.choose(replace(BARE, wheel=(wheel,), system=(system,))).path == system


@pytest.mark.parametrize("version", [14, 15, 16, 17, 18])
def test_old_libraries_are_named_and_not_taken(library, version):
    old = library(f"libLLVM-{version}.so.1")
    with pytest.raises(llvm.LLVMNotFoundError) as caught:
        llvm.choose(replace(BARE, system=(old,)))
    assert f"{old} (LLVM {version}, too old)" in str(caught.value)


def test_untested_and_unknown_versions_are_named_with_the_way_to_try_them(library):
    paths = (library("libLLVM-21.so"), library("libLLVM.so"))
    with pytest.raises(llvm.LLVMNotFoundError) as caught:
        llvm.choose(replace(BARE, system=paths))
    assert f"{paths[0]} (LLVM 21, untested; to try it, set {llvm.VARIABLE})" in str(caught.value)
    assert f"{paths[1]} (version unknown; to try it, set {llvm.VARIABLE})" in str(caught.value)


@pytest.mark.parametrize(
    ("system", "architecture", "command"),
    [
        ("Linux", "x86_64", "pip install 'karellen-llvm-core"),
        ("Linux", "aarch64", "apt install libllvm19"),
        ("Darwin", "arm64", "brew install llvm@19"),
        ("Windows", "AMD64", "set DRJIT_LIBLLVM_PATH"),
    ],
)
def test_error_names_the_command_for_the_platform(system, architecture, command):
    machine = replace(BARE, system_name=system, architecture=architecture)
    with pytest.raises(llvm.LLVMNotFoundError) as caught:
        llvm.choose(machine)
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


def test_search_finds_libraries_once_and_nothing_else(library, tmp_path):
    real = library("libLLVM-19.so.1")
    (tmp_path / "libLLVM-19.so").symlink_to(real.name)
    library("libLLVMSupport.so.19")
    library("libLLVM-19.a")
    assert llvm.system_libraries([tmp_path, tmp_path / "missing", tmp_path]) == [real]


def test_wheel_is_found_where_its_list_of_files_is_missing(library, monkeypatch):
    """Some installers drop the list; others never made one."""
    wheel = library("lib/libLLVM.so.23.1")

    class Distribution:
        files = None

    monkeypatch.setattr("importlib.metadata.distribution", lambda name: Distribution())
    assert llvm.wheel_libraries(wheel.parents[1]) == [wheel]


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
    monkeypatch.setattr("importlib.metadata.distribution", lambda name: Distribution())
    monkeypatch.setattr(subprocess, "run", lambda command, **_: started.append(command[0]))
    llvm.finish_installation()
    assert started == [sys.executable] * starts


def test_no_wheel_no_libraries(monkeypatch, tmp_path):
    monkeypatch.setattr(llvm, "WHEEL", "surely-not-an-installed-distribution")
    assert llvm.wheel_libraries(tmp_path) == []


@pytest.mark.parametrize("version", [(14, 0, 6), (15, 0, 7), (16, 0, 0), (18, 1, 8)])
def test_old_llvm_of_an_imported_drjit_is_refused(version):
    number = ".".join(map(str, version))
    with pytest.raises(llvm.LLVMNotFoundError, match=f"LLVM {number}.*Import mitsuba_bdpt before"):
        llvm.check_loaded(version, BARE)


def test_imported_drjit_without_llvm_is_refused():
    with pytest.raises(llvm.LLVMNotFoundError, match="found no usable LLVM"):
        llvm.check_loaded((-1, -1, -1), BARE)


@pytest.mark.parametrize("env", [{}, {llvm.VARIABLE: "old"}])
def test_old_llvm_of_an_imported_drjit_is_answered_with_the_library_to_take(library, env):
    """Expected: the library that would have been chosen, the variable apart, which named the old one."""
    new, old = library("libLLVM.so.23.1"), library("old")
    machine = llvm.Machine({name: str(old) for name in env}, (new,), ())
    with pytest.raises(llvm.LLVMNotFoundError) as caught:
        llvm.check_loaded((15, 0, 7), machine)
    assert f"set {llvm.VARIABLE}={new} before Python starts" in str(caught.value)
    assert "import mitsuba_bdpt  # isort: skip" in str(caught.value)
    with pytest.raises(llvm.LLVMNotFoundError, match="install a newer one"):
        llvm.check_loaded((15, 0, 7), replace(machine, wheel=()))


@pytest.mark.parametrize("major", [19, 21, 23])
def test_new_llvm_of_an_imported_drjit_is_accepted(major):
    choice = llvm.check_loaded((major, 1, 0), BARE)
    assert (choice.path, choice.origin, choice.version) == (None, "drjit", major)


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


def test_a_machine_with_cuda_needs_no_llvm(library):
    """Expected: with a driver of CUDA the choice is none, whatever unusable there is, also in a process that
    inherits the choice of its parent, and where Dr.Jit came first; a usable library is chosen nevertheless.
    """
    cuda = replace(BARE, has_cuda=lambda: True)
    old = replace(cuda, system=(library("libLLVM-15.so.1"),))
    choice = llvm.choose(old)
    assert (choice.path, choice.origin) == (None, "none")
    assert "only variants of CUDA" in str(choice) and "LLVM 15, too old" in str(choice)
    assert llvm.choose(replace(old, env={llvm.VARIABLE: os.devnull})).origin == "none"
    assert llvm.check_loaded((-1, 0, 0), cuda).origin == "none"
    with pytest.raises(llvm.LLVMNotFoundError, match="too old"):
        llvm.check_loaded((15, 0, 7), old)
    with pytest.raises(llvm.LLVMNotFoundError, match="names no file"):
        llvm.choose(replace(BARE, env={llvm.VARIABLE: os.devnull}))
    assert llvm.choose(replace(old, system=(library("libLLVM.so.22.1"),))).origin == "system"


@pytest.mark.parametrize("found, named", [((), None), (("libLLVM-15.so.1",), os.devnull)])
def test_unusable_libraries_are_kept_from_drjit(library, monkeypatch, found, named):
    """Rationale: Dr.Jit looks for a library by itself, and old ones abort the process. Expected: where there
    are only such, the variable names an empty file; where there is none, it is left as it was.
    """
    machine = replace(BARE, system=tuple(map(library, found)), has_cuda=lambda: True)
    monkeypatch.setattr(llvm.Machine, "here", lambda: machine)
    monkeypatch.delitem(sys.modules, "drjit", raising=False)
    monkeypatch.delenv(llvm.VARIABLE, raising=False)
    assert llvm.prepare().origin == "none"
    assert os.environ.get(llvm.VARIABLE) == named


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
assert llvm.prepare().origin == "none"
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
