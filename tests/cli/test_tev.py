"""Images in the viewer tev, against a socket that reads its protocol."""

import socket
import struct
import threading
import time
from pathlib import Path

import numpy as np
import OpenEXR
import pytest
from mitsuba_bdpt.cli import live, tev
from mitsuba_bdpt.cli.arguments import build_parser, main
from patience import PATIENCE

SCENE = Path(__file__).parents[2] / "scenes" / "cornell_box.xml"


class Viewer:
    """A server that keeps the messages of one client."""

    def __init__(self, most=None):
        self.server = socket.create_server(("127.0.0.1", 0))
        self.port, self.messages, self.most = self.server.getsockname()[1], [], most
        self.thread = threading.Thread(target=self._serve, daemon=True)
        self.thread.start()

    def _serve(self):
        connection, _ = self.server.accept()
        with connection, connection.makefile("rb") as stream:
            while (length := stream.read(4)) and (self.most is None or len(self.messages) < self.most):
                self.messages.append(stream.read(struct.unpack("<i", length)[0] - 4))
        self.server.close()

    def received(self):
        self.thread.join(timeout=PATIENCE)
        return [parsed(data) for data in self.messages]


def parsed(data):
    """The fields of a message, as tev reads them (IpcPacket of its Ipc.cpp: interpretAsCreateImage and
    interpretAsUpdateImage, version 3)."""
    kind, focus = data[0], data[1]
    at = 2

    def text():
        nonlocal at
        end = data.index(b"\0", at)
        value, at = data[at:end].decode(), end + 1
        return value

    def numbers(count, kind="i"):
        nonlocal at
        size = struct.calcsize(f"<{count}{kind}")
        values, at = struct.unpack(f"<{count}{kind}", data[at : at + size]), at + size
        return values

    found = {"kind": kind, "focus": focus, "name": text()}
    if kind == tev.CREATE:
        found["size"] = numbers(2)
        found["channels"] = [text() for _ in range(numbers(1)[0])]
        assert at == len(data)
        return found
    (count,) = numbers(1)
    found["channels"] = [text() for _ in range(count)]
    x, y, width, height = numbers(4)
    offsets, strides = numbers(count, "q"), numbers(count, "q")
    pixels = np.frombuffer(data[at:], dtype="<f4")
    places = [
        offset + stride * np.arange(width * height) for offset, stride in zip(offsets, strides, strict=True)
    ]
    found["pixels"] = pixels[np.array(places)].reshape(count, height, width).transpose(1, 2, 0)
    assert (x, y) == (0, 0) and kind == tev.UPDATE
    return found


def test_a_render_is_shown_while_it_goes_on(tmp_path, monkeypatch):
    """Expected: an image of the film's size, named as the file, is made once; the last pixels that come are
    those of the file but for its half precision.
    """
    monkeypatch.setattr(live, "TEV_EVERY", 0.0)
    viewer, output = Viewer(), tmp_path / "shown.exr"
    arguments = ["render", str(SCENE), "--size", "12x8", "--spp", "8", "-P", "spp_per_pass=4"]
    assert main([*arguments, "--tev", f"127.0.0.1:{viewer.port}", "-o", str(output)]) == 0
    made, *updates = viewer.received()
    assert made["kind"] == tev.CREATE and made["name"] == "shown.exr"
    assert made["size"] == (12, 8) and made["channels"] == ["R", "G", "B"]
    assert len(updates) == 3 and all(update["name"] == "shown.exr" for update in updates)
    channels = OpenEXR.File(str(output), separate_channels=True).channels()
    expected = np.stack([channels[name].pixels for name in "RGB"], axis=-1)
    assert np.allclose(updates[-1]["pixels"], expected, rtol=2e-3, atol=1e-4)
    assert not np.allclose(updates[0]["pixels"], expected, rtol=2e-3, atol=1e-4)


def test_no_viewer_is_an_error_before_the_render(tmp_path, capsys):
    with socket.create_server(("127.0.0.1", 0)) as free:
        port = free.getsockname()[1]
    output = tmp_path / "image.exr"
    assert main(["render", str(SCENE), "--tev", f"127.0.0.1:{port}", "-o", str(output)]) == 1
    assert "does not answer" in capsys.readouterr().err and not output.exists()


def test_a_viewer_that_is_closed_does_not_end_the_render(capsys):
    """Expected: a warning, once, and nothing more is sent."""
    viewer = Viewer(most=1)
    shown = tev.Tev("127.0.0.1", viewer.port, "image")
    shown.show(np.zeros((4, 4, 3), np.float32))
    viewer.received()
    for _ in range(5):  # what the system has already sent may get lost without a word
        shown.show(np.zeros((4, 4, 3), np.float32))
        time.sleep(0.05)
    assert capsys.readouterr().err.count("tev is gone") == 1


@pytest.mark.parametrize("text", ["", ":1", "host:x", "host:0", "host:70000", "::1", "[::1]:x", "[]:5"])
def test_addresses(text):
    assert tev.address("host") == ("host", tev.PORT) and tev.address("10.0.0.1:5") == ("10.0.0.1", 5)
    assert tev.address("[::1]:5") == ("::1", 5) and tev.address("[::1]") == ("::1", tev.PORT)
    with pytest.raises(ValueError, match="HOST:PORT"):
        tev.address(text)
    with pytest.raises(SystemExit):
        build_parser().parse_args(["render", "x.xml", "--tev", text])
