"""Sends images to the viewer tev (https://github.com/Tom94/tev) by its network protocol.

A message is its length (the four bytes of it included), a byte that says what it is, and its fields; integers
are little-endian, texts end in a zero byte. Two kinds are used: `CREATE` makes an image, `UPDATE` replaces
pixels of it. (The protocol is that of tev 1.20 and later, of which a client in Python is under the GPL.)
"""

from __future__ import annotations

import socket
import struct
import sys
from typing import TYPE_CHECKING

from ..errors import FailureError

# Not here: `doctor` runs where it is missing.
if TYPE_CHECKING:
    import numpy as np

PORT = 14158
"""tev's own, where none is given."""

TIMEOUT = 3.0
"""Seconds that tev may take to answer."""

SENT_WITHIN = 60.0
"""Seconds that sending an image may take: 100 MB over a slow network take ten."""

CREATE, UPDATE = 4, 6


def address(text: str) -> tuple[str, int]:
    """Host and port of ``HOST`` or ``HOST:PORT``, IPv6 addresses in brackets; raises ``ValueError``."""
    host, colon, port = text.rpartition(":")
    if not colon or text.endswith("]"):
        host, port = text, str(PORT)
    if host.startswith("[") and host.endswith("]"):
        host = host[1:-1]
    elif ":" in host:
        host = ""
    if not host or not port.isdecimal() or not 0 < int(port) < 1 << 16:
        raise ValueError(f"got {text!r}, which must have the form HOST or HOST:PORT")
    return host, int(port)


def message(kind: int, *fields: bytes) -> bytes:
    """A message of this ``kind``."""
    body = bytes([kind]) + b"".join(fields)
    return struct.pack("<i", 4 + len(body)) + body


def _text(value: str) -> bytes:
    return value.encode() + b"\0"


def _integers(*values: int) -> bytes:
    return struct.pack(f"<{len(values)}i", *values)


def creation(name: str, width: int, height: int, channels: str) -> bytes:
    """The message that makes an image ``name``, all black, with ``channels`` of one letter each.

    tev comes to the front.
    """
    names = b"".join(_text(channel) for channel in channels)
    return message(CREATE, b"\1", _text(name), _integers(width, height, len(channels)), names)


def update(name: str, pixels: np.ndarray, channels: str) -> bytes:
    """The message that replaces all pixels, shape (height, width, channels), of the image ``name``."""
    height, width, count = pixels.shape
    names = b"".join(_text(channel) for channel in channels)
    # Of each channel where its first number is, and how far apart two are.
    places = struct.pack(f"<{2 * count}q", *range(count), *[count] * count)
    head = (b"\0", _text(name), _integers(count), names, _integers(0, 0, width, height), places)
    return message(UPDATE, *head, pixels.astype("<f4").tobytes())


class Tev:
    """A connection to tev, in which one image is shown."""

    def __init__(self, host: str, port: int, name: str):
        self._name, self._made = name, False
        try:
            self._socket = socket.create_connection((host, port), TIMEOUT)
        except OSError as error:
            raise FailureError(
                f"tev={host}:{port} does not answer ({error}); start tev there (it listens on port {PORT} "
                "unless told otherwise), or leave --tev out."
            ) from error
        self._socket.settimeout(SENT_WITHIN)

    def show(self, pixels: np.ndarray) -> None:
        """Show ``pixels``, shape (height, width, 1 or 3), linear.

        A viewer that was closed must not cost the render: it is said on standard error, once.
        """
        if self._socket is None:
            return
        height, width, count = pixels.shape
        channels = "RGB" if count == 3 else "Y"
        try:
            if not self._made:
                self._socket.sendall(creation(self._name, width, height, channels))
                self._made = True
            self._socket.sendall(update(self._name, pixels, channels))
        except (OSError, struct.error) as error:  # the latter for messages of 2 GiB and more
            print(f"warning: tev is gone ({error}); the render goes on without it", file=sys.stderr)
            self.close()

    def close(self) -> None:
        """End the connection; the image stays in the viewer."""
        if self._socket is not None:
            self._socket.close()
            self._socket = None
