"""Tests of ``drivers.camera.codec`` with streams of real cameras (whole, split and with errors) and random bytes."""

from __future__ import annotations

import base64

from hypothesis import given, settings
from hypothesis import strategies as st
from twisted.trial.unittest import SynchronousTestCase

from drivers.camera import codec
from drivers.camera.codec import StreamReader, encode_answer_header, encode_chunk, encode_part
from drivers.errors import BadFrame

FIRST, SECOND = b"\xff\xd8one\r\n--fram\xff\xd9", b"\xff\xd8two--\n\xff\xd9"

# The format of the camera server in Espressif's examples: each part is a separate HTTP chunk.
ESP32 = (
    b"HTTP/1.1 200 OK\r\nContent-Type: multipart/x-mixed-replace;boundary=123456789000000000000987654321\r\n"
    b"Transfer-Encoding: chunked\r\nAccess-Control-Allow-Origin: *\r\n\r\n"
    + b"".join(
        encode_chunk(piece)
        for picture in (FIRST, SECOND)
        for piece in (
            b"\r\n--123456789000000000000987654321\r\n",
            b"Content-Type: image/jpeg\r\nContent-Length: %d\r\nX-Timestamp: 12.345678\r\n\r\n" % len(picture),
            picture,
        )
    )
    + b"0\r\n\r\n"
)
# The format of mjpg-streamer: HTTP/1.0, and each part has a Content-Length.
STREAMER = b"HTTP/1.0 200 OK\r\nContent-Type: multipart/x-mixed-replace;boundary=boundarydonotcross\r\n\r\n" + b"".join(
    b"--boundarydonotcross\r\nContent-Type: image/jpeg\r\nContent-Length: %d\r\n\r\n" % len(picture) + picture + b"\r\n"
    for picture in (FIRST, SECOND)
)
# A quoted boundary that includes its dashes, lines that end with LF, no lengths, and an end.
PLAIN = (
    b'HTTP/1.1 200 Fine\nServer: x\ncontent-type: Multipart/X-Mixed-Replace; a=b; Boundary="--cut"\n\n'
    b"\n--cut\ncontent-type: image/jpeg\n\n" + FIRST + b"\n--cut \n\n" + SECOND + b"\n--cut--\n"
)
# The same stream with the dashes of RFC 2046 in front of the boundary's own dashes.
DOUBLE = (
    b"HTTP/1.1 200 OK\r\nContent-Type: multipart/x-mixed-replace; boundary=--cut\r\n\r\npreamble\r\n"
    b"----cut\r\n\r\n" + FIRST + b"\r\n----cut\r\n\r\n" + SECOND + b"\r\n----cut--\r\n"
)
STREAMS = {"esp32": ESP32, "streamer": STREAMER, "plain": PLAIN, "double": DOUBLE}


def read(data: bytes, size: int = 0) -> tuple[list[bytes], StreamReader]:
    """Read ``data`` in pieces of ``size`` bytes; return the pictures and the reader."""
    reader, found = StreamReader(), list[bytes]()
    for place in range(0, len(data), size or len(data)):
        found += reader.read(data[place : place + (size or len(data))])
    return found, reader


class StreamReaderTests(SynchronousTestCase):
    def test_reads_what_cameras_send(self) -> None:
        """The pictures in each stream format are read however the stream is split into chunks."""
        for name, data in STREAMS.items():
            for size in (0, 1, 2, 3, 7, 64):
                found, reader = read(data, size)
                self.assertEqual(found, [FIRST, SECOND], (name, size))
                self.assertEqual(reader.is_over, name != "streamer", (name, size))
                self.assertEqual(read(data + b"anything", size)[0], [FIRST, SECOND])

    def test_reads_what_the_emulator_says(self) -> None:
        """Streams written by the emulator are read, with and without lengths, chunked or not."""
        for is_chunked in (False, True):
            for has_length in (False, True):
                said = [encode_part(picture, has_length) for picture in (FIRST, SECOND, FIRST)]
                data = encode_answer_header(is_chunked=is_chunked) + b"".join(
                    map(encode_chunk, said) if is_chunked else said
                )
                # Without a length a picture ends at the start of the next one.
                self.assertEqual(read(data, 5)[0], [FIRST, SECOND, FIRST][: 3 if has_length else 2])

    def test_finds_its_way_back(self) -> None:
        """A wrong length or a false boundary damages at most two pictures; the following pictures are read."""
        short = b"--frame\r\nContent-Length: 3\r\n\r\n" + FIRST
        strange = b"--frames of a film\r\n--frame" + bytes(90) + b"\r\nContent-Length: x\r\n"
        found, _ = read(
            encode_answer_header() + short + b"\r\n" + strange + encode_part(SECOND) + encode_part(FIRST), 1
        )
        self.assertEqual(found, [FIRST[:3], SECOND, FIRST])
        self.assertEqual(
            read(encode_answer_header() + b"--frame\r\nContent-Length: none\r\n\r\n" + FIRST + b"\r\n--frame")[0],
            [FIRST],
        )

    def test_names_what_is_no_stream(self) -> None:
        """A response that is not a picture stream is refused; the one-line error states the cause or the remedy."""
        ok = b"HTTP/1.1 200 OK\r\n"
        for data, word in (
            (b"HTTP/1.1 401 Unauthorized\r\n\r\n", "NAME:PASSWORD"),
            (b"HTTP/1.1 403 Forbidden\r\n\r\n", "NAME:PASSWORD"),
            (b"HTTP/1.1 404 Not Found\r\n\r\n", "path"),
            (b"HTTP/1.1 503 Busy\r\n\r\n", "other clients"),
            (b"HTTP/1.1 500 \x00\x1b[1mOops\r\n\r\n", "500 ??[1mOops; look"),
            (b"HTTP/1.1 302 Found\r\nLocation: http://a/b\r\n\r\n", "url = http://a/b"),
            (b"SSH-2.0-OpenSSH\r\n\r\n", "SSH-2.0-OpenSSH"),
            (b"HTTP/1.1 2000 OK\r\n\r\n", "HTTP"),
            (b"HTTP/1.1 abc\r\n\r\n", "HTTP"),
            (b"\r\n\r\n", "HTTP"),
            (ok + b"Content-Type: text/html\r\n\r\n", "text/html"),
            (ok + b"\r\n", "no content type"),
            (ok + b"Content-Type: multipart/x-mixed-replace\r\n\r\n", "boundary"),
            (ok + b'Content-Type: multipart/x-mixed-replace; boundary="--"\r\n\r\n', "boundary"),
            (ok + b"Content-Type: multipart/x-mixed-replace; boundary=" + b"b" * 71 + b"\r\n\r\n", "boundary"),
            (b"x" * (codec.MAX_HEADER_BYTES + 1), "fields"),
            (ok + b"A: " + b"x" * codec.MAX_HEADER_BYTES + b"\r\n\r\n", "fields"),
            (encode_answer_header() + b"--frame\r\n" + b"A: b\r\n" * 2000, "fields"),
            (encode_answer_header() + b"--frame\r\n" + b"A" * 9000, "fields"),
            (encode_answer_header(is_chunked=True) + b"five\r\n", "chunk"),
            (encode_answer_header(is_chunked=True) + b"\n\n", "chunk"),
            (encode_answer_header(is_chunked=True) + b"x" * 101, "chunk"),
            (encode_answer_header() + b"--frame\r\nContent-Length: 1048577\r\n\r\n", "more than 1048576 bytes"),
            (
                encode_answer_header() + b"--frame\r\nContent-Length: %s\r\n\r\n" % (b"9" * 5000),
                "more than 1048576 bytes",
            ),
            (
                encode_answer_header() + b"--frame\r\n\r\n" + bytes(codec.MAX_PICTURE_BYTES + 100),
                "more than 1048576 bytes",
            ),
            (
                encode_answer_header() + b"--frame\r\n\r\n" + bytes(codec.MAX_PICTURE_BYTES + 1) + b"\r\n--frame\r\n",
                "more than 1048576 bytes",
            ),
        ):
            for size in (0, 1) if len(data) < 20_000 else (0, 50_000):
                line = str(self.assertRaises(BadFrame, read, data, size))
                self.assertIn(word, line)
                self.assertTrue(line.isprintable() and len(line) < 200, line)

    def test_takes_the_largest(self) -> None:
        """A picture of exactly 1 MiB is accepted, with and without a Content-Length."""
        large = bytes(codec.MAX_PICTURE_BYTES)
        for has_length in (True, False):
            data = encode_answer_header() + encode_part(large, has_length) + b"--frame"
            self.assertEqual(read(data, 40_000)[0], [large])

    def test_keeps_no_more_than_it_needs(self) -> None:
        """Data between pictures is discarded on arrival."""
        reader = StreamReader()
        reader.read(encode_answer_header())
        for _ in range(100):
            self.assertEqual(reader.read(bytes(10_000)), [])
        self.assertLess(len(reader._rest), 20)
        self.assertEqual(reader.read(encode_part(FIRST)), [FIRST])

    @settings(max_examples=300)
    @given(st.lists(st.binary(max_size=60), max_size=6), st.booleans(), st.integers(1, 80))
    def test_any_bytes_as_a_stream(self, pieces: list[bytes], is_chunked: bool, size: int) -> None:
        """Random bytes after a header give pictures, nothing or BadFrame, but no other exception."""
        data = encode_answer_header(is_chunked=is_chunked) + b"\r\n--frame\r\n".join(pieces)
        try:
            found, _ = read(data, size)
        except BadFrame:
            return
        self.assertTrue(all(len(one) <= len(data) for one in found))

    @settings(max_examples=300)
    @given(st.sampled_from(sorted(STREAMS)), st.data())
    def test_spoilt_streams(self, name: str, data: st.DataObject) -> None:
        """A stream with changed or missing bytes gives the same result whether it arrives whole or byte by byte."""
        stream = bytearray(STREAMS[name])
        for _ in range(data.draw(st.integers(1, 4))):
            place = data.draw(st.integers(0, len(stream) - 1))
            stream[place : place + data.draw(st.integers(0, 3))] = data.draw(st.binary(max_size=2))
        outcomes = []
        for size in (0, 1):
            try:
                outcomes.append(read(bytes(stream), size)[0])
            except BadFrame as error:
                outcomes.append([str(error).encode()])
        self.assertEqual(*outcomes)


class RequestTests(SynchronousTestCase):
    def test_asks(self) -> None:
        """The request contains host and path, and credentials only if they are configured."""
        plain = codec.encode_request("cam:81", "/stream?a=1")
        self.assertTrue(plain.startswith(b"GET /stream?a=1 HTTP/1.1\r\nHost: cam:81\r\n"))
        self.assertTrue(plain.endswith(b"\r\n\r\n"))
        self.assertNotIn(b"Authorization", plain)
        login = base64.b64encode(b"anna:s p")
        self.assertIn(b"\r\nAuthorization: Basic " + login + b"\r\n", codec.encode_request("cam", "/", "anna:s p"))
