"""Tests of ``drivers.rosbridge.websocket``: the vectors of RFC 6455, byte for byte, and what is none."""

from __future__ import annotations

from random import Random

from hypothesis import given, settings
from hypothesis import strategies as st
from twisted.trial.unittest import SynchronousTestCase

from drivers.rosbridge.websocket import (
    BINARY,
    CLOSE,
    CONTINUATION,
    MAX_HEAD,
    MAX_MESSAGE,
    PING,
    PONG,
    TEXT,
    WebSocket,
    accepted,
    framed,
    masked,
)

settings.register_profile("websocket", derandomize=True, database=None, deadline=None, max_examples=80)
settings.load_profile("websocket")

KEY = b"dGhlIHNhbXBsZSBub25jZQ=="
MASK = bytes.fromhex("37fa213d")
ANSWER = (
    b"HTTP/1.1 101 Switching Protocols\r\nUpgrade: websocket\r\nConnection: Upgrade\r\n"
    b"Sec-WebSocket-Accept: s3pPLMBiTxaQ9kYGzzhZRbK+xOo=\r\n\r\n"
)


def nonce(size: int) -> bytes:
    """The nonces of the RFC's examples."""
    return b"the sample nonce" if size == 16 else MASK


def client() -> WebSocket:
    """One that has been greeted."""
    one = WebSocket(nonce, "server.example.com", "/chat")
    one.received(ANSWER)
    return one


class GreetingTests(SynchronousTestCase):
    def test_greets_as_the_rfc_shows(self) -> None:
        """The request has the key of section 1.3, whose answer is the one shown there."""
        said = WebSocket(nonce, "server.example.com", "/chat").opening()
        self.assertEqual(
            said,
            b"GET /chat HTTP/1.1\r\nHost: server.example.com\r\nUpgrade: websocket\r\nConnection: Upgrade\r\n"
            b"Sec-WebSocket-Key: dGhlIHNhbXBsZSBub25jZQ==\r\nSec-WebSocket-Version: 13\r\n\r\n",
        )
        self.assertEqual(accepted(KEY), b"s3pPLMBiTxaQ9kYGzzhZRbK+xOo=")
        server = WebSocket(nonce, is_client=False)
        self.assertEqual(server.received(said), ([], ANSWER))
        self.assertTrue(server.is_open)

    def test_names_what_answers_instead(self) -> None:
        """Another server, a proxy that answers anew and endless noise are faults that say what was met."""
        for said, reason in (
            (b"HTTP/1.1 404 Not Found\r\n\r\n", "404 Not Found"),
            (b"SSH-2.0-OpenSSH_9\r\n\r\n", "SSH-2.0"),
            (b"\r\n\r\n", "no rosbridge"),
            (ANSWER.replace(b"s3p", b"xxx"), "proxy"),
            (ANSWER.replace(b"Upgrade: websocket", b"Upgrade: h2c"), "proxy"),
            (b"x" * (MAX_HEAD + 1), "no end"),
        ):
            one = WebSocket(nonce, "h")
            self.assertEqual(one.received(said), ([], b""))
            self.assertIn(reason, one.fault)
            self.assertFalse(one.is_open)
            self.assertEqual(one.received(ANSWER), ([], b""))

    def test_turns_a_browser_away(self) -> None:
        """A request without the upgrade, or without a key, gets 400."""
        for said in (b"GET / HTTP/1.1\r\nHost: h\r\n\r\n", b"POST / HTTP/1.1\r\nUpgrade: websocket\r\n\r\n"):
            one = WebSocket(nonce, is_client=False)
            self.assertTrue(one.received(said)[1].startswith(b"HTTP/1.1 400"))
            self.assertTrue(one.fault)


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
            (client().closing(), "888237fa213d3412"),
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

    def test_says_goodbye(self) -> None:
        """A close is answered with its code, and nothing is heard after it."""
        one = client()
        answer = one.received(framed(CLOSE, b"\x03\xe8bye", None) + framed(TEXT, b"x", None))
        self.assertEqual(answer, ([], framed(CLOSE, b"\x03\xe8", MASK)))
        self.assertIn("goodbye", one.fault)

    def test_refuses_what_the_rfc_forbids(self) -> None:
        """Masks from a server, extensions, unknown opcodes, strange fragments and too much are faults."""
        big = (MAX_MESSAGE + 1).to_bytes(8, "big")
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
            self.assertEqual(one.received(said)[0], [])
            self.assertIn(reason, one.fault)
        many = client()
        part = b"\x7f" + (MAX_MESSAGE // 2 + 1).to_bytes(8, "big") + bytes(MAX_MESSAGE // 2 + 1)
        many.received(bytes([TEXT]) + part)
        many.received(bytes([0x80 | CONTINUATION]) + part)
        self.assertIn("more than", many.fault)
        server = WebSocket(nonce, is_client=False)
        server.received(WebSocket(nonce, "h").opening() + framed(TEXT, b"x", None))
        self.assertIn("masks", server.fault)

    @given(st.lists(st.binary(max_size=200), max_size=4), st.integers(0, 2**32))
    def test_both_ends_understand_each_other_cut_anyhow(self, said: list[bytes], seed: int) -> None:
        """What one end says the other hears, though each byte arrives alone."""
        near = WebSocket(Random(seed).randbytes, "h")
        far = WebSocket(nonce, is_client=False)
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
        for one in (client(), WebSocket(nonce, "h"), WebSocket(nonce, is_client=False)):
            for piece in pieces:
                one.received(piece)
                one.received(b"\r\n\r\n")

    @given(st.binary(max_size=9), st.binary(min_size=4, max_size=4))
    def test_masks_byte_by_byte(self, payload: bytes, mask: bytes) -> None:
        """The mask is laid over each four bytes in turn."""
        self.assertEqual(masked(payload, mask), bytes(byte ^ mask[i % 4] for i, byte in enumerate(payload)))
