"""scripts/ablation.py: what it measures, in which order, and what its tables say."""

import json

import ablation
import gpu
import mitsuba as mi
import pytest

TINY = [
    "--ablation",
    "cornell_box",
    "--variant",
    "llvm_ad_rgb",
    "--size",
    "16",
    "--spp",
    "4",
    "--beside",
    "1",
]


def test_a_run_that_is_cut_off_says_what_it_has(tmp_path, monkeypatch, capsys):
    """Expected: the file and the table have a row for each way; those for which there was no time say so."""
    monkeypatch.setattr(ablation, "WAYS", ablation.WAYS[:1])
    file = tmp_path / "found.json"
    gpu.main([*TINY, "--output", str(file), "--seconds", "0"])
    (row,) = json.loads(file.read_text())["rows"]
    assert not row["measured"] and "| path | not measured |" in capsys.readouterr().out


@pytest.mark.parametrize("way", [w for w in ablation.WAYS if w.counters or w.evaluated], ids=lambda w: w.name)
def test_what_is_changed_is_changed_and_put_back(way):
    """Expected: a render in a changed way has kernels and times; afterwards counters count as before."""
    mi.set_variant("llvm_ad_rgb")
    subject = ablation.Subject.of("cornell_box", way, 16)
    summed = ablation.Counters.summed
    compiled = subject.compile()
    assert compiled["kernels"] and ablation.Counters.summed is summed
    timed = subject.time(4)
    assert timed["spp"] == 4 and timed["kernel_seconds_long"] > 0
    counts = getattr(subject.integrator, "statistics", {}).get("rays")
    assert counts is None or (sum(counts.values()) == 0) == (way.counters == "none")


def row(way, kernels_ns, **more):
    """A measured row of one scene."""
    kernel = {"hash": "h", "seconds": 1.0, "lines": 10, "local_bytes": 64, "registers": 96}
    times = {"ns_seconds": 2 * kernels_ns, "ns_kernel_seconds": kernels_ns, "first_seconds": 3.0}
    return {"scene": "s", "way": way, "measured": True, "kernels": [kernel]} | times | more


@pytest.mark.parametrize("target", ["sm_70", "sm_90"])
def test_kernels_are_assembled_for_their_own_target(target, tmp_path, monkeypatch):
    """Expected: the ptxas on the PATH gets the architecture of the PTX, and its figures are in the row; those
    of OptiX, and all where there is no ptxas, have none."""
    monkeypatch.setenv("PATH", str(tmp_path))
    code = f".version 6.0\n.target {target}\n"
    assert ablation.assembled(code) == {}
    tool = tmp_path / "ptxas"
    tool.write_text(
        f'#!/bin/sh\n[ "$2" = -arch={target} ] || exit 1\n'
        'echo "8 bytes stack frame, 4 bytes spill stores, 4 bytes spill loads" >&2\n'
        'echo "Used 96 registers" >&2\n'
    )
    tool.chmod(0o755)
    assert ablation.assembled(code) == {"registers": 96, "stack_bytes": 8, "spilled_bytes": 4}
    assert ablation.assembled(code + "call (x), _optix_trace_32, (y);") == {}
    assert ablation.assembled("; LLVM") == {}


def test_code_of_kernels_is_counted():
    """Expected: bytes of arrays in local memory and calls that trace rays, as PTX writes them."""

    class Code:
        def getvalue(self):
            return (
                ".local .align 4 .b32 a[64];\n.local .align 8 .b8 b[16];\ncall (x), _optix_trace_32, (y);\n"
            )

    kernel = {"ir": Code(), "uses_optix": 1, "operation_count": 9, "codegen_time": 1, "backend_time": 1}
    found = ablation.described(kernel | {"cache_disk": 0})
    assert found["local_bytes"] == 4 * 64 + 16 and found["rays"] == 1 and found["compile_seconds"] == 0.002
