"""scripts/ablation.py: what it measures, in which order, and what its tables say."""

import json

import ablation
import gpu
import mitsuba as mi
import pytest
import repository

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


def test_the_most_informative_rows_come_first():
    """Expected: names of ways are unique, `path` leads, each way comes in all scenes before the next."""
    names = [way.name for way in ablation.WAYS]
    assert len(set(names)) == len(names) and names[0] == "path" and set(ablation.PROFILED) <= set(names)
    jobs = ablation.jobs_of(["a", "b"])
    assert jobs[:3] == [("a", 0), ("b", 0), ("a", 1)] and len(jobs) == 2 * len(names)


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


def test_tables_compare_with_path():
    """Expected: nanoseconds by the clock and of kernels, the latter over `path`'s; what failed says why."""
    failed = {"scene": "s", "way": "b", "measured": False, "kernels": [], "failed": "out of memory"}
    text = ablation.page({"rows": [row("path", 2.0), row("a", 5.0), failed]})
    assert "| path | 4, 2 (1.00x) |" in text and "| a | 10, 5 (2.50x) |" in text
    assert "| b | out of memory |" in text and "10 lines, 64 bytes, 96 registers, first 3 s" in text


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


def test_a_file_has_one_row_per_line():
    """Expected: JSON of the same content, each row on a line of its own; so is the recorded one, without
    what ptxas said of it."""
    found = {
        "size": 16,
        "software": {"a": "1"},
        "rows": [{"way": "a", "kernels": [{"hash": "h"}]}, {"way": "b"}],
    }
    text = ablation.one_row_per_line(found)
    assert json.loads(text) == found
    assert text.count('\n  {"way"') == 2
    recorded = (repository.ROOT / "docs" / "reports" / "cuda_ablation.json").read_text()
    assert ablation.one_row_per_line(json.loads(recorded)) == recorded and "ptxas" not in recorded


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
