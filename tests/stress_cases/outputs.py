"""Files that are missing, and outputs that can't be written: part of the section on bad input."""

from __future__ import annotations

import contextlib
import io
import os
import re
import subprocess
import sys
import tempfile
from collections.abc import Callable
from pathlib import Path
from unittest import mock

import repository
from mitsuba_bdpt.cli import arguments as __main__
from mitsuba_bdpt.cli import render
from mitsuba_bdpt.files.whole import MAGIC

import mitsuba as mi  # isort: skip

from . import child
from .case import Outcome

PLAIN = """
<scene version="3.0.0">
    <default name="size" value="4"/>
    <sensor type="perspective">
        <film type="hdrfilm">
            <integer name="width" value="$size"/><integer name="height" value="$size"/>
            <string name="component_format" value="float32"/>
        </film>
    </sensor>
    <shape type="sphere">
        <boolean name="flip_normals" value="true"/>
        <emitter type="area"><rgb name="radiance" value="0.5"/></emitter>
    </shape>
    {more}
</scene>
"""
BROKEN = {
    "no scene": None,
    "an empty file": "",
    "bytes that are no text": b"\xff\x00\xfe" * 999,
    "half a scene": PLAIN[:300],
    "no mesh": '<shape type="ply"><string name="filename" value="missing.ply"/></shape>',
    "no texture": '<emitter type="envmap"><string name="filename" value="missing.exr"/></emitter>',
    "a folder for a mesh": '<shape type="ply"><string name="filename" value="folder"/></shape>',
    "half a mesh": '<shape type="ply"><string name="filename" value="half.ply"/></shape>',
    "half a texture": '<emitter type="envmap"><string name="filename" value="half.exr"/></emitter>',
    "no include": '<include filename="missing.xml"/>',
    "a scene that includes itself": '<include filename="scene.xml"/>',
}


def _half(source: Path, target: Path):
    data = source.read_bytes()
    target.write_bytes(data[: len(data) // 2])


def _said(arguments, before: str = "") -> tuple[int, str, bool]:
    """Exit status and standard error of the command, and whether it has rendered."""
    text, rendered = io.StringIO(), []
    original = render.render

    def noted(*arguments):
        rendered.append(True)
        return original(*arguments)

    with (
        contextlib.redirect_stderr(text),
        contextlib.redirect_stdout(io.StringIO()),
        mock.patch.object(render, "render", noted),
    ):
        status = __main__.main(["render", *map(str, arguments)])
    return status, text.getvalue(), bool(rendered)


def _listing(folder: Path) -> dict[str, bytes | None]:
    """All that is in a folder, with the contents of files."""
    found = {}
    for path in sorted(folder.rglob("*")):
        found[str(path)] = path.read_bytes() if path.is_file() and not path.is_symlink() else None
    return found


def missing_files() -> Outcome:
    """The command on files that are not there, or not whole."""
    wrong = []
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        (folder / "folder").mkdir()
        mesh, texture = next((repository.ROOT / "scenes" / "meshes").glob("*.ply")), folder / "whole.exr"
        mi.Bitmap(mi.TensorXf([0.5] * 3000, shape=(25, 40, 3))).write(str(texture))
        _half(mesh, folder / "half.ply")
        _half(texture, folder / "half.exr")
        for words, text in BROKEN.items():
            scene = folder / "scene.xml"
            scene.unlink(missing_ok=True)
            if isinstance(text, bytes):
                scene.write_bytes(text)
            elif text is not None:
                scene.write_text(PLAIN.format(more=text) if text.startswith(("<sh", "<em", "<in")) else text)
            before = _listing(folder)
            status, said, _ = _said([scene, "-o", folder / "a.exr", "--spp", 1])
            if status != 2 or not said.startswith("error: ") or "Traceback" in said:
                wrong.append(f"{words}: status {status}, {said.strip()[-160:] or 'nothing said'}")
            elif _listing(folder) != before:
                wrong.append(f"{words}: files were left behind")
    return Outcome(not wrong, "; ".join(wrong) or f"{len(BROKEN)} errors in words, nothing written")


def _no_file(folder: Path, kind: str) -> Path:
    """An output that can't be written."""
    folder.mkdir()
    (folder / "text").write_text("precious")
    if kind == "a folder":
        (folder / "a.exr").mkdir()
    elif kind == "a folder where the PNG goes":
        (folder / "a.png").mkdir()
    elif kind == "a pipe":
        os.mkfifo(folder / "a.exr")
    elif kind == "in a file":
        return folder / "text" / "a.exr"
    elif kind == "a name of 255 characters":
        return folder / ("a" * 251 + ".exr")
    elif kind == "a name of 300 characters":
        return folder / ("a" * 296 + ".exr")
    elif kind == "a link to a text":
        (folder / "a.exr").symlink_to("text")
    elif kind == "a text":
        (folder / "a.exr").write_text("precious")
    elif kind == "a PNG named EXR":
        (folder / "a.exr").write_bytes(MAGIC[".png"] + b"precious")
    elif kind == "a folder where the checkpoint goes":
        (folder / "a.checkpoint.npz").mkdir()
    elif kind == "no name":
        return folder / ".exr"
    return folder / "a.exr"


KINDS = (
    "a folder",
    "a folder where the PNG goes",
    "a pipe",
    "in a file",
    "a name of 255 characters",
    "a name of 300 characters",
    "a link to a text",
    "a text",
    "a PNG named EXR",
    "a folder where the checkpoint goes",
    "no name",
)


def output_names() -> Outcome:
    """The command with outputs that can't be written; in a process of its own for a hang's sake."""
    wrong, done = [], []
    with tempfile.TemporaryDirectory() as name, child.read_only_folder() as unwritable:
        scene = Path(name) / "scene.xml"
        scene.write_text(PLAIN.format(more=""))
        outputs = {kind: _no_file(Path(name) / str(i), kind) for i, kind in enumerate(KINDS)}
        if unwritable:
            outputs["a folder that can't be written"] = unwritable / "a.exr"
            outputs["a new folder there"] = unwritable / "new" / "a.exr"
        for kind, output in outputs.items():
            before = _listing(Path(name))
            more = ["--checkpoint", "60"] if "checkpoint" in kind else []
            status, text, rendered = _said([scene, "-o", output, "--spp", 1, *more])
            if status != 2 or not text.startswith("error: ") or rendered:
                wrong.append(f"{kind}: status {status}, {text.strip()[:120] or 'nothing said'}, {rendered=}")
            elif _listing(Path(name)) != before:
                wrong.append(f"{kind}: files were changed")
            else:
                done.append(kind)
    return Outcome(not wrong, "; ".join(wrong) or f"refused before anything is rendered: {', '.join(done)}")


# -- full disks -------------------------------------------------------------------------------


def _on_small_disk(size: int, tried: Callable[[Path, dict], list[str]]) -> Outcome:
    """Run ``tried``, which says what went wrong, on a disk of so many bytes."""
    with child.small_disk(size) as (folder, keywords, words):
        wrong = tried(folder, keywords)
        left = [path.name for path in folder.rglob("*.tmp")]
    if left:
        wrong.append(f"left behind: {left}")
    if keywords:  # what stands in for the disk may fail; that it doesn't says nothing of a disk
        words = f"{child.NO_DISK}; with {words}"
    return Outcome(
        False if wrong else None if keywords else True, f"{words}: {'; '.join(wrong) or 'as expected'}"
    )


def _full_image(folder: Path, keywords: dict) -> list[str]:
    """A small image, then ones over it that don't fit: too large an EXR, or too large a PNG."""
    scene, wrong = folder / "scene.xml", []
    lamp = '<emitter type="point"><point name="position" x="0.3" y="0.2" z="0.5"/></emitter>'
    scene.write_text(PLAIN.format(more=lamp))
    arguments = ["render", scene, "-o", folder / "a.exr", "--spp", 1]
    first = child.command(*arguments, **keywords)
    if first.returncode:
        return [f"the small image: status {first.returncode}, {first.stderr[-120:]}"]
    former = {kind: (folder / f"a.{kind}").read_bytes() for kind in ("exr", "png")}
    for size in (60, 90, 120, 400):
        done = child.command(*arguments, "-D", f"size={size}", **keywords)
        if done.returncode != 1 or "error: " not in done.stderr:
            wrong.append(f"{size}: status {done.returncode}, {done.stderr[-120:]}")
        for kind, data in former.items():
            if (folder / f"a.{kind}").read_bytes() != data:
                wrong.append(f"{size}: another {kind}")
    return wrong


def full_disk_image() -> Outcome:
    """An image that doesn't fit leaves the former one."""
    return _on_small_disk(24 << 10, _full_image)


def _full_checkpoint(folder: Path, keywords: dict) -> list[str]:
    scene, wrong = folder / "scene.xml", []
    scene.write_text(PLAIN.format(more=""))
    arguments = ["render", scene, "-o", folder / "a.exr", "--spp", 8, "--checkpoint", 0, "-D", "size=64"]
    done = child.command(*arguments, "-P", "spp_per_pass=2", **keywords)
    if done.returncode or "warning: no checkpoint" not in done.stderr:
        wrong.append(f"status {done.returncode}, {done.stderr[-160:]}")
    elif not (folder / "a.exr").exists() or not (folder / "a.png").exists():
        wrong.append("no image")
    return wrong


def full_disk_checkpoint() -> Outcome:
    """A checkpoint of 64 bytes per pixel doesn't fit where the image does."""
    return _on_small_disk(160 << 10, _full_checkpoint)


PRESET = """
resolution = 128
seeds = 2
scenes = ["cornell_box"]
spp = [1]
[scene.cornell_box]
max_depth = 6
[[integrator]]
name = "bdpt"
type = "bdpt"
"""


def _sweep(folder: Path, preset: Path, keywords: dict):
    command = [sys.executable, str(repository.ROOT / "scripts" / "sweep.py"), str(preset), "-o", str(folder)]
    return subprocess.run(
        command, capture_output=True, text=True, env=child.environment(), check=False, **keywords
    )


def _full_sweep(folder: Path, keywords: dict) -> list[str]:
    """A sweep whose images don't fit, and once more where there is room.

    The images have noise: an even one would fit.
    """
    wrong = []
    with tempfile.TemporaryDirectory() as name:
        preset = Path(name) / "tiny.toml"
        preset.write_text(PRESET)
        done = _sweep(folder, preset, keywords)
        if done.returncode != 1 or done.stdout.count("failed: ") != 2:
            wrong.append(f"status {done.returncode}: {(done.stdout + done.stderr)[-160:]}")
        if left := [*(folder / "cells").glob("*.json"), *folder.rglob("*.exr")]:
            wrong.append(f"rows or images of renders that failed: {left}")
        again = _sweep(Path(name) / "more", preset, {})
        if again.returncode or "2 rows" not in again.stdout:
            wrong.append(f"with room: status {again.returncode}: {(again.stdout + again.stderr)[-160:]}")
    return wrong


def full_disk_sweep() -> Outcome:
    """A sweep on a full disk says which renders failed, and keeps no half of a row."""
    return _on_small_disk(64 << 10, _full_sweep)


def read_only_disk() -> Outcome:
    """A disk that becomes read-only while a render runs."""
    with child.small_disk(1 << 20) as (folder, keywords, _):
        if keywords:
            return Outcome(None, child.NO_DISK)
        scene, output = folder / "scene.xml", folder / "a.exr"
        scene.write_text(PLAIN.format(more=""))
        _said([scene, "-o", output, "--spp", 1])
        before = _listing(folder)
        original = render.write_images

        def write(*arguments):
            subprocess.run(["mount", "-o", "remount,ro", str(folder)], check=True)
            original(*arguments)

        with mock.patch.object(render, "write_images", write):
            status, text, rendered = _said([scene, "-o", output, "--spp", 2, "--checkpoint", 0])
        same = _listing(folder).items() >= before.items()
        error = (text.strip().splitlines() or [""])[-1]
        ok = status == 1 and error.startswith("error: ") and rendered and same
        left = [path.name for path in folder.rglob("*.tmp")]
        said = re.sub(r"\.\d+\.tmp", ".tmp", error.replace(str(folder), "DISK"))
        said = re.sub(r"(the image is) '.*?'", r"\1 'COPY'", said)
        return Outcome(ok and not left, f"status {status}, {said[:120]}, former image there: {same}")
