"""Tests of ``python -m mitsuba_bdpt doctor``: it must say what is wrong, and never die of it."""

import os
import signal
import subprocess
import sys

import pytest
from mitsuba_bdpt.cli import doctor
from mitsuba_bdpt.host import llvm


def command(*arguments, **env):
    """Run the package's own command with `arguments` in a new process."""
    return subprocess.run(
        [sys.executable, "-m", "mitsuba_bdpt", *arguments],
        capture_output=True,
        text=True,
        env=os.environ | env,
    )


def child(returncode, stdout="", stderr=""):
    """A stand-in for ``subprocess.run`` whose process ends like this."""
    return lambda *args, **kwargs: subprocess.CompletedProcess(args, returncode, stdout, stderr)


def test_healthy_installation():
    """The real command: renders with bdpt, names the LLVM and its origin, returns 0."""
    done = command("doctor")
    assert done.returncode == 0, done.stdout + done.stderr
    assert "FAIL" not in done.stdout and "mitsuba_bdpt works." in done.stdout
    for text in ("mitsuba             3.9", "drjit", "OpenEXR", "llvm_ad_rgb", "LLVM"):
        assert text in done.stdout


def test_runs_where_the_package_cannot_be_imported():
    done = command("doctor", **{llvm.VARIABLE: "/no/such.so"})
    assert done.returncode == 1
    assert "FAIL  LLVM                DRJIT_LIBLLVM_PATH='/no/such.so' names no file" in done.stdout
    assert done.stderr == ""


def test_what_the_command_itself_does_not_need_may_be_missing(tmp_path):
    for name in ("numpy", "rich"):
        (tmp_path / f"{name}.py").write_text(f"raise ImportError('no {name} here')")
    done = command("doctor", PYTHONPATH=str(tmp_path))
    assert done.returncode == 1 and "FAIL  import" in done.stdout and "no numpy here" in done.stdout
    assert done.stderr == ""


def test_other_commands_report_the_failure_without_a_traceback():
    done = command("render", "scene.xml", **{llvm.VARIABLE: "/no/such.so"})
    assert done.returncode == 1
    assert done.stderr.startswith("error: DRJIT_LIBLLVM_PATH=") and done.stderr.count("\n") == 1


@pytest.mark.skipif(not hasattr(os, "fork"), reason="signals that kill a child are POSIX's")
def test_crash_of_the_child_is_put_into_words():
    (found,) = doctor.render_in_child("llvm_ad_rgb", child(-signal.SIGABRT, "", "LLVM ERROR: no\n"))
    assert found.state == "FAIL" and "killed by SIGABRT (LLVM ERROR: no)" in found.text
    assert "Mend it with" in found.text or "Unset" in found.text


@pytest.mark.parametrize(
    ("backends", "text"),
    [
        ('["LLVM"]', "cuda_ad_rgb cannot render here: no CUDA library, driver or device was found"),
        ('["LLVM", "CUDA"]', "ImportError: no x"),
    ],
)
def test_an_error_of_the_child_has_its_reason(backends, text):
    printed = f'{{"threads": 2, "variants": ["cuda_ad_rgb"], "backends": {backends}}}\n'
    *_, found = doctor.render_in_child("cuda_ad_rgb", child(1, printed, "Traceback\nImportError: no x\n"))
    assert found == doctor.Finding("FAIL", "test image", text)


def test_what_fails_is_said(monkeypatch):
    def hang(command, **kwargs):
        raise subprocess.TimeoutExpired(command, kwargs["timeout"])

    monkeypatch.setattr(doctor, "PACKAGES", ("no-wheel", "surely-not-installed"))
    monkeypatch.setattr(doctor.llvm, "WHEEL", "no-wheel")
    wrong = [child(0, f'{{"llvm": "23", "mean": {mean}}}') for mean in ("0.0", "NaN", "1e9")]
    found = [found for process in (*wrong, hang) for found in doctor.render_in_child("llvm_ad_rgb", process)]
    for finding, text in zip(
        (*found, [*doctor.versions()][-1]),
        (*["its mean is"] * 3, "not finished", "pip install surely-not-installed"),
        strict=True,
    ):
        assert finding.state == "FAIL" and text in finding.text
    assert doctor.Finding("note", "no-wheel", "not installed") in [*doctor.versions()]


def test_which_variants_can_render_here():
    def here(*backends):
        names = ("scalar_rgb", "llvm_ad_rgb", "cuda_ad_rgb", "metal_ad_rgb")
        return [name for name in names if not doctor.why_not(name, backends)]

    assert (here(), here("LLVM")) == ([], ["llvm_ad_rgb"])
    assert here("LLVM", "CUDA") == ["llvm_ad_rgb", "cuda_ad_rgb"]


def test_unwritable_kernel_cache_is_a_note(monkeypatch, tmp_path):
    (tmp_path / "file").touch()
    monkeypatch.setenv("DRJIT_CACHE_DIR", str(tmp_path / "file" / "cache"))
    finding = doctor.kernel_cache()
    assert finding.state == "note" and "Set DRJIT_CACHE_DIR" in finding.text
