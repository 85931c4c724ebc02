"""Tests of ``standards.websocket``: the vectors of RFC 6455, byte for byte, and what is none."""

from __future__ import annotations

from random import Random

from hypothesis import given, settings
from hypothesis import strategies as st
from twisted.trial.unittest import SynchronousTestCase

from standards.head import MAX_HEAD, Head, head
from standards.websocket import (
    BAD,
    BINARY,
    CLOSE,
    CONTINUATION,
    KEY,
    NORMAL,
    PING,
    PONG,
    TEXT,
    End,
    Nonce,
    accepted,
    framed,
    is_switch,
    is_upgrade,
    masked,
    switch,
)
from tests.standards.rfc6455 import ANSWER, MASK, nonce

settings.register_profile("websocket", derandomize=True, database=None, deadline=None, max_examples=80)
settings.load_profile("websocket")

LONGEST = 1 << 17


class Plain(End):
    """An end that takes everybody; ``ends`` keeps how the other one ended."""

    def __init__(self, nonce: Nonce = nonce, is_client: bool = True, longest: int = LONGEST) -> None:
        super().__init__(nonce, is_client, longest, TEXT, BINARY)
        self.ends: list[bytes | None] = []

    def opening(self) -> bytes:
        """What a client says first."""
        return self._request("/chat", "server.example.com")

    def text(self, payload: bytes) -> bytes:
        """A message as one frame."""
        return self._framed(TEXT, payload)

    def _fault_of_answer(self, answer: Head) -> str:
        return "" if is_switch(answer) and is_upgrade(answer) and self._is_accepted(answer) else "not so"

    def _fault_of_request(self, request: Head) -> str:
        self._put(switch(request.fields.get(KEY, b"")) if is_upgrade(request) else head("HTTP/1.1 400 Bad Request"))
        return "" if is_upgrade(request) else "no upgrade"

    def _last_words(self, goodbye: bytes | None) -> bytes:
        self.ends.append(goodbye)
        return self.closing(BAD) if goodbye is None else b""


def client(longest: int = LONGEST) -> Plain:
    """One that has been greeted."""
    one = Plain(longest=longest)
    one.received(ANSWER)
    return one


class GreetingTests(SynchronousTestCase):
    def test_greets_as_the_rfc_shows(self) -> None:
        """The request has the key of section 1.3, whose answer is the one shown there."""
        said = Plain().opening()
        self.assertEqual(
            said,
            b"GET /chat HTTP/1.1\r\nHost: server.example.com\r\nUpgrade: websocket\r\nConnection: Upgrade\r\n"
            b"Sec-WebSocket-Key: dGhlIHNhbXBsZSBub25jZQ==\r\nSec-WebSocket-Version: 13\r\n\r\n",
        )
        self.assertEqual(accepted(b"dGhlIHNhbXBsZSBub25jZQ=="), b"s3pPLMBiTxaQ9kYGzzhZRbK+xOo=")
        server = Plain(is_client=False)
        self.assertEqual(server.received(said), ([], ANSWER))
        self.assertTrue(server.is_open and client().is_open)

    def test_refused_greetings(self) -> None:
        """What is refused opens nothing and nothing is heard after it; a server says its answer all the same."""
        for answer in (
            b"HTTP/1.1 200 OK\r\n\r\n",
            ANSWER.replace(b"s3p", b"xxx"),
            ANSWER.replace(b"websocket", b"h2c"),
            ANSWER.replace(b"101", b"1010"),
        ):
            one = Plain()
            self.assertEqual(one.received(answer + framed(TEXT, b"x", None)), ([], b""))
            self.assertEqual((one.is_open, one.fault, one.received(ANSWER)), (False, "not so", ([], b"")))
        server = Plain(is_client=False)
        self.assertEqual(server.received(head("GET / HTTP/1.1")), ([], head("HTTP/1.1 400 Bad Request")))
        self.assertFalse(server.is_open)

    def test_endless_greetings(self) -> None:
        """Who never ends its greeting is not listened to for ever."""
        one = Plain()
        one.received(b"x" * (MAX_HEAD - 1))
        self.assertEqual(one.fault, "")
        one.received(b"x")
        self.assertIn("no end", one.fault)


class FrameTests(SynchronousTestCase):
    def test_frames_are_those_of_the_rfc(self) -> None:
        """The examples of section 5.7: unmasked, masked, ping, pong, 256 bytes and 64 KiB."""
        for made, wanted in (
            (framed(TEXT, b"Hello", None), "810548656c6c6f"),
            (framed(TEXT, b"Hello", MASK), "818537fa213d7f9f4d5158"),
            (framed(PING, b"Hello", None), "890548656c6c6f"),
            (framed(PONG, b"Hello", MASK), "8a8537fa213d7f9f4d5158"),
            (framed(BINARY, bytes(256), None)[:4], "827e0100"),
            (framed(BINARY, bytes(65536), None)[:10], "827f0000000000010000"),
            (client().text(b"Hello"), "818537fa213d7f9f4d5158"),
            (client().ping(), "898037fa213d"),
            (client().closing(NORMAL), "888237fa213d3412"),
        ):
            self.assertEqual(made.hex(), wanted)

    def test_joins_fragments(self) -> None:
        """The two fragments of the RFC are one Hello, a ping between them is answered, an empty beginning counts."""
        one = client()
        said = bytes.fromhex("010348656c") + bytes.fromhex("890548656c6c6f") + bytes.fromhex("80026c6f")
        self.assertEqual(one.received(said), ([b"Hello"], bytes.fromhex("8a8537fa213d7f9f4d5158")))
        self.assertEqual(one.received(bytes.fromhex("0100") + bytes.fromhex("800161"))[0], [b"a"])
        self.assertEqual(one.received(framed(PONG, b"", None)), ([], b""))
        self.assertEqual((one.fault, one.frames), ("", 6))

    def test_hears_goodbye(self) -> None:
        """Of a close its owner is told, and nothing is heard after it."""
        one = client()
        answer = one.received(framed(CLOSE, b"\x03\xe8bye", None) + framed(TEXT, b"x", None))
        self.assertEqual((answer, one.ends), (([], b""), [b"\x03\xe8bye"]))
        self.assertIn("goodbye", one.fault)

    def test_refuses_what_the_rfc_forbids(self) -> None:
        """Masks from a server, extensions, unknown opcodes, strange fragments and too much are faults."""
        big = (LONGEST + 1).to_bytes(8, "big")
        for said, reason in (
            (framed(TEXT, b"x", MASK), "masks"),
            (b"\xc1\x01x", "extension"),
            (b"\x83\x00", "opcode 3"),
            (b"\x80\x01x", "beginning"),
            (b"\x01\x01x\x81\x01x", "beginning"),
            (b"\x09\x00", "control"),
            (b"\x89\x7e\x00\x80", "control"),
            (b"\x82\x7f" + big, "more than"),
            (b"\x82\x7f" + b"\xff" * 8, "more than"),
        ):
            one = client()
            self.assertEqual(one.received(said), ([], framed(CLOSE, BAD.to_bytes(2, "big"), MASK)))
            self.assertIn(reason, one.fault)
            self.assertEqual((one.ends, one.received(framed(TEXT, b"x", None))), ([None], ([], b"")))
        many = client()
        part = b"\x7f" + (LONGEST // 2 + 1).to_bytes(8, "big") + bytes(LONGEST // 2 + 1)
        many.received(bytes([TEXT]) + part)
        many.received(bytes([0x80 | CONTINUATION]) + part)
        self.assertIn("more than", many.fault)
        server = Plain(is_client=False)
        server.received(Plain().opening() + framed(TEXT, b"x", None))
        self.assertIn("masks", server.fault)

    def test_short_messages_need_no_long_lengths(self) -> None:
        """Where no message is that long, the length of 64 bits is not waited for."""
        one = client(longest=65535)
        one.received(b"\x82\x7f")
        self.assertIn("more than 65535 bytes", one.fault)
        largest = client(longest=65535)
        self.assertEqual(largest.received(framed(BINARY, bytes(65535), None))[0], [bytes(65535)])

    @given(st.lists(st.binary(max_size=200), max_size=4), st.integers(0, 2**32))
    def test_both_ends_understand_each_other_cut_anyhow(self, said: list[bytes], seed: int) -> None:
        """What one end says the other hears, though each byte arrives alone."""
        near = Plain(Random(seed).randbytes)
        far = Plain(is_client=False)
        heard: list[bytes] = []
        for place in near.opening():
            near.received(far.received(bytes([place]))[1])
        self.assertTrue(near.is_open)
        for payload in said:
            for place in near.text(payload):
                heard += far.received(bytes([place]))[0]
            for place in far.text(payload):
                heard += near.received(bytes([place]))[0]
        self.assertEqual(heard, [payload for payload in said for _ in "ab"])
        self.assertEqual((near.fault, far.fault), ("", ""))

    @given(st.lists(st.binary(max_size=40), max_size=6))
    def test_any_bytes(self, pieces: list[bytes]) -> None:
        """Whatever arrives is messages or a fault, and nothing is raised."""
        for one in (client(), Plain(), Plain(is_client=False)):
            for piece in pieces:
                one.received(piece)
                one.received(b"\r\n\r\n")

    @given(st.binary(max_size=9), st.binary(min_size=4, max_size=4))
    def test_masks_byte_by_byte(self, payload: bytes, mask: bytes) -> None:
        """The mask is laid over each four bytes in turn."""
        self.assertEqual(masked(payload, mask), bytes(byte ^ mask[i % 4] for i, byte in enumerate(payload)))
