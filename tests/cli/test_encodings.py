"""Names that the locale, or a stream, cannot write."""

import io
import os
import subprocess
import sys
from pathlib import Path

import mitsuba as mi
import numpy as np
import pytest
from mitsuba_bdpt.cli.arguments import main
from mitsuba_bdpt.errors import CommandError
from mitsuba_bdpt.files.texts import write_text
from mitsuba_bdpt.files.whole import utf8

SCENE = """<?xml version="1.0" encoding="utf-8"?>
<scene version="3.0.0">
    <sensor type="perspective"><film type="hdrfilm">
        <integer name="width" value="4"/><integer name="height" value="4"/>
    </film></sensor>
    <emitter type="envmap" id="空"><string name="filename" value="$sky"/></emitter>
</scene>"""

RENDER = ["render", "光.xml", "--spp", "1", "-P", "light_groups=auto", "-D", "sky=空.exr", "-o", "光.exr"]
COMMANDS = (RENDER, ["mix", "光.exr"], ["mix", "光.exr", "_=2", "-o", "é.exr"])


@pytest.fixture(autouse=True)
def folder(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    Path("光.xml").write_text(SCENE, encoding="utf-8")
    mi.Bitmap(np.ones((4, 8, 3), np.float32)).write("空.exr")


def test_output_does_not_fail_for_its_encoding(monkeypatch):
    """Such characters are escaped, and the exit status is 0."""
    for name in ("stdout", "stderr"):
        monkeypatch.setattr(sys, name, io.TextIOWrapper(io.BytesIO(), encoding="cp1252"))
    assert [main(command) for command in COMMANDS] == [0, 0, 0]
    assert main(["render", "日.xml"]) == 2
    for stream, words in ((sys.stdout, (r"\u5149.exr: ", r"\u7a7a")), (sys.stderr, (r"\u65e5.xml",))):
        stream.flush()
        text = stream.buffer.getvalue().decode("cp1252")
        assert all(word in text for word in words), text


def test_commands_in_a_locale_of_ascii():
    ascii_alone = {"LC_ALL": "C", "PYTHONUTF8": "0", "PYTHONCOERCECLOCALE": "0"}
    code = "import sys, mitsuba_bdpt.cli.arguments as a; sys.exit(a.main(sys.argv[1:]))"
    for command in ([*RENDER, "--checkpoint", "0"], *COMMANDS[1:]):
        done = subprocess.run(
            [sys.executable, "-c", code, *command],
            env=os.environ | ascii_alone,
            capture_output=True,
        )
        assert done.returncode == 0, done.stderr.decode()
    assert set(os.listdir()) == {"光.xml", "空.exr", "光.exr", "光.png", "é.exr", "é.png"}


def test_what_utf8_cannot_write():
    name = os.fsdecode(b"sc\xe9ne.xml")
    os.rename("光.xml", name)
    assert main(["render", name, "--spp", "1"]) == 2
    with pytest.raises(CommandError, match="is not in UTF-8, .*; rename"):
        utf8(Path(name))
    write_text(Path("a.txt"), f"<p>光 {name}")
    assert Path("a.txt").read_bytes() == "<p>光 sc\\udce9ne.xml".encode()
