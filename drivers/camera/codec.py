"""Codec of cameras that serve pictures over HTTP: ``multipart/x-mixed-replace``, one part a picture (MJPEG).

There is no standard beside RFC 2046; this takes what is met: a boundary with its dashes or without, parts with a
``Content-Length`` or ended by the next boundary alone, lines ended by CR LF or LF, and chunks around it all (as an
ESP32-CAM sends).  Bytes may come cut anywhere.
"""

from __future__ import annotations

import base64
from collections.abc import Callable, Mapping

from drivers.errors import BadFrame

MOST_BYTES = 1024 * 1024
"""Of a picture."""
MOST_HEAD = 8192
"""Bytes of the fields before the stream, or before one picture."""
TOO_LARGE = f"a picture has more than {MOST_BYTES} bytes; have it send smaller ones"
KIND = "multipart/x-mixed-replace"
BOUNDARY = "frame"

_REMEDIES = {
    401: 'it asks for a name and password: write url = "http://NAME:PASSWORD@..."',
    403: 'it asks for a name and password: write url = "http://NAME:PASSWORD@..."',
    404: "correct the path of url",
    503: "it serves others already; end those",
}


def request(host: str, path: str, login: str = "") -> bytes:
    """What asks ``host`` for the stream at ``path``; ``login`` is ``NAME:PASSWORD``, or empty."""
    lines = [f"GET {path} HTTP/1.1", f"Host: {host}", f"Accept: {KIND}", "Connection: close"]
    if login:
        lines.append("Authorization: Basic " + base64.b64encode(login.encode()).decode())
    return "\r\n".join([*lines, "", ""]).encode()


class StreamReader:
    """The pictures in the answer to one request; not looked into, so that one may be none.

    ``read`` raises ``BadFrame`` with the reason and the remedy where the answer is no stream of pictures, or cannot be
    followed any more; nothing may be read after that.  ``is_over`` says whether the stream has come to its own end.
    """

    def __init__(self) -> None:
        self.is_over = False
        self._rest = bytearray()
        self._found: list[bytes] = []
        self._step: Callable[[], bool] = self._read_head
        self._chunks: _Chunks | None = None
        self._delimiter = b""
        self._length = 0
        self._fields = 0
        self._searched = 0

    def read(self, data: bytes) -> list[bytes]:
        """The pictures that ``data`` completes."""
        self._rest += data if self._chunks is None else self._chunks.read(data)
        while not self.is_over and self._step():
            pass
        self.is_over = self.is_over or (self._chunks is not None and self._chunks.is_over)
        found, self._found = self._found, []
        return found

    def _read_head(self) -> bool:
        end = _blank_line(self._rest)
        if end < 0 or end > MOST_HEAD:
            if len(self._rest) > MOST_HEAD:
                raise BadFrame(f"its answer begins with more than {MOST_HEAD} bytes of fields; is it a camera?")
            return False
        first, *lines = bytes(self._rest[:end]).decode("latin-1").splitlines()
        fields = _fields(lines)
        _check_status(first, fields)
        self._delimiter = _delimiter(fields.get("content-type", ""))
        rest = bytes(self._rest[end:])
        if fields.get("transfer-encoding", "").lower() == "chunked":
            self._chunks = _Chunks()
            rest = self._chunks.read(rest)
        self._rest[:] = rest
        self._step = self._seek
        return True

    def _seek(self) -> bool:
        """Throw away what stands before the next boundary, and that."""
        at = self._rest.find(self._delimiter)
        if at < 0:
            del self._rest[: max(0, len(self._rest) - len(self._delimiter) + 1)]
            return False
        del self._rest[:at]
        after = len(self._delimiter)
        if self._rest[after : after + 2] == b"--":
            self.is_over = True
            return False
        end = self._rest.find(b"\n", after, after + 80)
        if end < 0 and len(self._rest) < after + 80:
            return False
        is_one = end >= 0 and not self._rest[after:end].strip()
        del self._rest[: end + 1 if is_one else after]
        if is_one:
            self._length = self._fields = 0
            self._step = self._read_fields
        return True

    def _read_fields(self) -> bool:
        end = self._rest.find(b"\n", 0, MOST_HEAD)
        if self._fields + (end if end >= 0 else len(self._rest)) > MOST_HEAD:
            raise BadFrame(f"a picture begins with more than {MOST_HEAD} bytes of fields")
        if end < 0:
            return False
        line = bytes(self._rest[:end]).strip()
        del self._rest[: end + 1]
        self._fields += end + 1
        name, _, value = line.partition(b":")
        if name.strip().lower() == b"content-length" and value.strip().isdigit():
            # Of more digits the value does not matter: it is too many in any case.
            self._length = int(value.strip()[:12])
            if self._length > MOST_BYTES:
                raise BadFrame(TOO_LARGE)
        if not line:
            self._searched = 0
            self._step = self._read_sized if self._length else self._read_open
        return True

    def _read_sized(self) -> bool:
        if len(self._rest) < self._length:
            return False
        self._found.append(bytes(self._rest[: self._length]))
        del self._rest[: self._length]
        self._step = self._seek
        return True

    def _read_open(self) -> bool:
        at = self._rest.find(self._delimiter, self._searched)
        if at < 0:
            # What may still turn out to be the line's end and the boundary does not count.
            if len(self._rest) - len(self._delimiter) - 4 > MOST_BYTES:
                raise BadFrame(TOO_LARGE)
            self._searched = max(0, len(self._rest) - len(self._delimiter) + 1)
            return False
        # A line's end stands before the boundary, and the boundary may have more dashes than it was told with.
        picture = bytes(self._rest[:at]).rstrip(b"-").removesuffix(b"\n").removesuffix(b"\r")
        if len(picture) > MOST_BYTES:
            raise BadFrame(TOO_LARGE)
        self._found.append(picture)
        del self._rest[:at]
        self._step = self._seek
        return True


class _Chunks:
    """What is inside of chunks, which may be cut anywhere themselves."""

    def __init__(self) -> None:
        self.is_over = False
        self._rest = b""
        self._left = 0

    def read(self, data: bytes) -> bytes:
        """What ``data`` brings."""
        data, self._rest = self._rest + data, b""
        found = bytearray()
        while data and not self.is_over:
            if self._left:
                found += data[: self._left]
                took = min(self._left, len(data))
                data, self._left = data[took:], self._left - took
                continue
            # The end of the chunk before stands in front of the size of the next.
            line, end, after = data.removeprefix(b"\r").removeprefix(b"\n").partition(b"\n")
            if not end:
                if len(data) > 100:
                    raise BadFrame("its chunks have no size; is it a camera?")
                self._rest = data
                break
            size = line.partition(b";")[0].strip()
            if not 0 < len(size) <= 8 or size.strip(b"0123456789abcdefABCDEF"):
                raise BadFrame(f"a chunk has the size {_shown(size)}; is it a camera?")
            self._left = int(size, 16)
            self.is_over = self._left == 0
            data = after
        return bytes(found)


def answer(kind: str = f"{KIND}; boundary={BOUNDARY}", status: str = "200 OK", is_chunked: bool = False) -> bytes:
    """The head of a camera's answer."""
    lines = [f"HTTP/1.1 {status}", f"Content-Type: {kind}", "Cache-Control: no-store", "Connection: close"]
    if is_chunked:
        lines.append("Transfer-Encoding: chunked")
    return "\r\n".join([*lines, "", ""]).encode()


def part(jpeg: bytes, has_length: bool = True) -> bytes:
    """One picture, behind its boundary."""
    length = f"Content-Length: {len(jpeg)}\r\n" if has_length else ""
    return f"--{BOUNDARY}\r\nContent-Type: image/jpeg\r\n{length}\r\n".encode() + jpeg + b"\r\n"


def chunk(data: bytes) -> bytes:
    """``data`` as one chunk."""
    return b"%x\r\n%b\r\n" % (len(data), data)


def method_of(data: bytes) -> str | None:
    """What the whole request ``data`` wants (``GET``); None while it is not whole."""
    return None if _blank_line(data) < 0 else data.split(b" ", 1)[0].decode("latin-1")


def _blank_line(data: bytes | bytearray) -> int:
    """Where what follows the first blank line begins; -1 without one."""
    ends = [at + len(end) for end in (b"\r\n\r\n", b"\n\n") if (at := data.find(end)) >= 0]
    return min(ends, default=-1)


def _fields(lines: list[str]) -> dict[str, str]:
    pairs = (line.partition(":") for line in lines)
    return {name.strip().lower(): value.strip() for name, _, value in pairs}


def _check_status(line: str, fields: Mapping[str, str]) -> None:
    words = line.split(None, 2)
    if len(words) < 2 or not words[0].startswith("HTTP/") or not (words[1].isdecimal() and len(words[1]) == 3):
        raise BadFrame(f"it does not speak HTTP, it says {_shown(line)}; correct the port of url")
    status = int(words[1])
    if status == 200:
        return
    elsewhere = fields.get("location", "")
    remedy = f"write url = {_shown(elsewhere)}" if elsewhere else _REMEDIES.get(status, "look at it in a browser")
    raise BadFrame(f"it answers {_shown(' '.join(words[1:]))}; {remedy}")


def _delimiter(kind: str) -> bytes:
    name, *parameters = kind.split(";")
    if name.strip().lower() != KIND:
        raise BadFrame(
            f"it sends {_shown(name) or 'nothing that is named'}, and no stream ({KIND}); correct the path of url"
        )
    for parameter in parameters:
        key, _, value = parameter.partition("=")
        if key.strip().lower() == "boundary":
            # Some name the boundary with its dashes, though RFC 2046 has them added.
            boundary = value.strip().strip('"').lstrip("-").strip()
            if 0 < len(boundary) <= 70:
                return b"--" + boundary.encode("latin-1")
    raise BadFrame("its stream names no boundary; is it a camera?")


def _shown(text: str | bytes) -> str:
    """What came over the wire as a log may show it."""
    plain = text.decode("latin-1") if isinstance(text, bytes) else text
    return "".join(char if " " <= char <= "~" else "?" for char in plain.strip()[:60])
