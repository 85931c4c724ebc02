"""Codec of cameras that serve MJPEG over HTTP: ``multipart/x-mixed-replace``, one part per picture.

The only standard is RFC 2046. The reader accepts the variants in use: the boundary may lack its dashes, a part may
have no ``Content-Length`` and end at the next boundary, lines may end with CR LF or LF, and the encoding may be
chunked (as from an ESP32-CAM).
"""

from __future__ import annotations

import base64
from collections.abc import Callable, Mapping

from drivers.errors import BadFrame

MAX_PICTURE_BYTES = 1024 * 1024
"""Maximum size of a picture in bytes."""
MAX_HEADER_BYTES = 8192
"""Maximum size of a header in bytes, of the stream or of one picture."""
TOO_LARGE_ERROR = f"a picture has more than {MAX_PICTURE_BYTES} bytes; set a smaller size in the camera"
CONTENT_TYPE = "multipart/x-mixed-replace"
BOUNDARY = "frame"

_REMEDIES = {
    401: 'it asks for a name and password: write url = "http://NAME:PASSWORD@..."',
    403: 'it asks for a name and password: write url = "http://NAME:PASSWORD@..."',
    404: "correct the path of url",
    503: "it already serves other clients; close them",
}


def encode_request(host: str, path: str, login: str = "") -> bytes:
    """Return the request to ``host`` for the stream at ``path``; ``login`` is ``NAME:PASSWORD``, or empty."""
    lines = [f"GET {path} HTTP/1.1", f"Host: {host}", f"Accept: {CONTENT_TYPE}", "Connection: close"]
    if login:
        lines.append("Authorization: Basic " + base64.b64encode(login.encode()).decode())
    return "\r\n".join([*lines, "", ""]).encode()


class StreamReader:
    """Extracts the pictures from the answer to one request; their content is not checked.

    ``read`` raises ``BadFrame`` with reason and remedy if the answer is not a stream of pictures or becomes invalid;
    the reader cannot be used afterwards. ``is_over`` is true after the regular end of the stream.
    """

    def __init__(self) -> None:
        self.is_over = False
        self._rest = bytearray()
        self._pictures: list[bytes] = []
        self._parse_step: Callable[[], bool] = self._read_head
        self._chunks: _Chunks | None = None
        self._delimiter = b""
        self._length = 0
        self._field_bytes = 0
        self._search_start = 0

    def read(self, data: bytes) -> list[bytes]:
        """Return the pictures that ``data`` completes."""
        self._rest += data if self._chunks is None else self._chunks.read(data)
        while not self.is_over and self._parse_step():
            pass
        self.is_over = self.is_over or (self._chunks is not None and self._chunks.is_over)
        found, self._pictures = self._pictures, []
        return found

    def _read_head(self) -> bool:
        end = _find_blank_line(self._rest)
        if end < 0 or end > MAX_HEADER_BYTES:
            if len(self._rest) > MAX_HEADER_BYTES:
                raise BadFrame(f"its answer begins with more than {MAX_HEADER_BYTES} bytes of fields; is it a camera?")
            return False
        first, *lines = bytes(self._rest[:end]).decode("latin-1").splitlines()
        fields = _parse_fields(lines)
        _check_status(first, fields)
        self._delimiter = _parse_delimiter(fields.get("content-type", ""))
        rest = bytes(self._rest[end:])
        if fields.get("transfer-encoding", "").lower() == "chunked":
            self._chunks = _Chunks()
            rest = self._chunks.read(rest)
        self._rest[:] = rest
        self._parse_step = self._skip_boundary
        return True

    def _skip_boundary(self) -> bool:
        """Discard data up to and including the next boundary."""
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
            self._length = self._field_bytes = 0
            self._parse_step = self._read_fields
        return True

    def _read_fields(self) -> bool:
        end = self._rest.find(b"\n", 0, MAX_HEADER_BYTES)
        if self._field_bytes + (end if end >= 0 else len(self._rest)) > MAX_HEADER_BYTES:
            raise BadFrame(f"a picture begins with more than {MAX_HEADER_BYTES} bytes of fields")
        if end < 0:
            return False
        line = bytes(self._rest[:end]).strip()
        del self._rest[: end + 1]
        self._field_bytes += end + 1
        name, _, value = line.partition(b":")
        if name.strip().lower() == b"content-length" and value.strip().isdigit():
            # Use at most twelve digits, which are enough to exceed the limit.
            self._length = int(value.strip()[:12])
            if self._length > MAX_PICTURE_BYTES:
                raise BadFrame(TOO_LARGE_ERROR)
        if not line:
            self._search_start = 0
            self._parse_step = self._read_sized if self._length else self._read_until_boundary
        return True

    def _read_sized(self) -> bool:
        if len(self._rest) < self._length:
            return False
        self._pictures.append(bytes(self._rest[: self._length]))
        del self._rest[: self._length]
        self._parse_step = self._skip_boundary
        return True

    def _read_until_boundary(self) -> bool:
        at = self._rest.find(self._delimiter, self._search_start)
        if at < 0:
            # The last bytes may be a line end and the start of the boundary, which are not part of the picture.
            if len(self._rest) - len(self._delimiter) - 4 > MAX_PICTURE_BYTES:
                raise BadFrame(TOO_LARGE_ERROR)
            self._search_start = max(0, len(self._rest) - len(self._delimiter) + 1)
            return False
        # A line end precedes the boundary, and the boundary may have more dashes than announced.
        picture = bytes(self._rest[:at]).rstrip(b"-").removesuffix(b"\n").removesuffix(b"\r")
        if len(picture) > MAX_PICTURE_BYTES:
            raise BadFrame(TOO_LARGE_ERROR)
        self._pictures.append(picture)
        del self._rest[:at]
        self._parse_step = self._skip_boundary
        return True


class _Chunks:
    """Decodes chunked transfer encoding."""

    def __init__(self) -> None:
        self.is_over = False
        self._rest = b""
        self._left = 0

    def read(self, data: bytes) -> bytes:
        data, self._rest = self._rest + data, b""
        found = bytearray()
        while data and not self.is_over:
            if self._left:
                found += data[: self._left]
                took = min(self._left, len(data))
                data, self._left = data[took:], self._left - took
                continue
            # The line end of the previous chunk precedes the size of the next.
            line, end, after = data.removeprefix(b"\r").removeprefix(b"\n").partition(b"\n")
            if not end:
                if len(data) > 100:
                    raise BadFrame("the camera sent a chunk that has no size; is it a camera?")
                self._rest = data
                break
            size = line.partition(b";")[0].strip()
            if not 0 < len(size) <= 8 or size.strip(b"0123456789abcdefABCDEF"):
                raise BadFrame(f"a chunk has the size {_make_printable(size)}; is it a camera?")
            self._left = int(size, 16)
            self.is_over = self._left == 0
            data = after
        return bytes(found)


def encode_answer_header(
    kind: str = f"{CONTENT_TYPE}; boundary={BOUNDARY}", status: str = "200 OK", is_chunked: bool = False
) -> bytes:
    """Return the header of a camera's answer."""
    lines = [f"HTTP/1.1 {status}", f"Content-Type: {kind}", "Cache-Control: no-store", "Connection: close"]
    if is_chunked:
        lines.append("Transfer-Encoding: chunked")
    return "\r\n".join([*lines, "", ""]).encode()


def encode_part(jpeg: bytes, has_length: bool = True) -> bytes:
    """Return one picture with its boundary."""
    length = f"Content-Length: {len(jpeg)}\r\n" if has_length else ""
    return f"--{BOUNDARY}\r\nContent-Type: image/jpeg\r\n{length}\r\n".encode() + jpeg + b"\r\n"


def encode_chunk(data: bytes) -> bytes:
    """Return ``data`` as one chunk."""
    return b"%x\r\n%b\r\n" % (len(data), data)


def parse_method(data: bytes) -> str | None:
    """Return the method of the request ``data``; None while the request is incomplete."""
    return None if _find_blank_line(data) < 0 else data.split(b" ", 1)[0].decode("latin-1")


def _find_blank_line(data: bytes | bytearray) -> int:
    """Return the offset after the first blank line; -1 if there is no blank line."""
    ends = [at + len(end) for end in (b"\r\n\r\n", b"\n\n") if (at := data.find(end)) >= 0]
    return min(ends, default=-1)


def _parse_fields(lines: list[str]) -> dict[str, str]:
    pairs = (line.partition(":") for line in lines)
    return {name.strip().lower(): value.strip() for name, _, value in pairs}


def _check_status(line: str, fields: Mapping[str, str]) -> None:
    words = line.split(None, 2)
    if len(words) < 2 or not words[0].startswith("HTTP/") or not (words[1].isdecimal() and len(words[1]) == 3):
        raise BadFrame(f"it does not speak HTTP, it sends {_make_printable(line)}; correct the port of url")
    status = int(words[1])
    if status == 200:
        return
    elsewhere = fields.get("location", "")
    remedy = (
        f"write url = {_make_printable(elsewhere)}" if elsewhere else _REMEDIES.get(status, "look at it in a browser")
    )
    raise BadFrame(f"it answers {_make_printable(' '.join(words[1:]))}; {remedy}")


def _parse_delimiter(kind: str) -> bytes:
    name, *parameters = kind.split(";")
    if name.strip().lower() != CONTENT_TYPE:
        raise BadFrame(
            f"it sends {_make_printable(name) or 'no content type'} instead of a stream ({CONTENT_TYPE}); "
            "correct the path of url"
        )
    for parameter in parameters:
        key, _, value = parameter.partition("=")
        if key.strip().lower() == "boundary":
            # Some cameras include the dashes in the boundary, contrary to RFC 2046.
            boundary = value.strip().strip('"').lstrip("-").strip()
            if 0 < len(boundary) <= 70:
                return b"--" + boundary.encode("latin-1")
    raise BadFrame("its stream names no boundary; is it a camera?")


def _make_printable(text: str | bytes) -> str:
    """Return received text without control characters, for the log."""
    plain = text.decode("latin-1") if isinstance(text, bytes) else text
    return "".join(char if " " <= char <= "~" else "?" for char in plain.strip()[:60])
