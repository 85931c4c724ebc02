"""Tests of the Noise handshake against published vectors."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from twisted.trial.unittest import SynchronousTestCase

from middleware.entangled.errors import Forged
from middleware.entangled.wire.noise import Initiator, Responder, make_key_pair, open_sealed, seal

VECTORS = Path(__file__).with_name("vectors") / "noise.json"


def _sides(vector: dict[str, Any], psk: bytes | None) -> tuple[Initiator, Responder]:
    def field(name: str) -> bytes:
        return bytes.fromhex(vector[name])

    initiator = Initiator(
        make_key_pair(field("init_static")),
        field("init_remote_static"),
        field("init_ephemeral"),
        field("init_prologue"),
        psk,
    )
    responder = Responder(make_key_pair(field("resp_static")), field("resp_ephemeral"), field("resp_prologue"), psk)
    return initiator, responder


class NoiseTests(SynchronousTestCase):
    """Tests of ``Initiator`` and ``Responder``."""

    def setUp(self) -> None:
        """Load the test vectors."""
        self.vectors = json.loads(VECTORS.read_text())["vectors"]

    def _psk(self, vector: dict[str, Any]) -> bytes | None:
        return bytes.fromhex(vector["init_psks"][0]) if "init_psks" in vector else None

    def test_published_vectors(self) -> None:
        """Both handshakes and their transport messages match the published vectors byte for byte."""
        self.assertEqual(len(self.vectors), 2)
        for vector in self.vectors:
            initiator, responder = _sides(vector, self._psk(vector))
            payloads = [bytes.fromhex(message["payload"]) for message in vector["messages"]]
            expected = [bytes.fromhex(message["ciphertext"]) for message in vector["messages"]]
            first = initiator.write(payloads[0])
            self.assertEqual(first, expected[0])
            payload, static = responder.read(first)
            self.assertEqual(
                (payload, static), (payloads[0], make_key_pair(bytes.fromhex(vector["init_static"])).public)
            )
            second, theirs = responder.write(payloads[1])
            self.assertEqual(second, expected[1])
            payload, ours = initiator.read(second)
            self.assertEqual(payload, payloads[1])
            self.assertEqual(ours.handshake_hash.hex(), vector["handshake_hash"])
            self.assertEqual((ours.sending, ours.receiving), (theirs.receiving, theirs.sending))
            for number, (payload, ciphertext) in enumerate(zip(payloads[2:], expected[2:], strict=True)):
                key = ours.sending if number % 2 == 0 else theirs.sending
                self.assertEqual(seal(key, number // 2, payload, b""), ciphertext)
                self.assertEqual(open_sealed(key, number // 2, ciphertext, b""), payload)

    def test_wrong_psk_opens_nothing(self) -> None:
        """A responder with another pre-shared key cannot decrypt the first payload."""
        vector = next(vector for vector in self.vectors if "init_psks" in vector)
        initiator, _ = _sides(vector, self._psk(vector))
        _, stranger = _sides(vector, bytes(32))
        self.assertRaises(Forged, stranger.read, initiator.write(b"secret"))

    def test_every_flipped_byte_is_noticed(self) -> None:
        """If any byte of a handshake message is flipped, both sides reject the message."""
        vector = self.vectors[1]
        initiator, responder = _sides(vector, self._psk(vector))
        first = initiator.write(b"hello")
        responder.read(first)
        second, _ = responder.write(b"there")
        for place in range(len(first)):
            damaged = bytearray(first)
            damaged[place] ^= 1
            _, fresh = _sides(vector, self._psk(vector))
            self.assertRaises(Forged, fresh.read, bytes(damaged))
        for place in range(len(second)):
            damaged = bytearray(second)
            damaged[place] ^= 1
            self.assertRaises(Forged, initiator.copy().read, bytes(damaged))

    def test_short_and_weak_messages(self) -> None:
        """A truncated message, and a key of small order, raise ``Forged``."""
        vector = self.vectors[1]
        initiator, responder = _sides(vector, self._psk(vector))
        self.assertRaises(Forged, responder.copy().read, bytes(95))
        self.assertRaises(Forged, responder.copy().read, bytes(200))
        self.assertRaises(Forged, initiator.read, bytes(47))
