"""Differential tests of ``noise`` and an independent implementation (noiseprotocol), which must give the same bytes."""

from __future__ import annotations

import random
from typing import Any

from noise.connection import Keypair, NoiseConnection
from twisted.trial import util
from twisted.trial.unittest import SynchronousTestCase

from middleware.entangled.wire.noise import (
    Initiator,
    KeyPair,
    Responder,
    TransportKeys,
    make_key_pair,
    open_sealed,
    seal,
)

RUNS = 100
"""The number of runs for each protocol in each role; the run number is also the seed."""
MESSAGES = 4
MAX_PAYLOAD = 1200


class Run:
    """The keys and payloads of one run, generated from a seed."""

    def __init__(self, seed: int, has_psk: bool) -> None:
        rng = random.Random(seed)
        self.statics = [make_key_pair(rng.randbytes(32)) for _ in range(2)]
        self.ephemerals = [rng.randbytes(32) for _ in range(2)]
        self.prologue = rng.randbytes(rng.randrange(40))
        self.psk = rng.randbytes(32) if has_psk else None
        self.payloads = [rng.randbytes(rng.randrange(MAX_PAYLOAD)) for _ in range(2 + MESSAGES)]

    @property
    def initiator(self) -> KeyPair:
        """The static keys of the initiator."""
        return self.statics[0]

    @property
    def responder(self) -> KeyPair:
        """The static keys of the responder."""
        return self.statics[1]

    def other(self, is_initiator: bool) -> Any:
        """Return the initiator or responder of the reference implementation."""
        name = b"Noise_IKpsk1_25519_ChaChaPoly_BLAKE2s" if self.psk else b"Noise_IK_25519_ChaChaPoly_BLAKE2s"
        side = NoiseConnection.from_name(name)
        own = 0 if is_initiator else 1
        if is_initiator:
            side.set_as_initiator()
            side.set_keypair_from_public_bytes(Keypair.REMOTE_STATIC, self.responder.public)
        else:
            side.set_as_responder()
        side.set_prologue(self.prologue)
        side.set_keypair_from_private_bytes(Keypair.STATIC, self.statics[own].secret)
        side.set_keypair_from_private_bytes(Keypair.EPHEMERAL, self.ephemerals[own])
        if self.psk:
            side.set_psks(self.psk)
        side.start_handshake()
        return side


class DifferentialTests(SynchronousTestCase):
    """Tests of each side of a handshake, with the reference implementation as the other side."""

    suppress = (util.suppress(message="One of ephemeral keypairs"),)  # a fixed value gives equal bytes on both sides

    def check_transport(self, run: Run, keys: TransportKeys, other: Any) -> None:
        """Check that both sides have the same handshake hash and can decrypt each other's messages."""
        self.assertEqual(keys.handshake_hash, other.get_handshake_hash())
        for counter, payload in enumerate(run.payloads[2:]):
            self.assertEqual(other.decrypt(seal(keys.sending, counter, payload, b"")), payload)
            self.assertEqual(open_sealed(keys.receiving, counter, other.encrypt(payload), b""), payload)

    def initiate(self, run: Run) -> None:
        """Run the initiator of this project with the reference responder."""
        ours = Initiator(run.initiator, run.responder.public, run.ephemerals[0], run.prologue, run.psk)
        twin, other = run.other(True), run.other(False)
        first = ours.write(run.payloads[0])
        self.assertEqual(first, bytes(twin.write_message(run.payloads[0])))
        self.assertEqual(other.read_message(first), run.payloads[0])
        payload, keys = ours.read(bytes(other.write_message(run.payloads[1])))
        self.assertEqual(payload, run.payloads[1])
        self.check_transport(run, keys, other)

    def respond(self, run: Run) -> None:
        """Run the responder of this project with the reference initiator."""
        ours = Responder(run.responder, run.ephemerals[1], run.prologue, run.psk)
        twin, other = run.other(False), run.other(True)
        first = bytes(other.write_message(run.payloads[0]))
        self.assertEqual(ours.read(first), (run.payloads[0], run.initiator.public))
        second, keys = ours.write(run.payloads[1])
        twin.read_message(first)
        self.assertEqual(second, bytes(twin.write_message(run.payloads[1])))
        self.assertEqual(other.read_message(second), run.payloads[1])
        self.check_transport(run, keys, other)

    def test_initiator(self) -> None:
        """The initiator sends the same bytes as the reference initiator, and agrees with the reference responder."""
        for seed in range(RUNS):
            for has_psk in (False, True):
                self.initiate(Run(seed, has_psk))

    def test_responder(self) -> None:
        """The responder sends the same bytes as the reference responder, and agrees with the reference initiator."""
        for seed in range(RUNS):
            for has_psk in (False, True):
                self.respond(Run(seed, has_psk))
