"""Tests of ``formats.websocket``: the limits around ``wsproto``."""

from __future__ import annotations

from hypothesis import given
from hypothesis import strategies as st
from twisted.trial.unittest import SynchronousTestCase
from wsproto.events import AcceptConnection, RejectConnection, Request

from formats.head import MAX_HEAD_BYTES
from formats.websocket import MAX_FRAMES, WebSocketEnd
from tests.formats.rfc6455 import BINARY, CLOSE, CONTINUATION, MASK, PING, PONG, TEXT, answer_to, framed

LONGEST = 1 << 17


class Plain(WebSocketEnd):
    """An endpoint that accepts every handshake."""

    def __init__(self, is_client: bool = True) -> None:
        super().__init__(LONGEST, Request("server.example.com", "/chat") if is_client else None)

    def _make_response(self, request: Request) -> AcceptConnection | RejectConnection:
        return AcceptConnection()

    def _find_error(self, answer: AcceptConnection | RejectConnection | Exception) -> str:
        return "" if isinstance(answer, AcceptConnection) else "not so"


def client() -> Plain:
    """Return a client after its handshake."""
    one = Plain()
    one.receive_data(answer_to(one.opening()))
    assert one.is_open
    return one


class GreetingTests(SynchronousTestCase):
    def test_refused_greetings(self) -> None:
        """After a rejected handshake no connection is open and no data is read; a server replies with HTTP 400."""
        for old, new in ((b"101 Switching", b"200 OK"), (b"Accept: ", b"Accept: x"), (b"e: websocket", b"e: h2c")):
            one = Plain()
            answer = answer_to(one.opening())
            self.assertEqual(one.receive_data(answer.replace(old, new) + framed(TEXT, b"x", None)), ([], b""))
            self.assertEqual((one.is_open, one.fault, one.receive_data(answer)), (False, "not so", ([], b"")))
        for request in (b"GET / HTTP/1.1\r\nHost: h\r\n\r\n", b"GET / HTTP/1.1\r\nHost: \xff\r\n\r\n", b"SSH\r\n\r\n"):
            server = Plain(is_client=False)
            self.assertTrue(server.receive_data(request)[1].startswith(b"HTTP/1.1 400"), request)
            self.assertTrue(server.fault and not server.is_open)

    def test_endless_greetings(self) -> None:
        """A handshake that does not end is rejected at the maximum size."""
        one = Plain(is_client=False)
        one.receive_data(b"GET /" + b"x" * (MAX_HEAD_BYTES - 6))
        self.assertEqual(one.fault, "")
        one.receive_data(b"x")
        self.assertIn("longer than", one.fault)


class FrameTests(SynchronousTestCase):
    def test_joins_fragments(self) -> None:
        """The two fragments in the RFC's example give one Hello; a ping between the fragments gets a pong."""
        one = client()
        said = bytes.fromhex("010348656c") + bytes.fromhex("890548656c6c6f") + bytes.fromhex("80026c6f")
        messages, reply = one.receive_data(said)
        self.assertEqual((messages, reply[0] & 0x0F), ([b"Hello"], PONG))
        self.assertEqual(one.receive_data(bytes.fromhex("0100") + bytes.fromhex("800161"))[0], [b"a"])
        self.assertEqual(one.receive_data(framed(PONG, b"", None)), ([], b""))
        self.assertEqual((one.fault, one.frames), ("", 6))

    def test_answers_a_close(self) -> None:
        """The endpoint replies to a close once; after it, nothing is received or sent."""
        one = client()
        messages, reply = one.receive_data(framed(CLOSE, b"\x03\xe8bye", None) + framed(TEXT, b"x", None))
        self.assertEqual((messages, reply[0] & 0x0F), ([], CLOSE))
        self.assertIn("closed the connection", one.fault)
        self.assertEqual((one.encode_close(), one.encode_ping(), one.encode_text(b"x")), (b"", b"", b""))

    def test_refuses_what_the_rfc_forbids(self) -> None:
        """Masked frames from a server, extensions, unknown opcodes, bad fragments and excessive sizes are faults."""
        part = b"\x7f" + (LONGEST // 2 + 1).to_bytes(8, "big") + bytes(LONGEST // 2 + 1)
        for said in (
            framed(TEXT, b"x", MASK),
            b"\xc1\x01x",
            b"\x83\x00",
            b"\x80\x01x",
            b"\x01\x01x\x81\x01x",
            b"\x09\x00",
            b"\x89\x7e\x00\x80",
            b"\x82\x7f" + (2**62).to_bytes(8, "big") + bytes(LONGEST + 1),
            b"\x82\x7f" + b"\xff" * 8,
            bytes([BINARY]) + part + bytes([0x80 | CONTINUATION]) + part,
        ):
            one = client()
            messages, reply = one.receive_data(said)
            self.assertEqual((messages, reply[0] & 0x0F), ([], CLOSE), said[:20])
            self.assertTrue(one.fault)
            self.assertEqual(one.receive_data(framed(TEXT, b"x", None)), ([], b""))

    def test_counts_frames(self) -> None:
        """The number of frames in one read is limited; the next read has the same limit."""
        one = client()
        for _ in range(2):
            self.assertEqual(len(one.receive_data(framed(TEXT, b"", None) * MAX_FRAMES)[0]), MAX_FRAMES)
        one.receive_data(framed(PING, b"", None) * (MAX_FRAMES + 1))
        self.assertIn("frames", one.fault)

    @given(st.lists(st.binary(max_size=200), max_size=4))
    def test_both_ends_understand_each_other_cut_anyhow(self, said: list[bytes]) -> None:
        """Each end decodes the messages of the other end, even if every byte arrives separately."""
        near, far = Plain(), Plain(is_client=False)
        heard: list[bytes] = []
        for place in near.opening():
            near.receive_data(far.receive_data(bytes([place]))[1])
        self.assertTrue(near.is_open)
        for payload in said:
            for place in near.encode_binary(payload):
                heard += far.receive_data(bytes([place]))[0]
            for place in far.encode_binary(payload):
                heard += near.receive_data(bytes([place]))[0]
        self.assertEqual(heard, [payload for payload in said for _ in "ab"])
        self.assertEqual((near.fault, far.fault), ("", ""))

    @given(st.lists(st.binary(max_size=40), max_size=6))
    def test_any_bytes(self, pieces: list[bytes]) -> None:
        """Any bytes give messages or a fault, and raise no exception."""
        for one in (client(), Plain(), Plain(is_client=False)):
            one.opening()
            for piece in pieces:
                one.receive_data(piece)
                one.receive_data(b"\r\n\r\n")
