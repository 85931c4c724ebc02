"""Tests of ``docs/reference/wire-protocol.md``: a complete exchange with fixed keys, byte for byte."""

from __future__ import annotations

import json
import random
from pathlib import Path
from typing import Any

from twisted.trial.unittest import SynchronousTestCase

from middleware.entangled.clock import HeapClock
from middleware.entangled.contact import Contact
from middleware.entangled.identity import Identity
from middleware.entangled.network.network import Address
from middleware.entangled.network.switchboard import LinkConditions, Switchboard
from middleware.entangled.wire.endpoint import Endpoint
from middleware.entangled.wire.session import Session
from tests.middleware.gate import Gate

VECTORS = Path(__file__).with_name("vectors") / "exchange.json"
NAMES = {0x11: "INIT", 0x12: "RESP", 0x13: "DATA", 0x14: "DISCOVERY", 0x15: "DISCOVERY_REPLY", 0x16: "COOKIE"}
NAMES |= {0x19: "PROBE", 0x1A: "PROBE_REPLY"}
LARGE = bytes(range(256)) * 6


class Dice(random.Random):
    """A random generator with fixed output: bytes that count up from ``start``, and numbers made of these bytes."""

    def __init__(self, start: int) -> None:
        super().__init__(0)
        self._next = start
        self.secrets: list[str] = []

    def randbytes(self, n: int) -> bytes:
        """Return the next ``n`` bytes."""
        taken = bytes((self._next + place) % 256 for place in range(n))
        self._next = (self._next + 16) % 256
        if n == 32:
            self.secrets.append(taken.hex())
        return taken

    def getrandbits(self, k: int) -> int:
        """Return the next number of ``k`` bits, from little-endian bytes."""
        number: int = int.from_bytes(self.randbytes(8), "little") % (1 << k)
        return number


class ShortPassGate(Gate):
    """An admission check with a short pass."""

    def __init__(self, name: str, seed: int) -> None:
        super().__init__(seed, seed, f"pass of {name}".encode())
        self.max_pass_bytes = 16


def exchange() -> dict[str, Any]:
    """Let ``alice`` and ``bob`` exchange a probe, a handshake and four calls, one of them under load."""
    clock = HeapClock()
    switchboard = Switchboard(clock, random.Random(0), LinkConditions(0.01))
    team = bytes(range(32))
    said: list[dict[str, str]] = []
    plains: list[tuple[bytes, bytes]] = []
    seal = Session.seal

    def noted(session: Session, message: bytes) -> bytes:
        datagram = seal(session, message)
        plains.append((datagram, message))
        return datagram

    ends, dice = {}, {}
    for name, seed, port in (("alice", 0x11, 1), ("bob", 0x22, 2)):
        network = switchboard.make_network("10.0.0.1", port)
        identity = Identity(bytes([seed]) * 32)
        send = network.send

        def heard(datagram: bytes, to: Address, name: str = name, send: Any = send) -> None:
            said.append({"from": name, "kind": NAMES[datagram[0]], "datagram": datagram.hex()})
            send(datagram, to)

        dice[name] = Dice(seed)
        network.send = heard  # type: ignore[method-assign]
        end = Endpoint(identity, team, network, clock, dice[name], ShortPassGate(name, seed))
        ends[name] = end, Contact(identity.public, network.address)
        ends[name][0].start()
    (alice, _), (bob, to_bob) = ends["alice"], ends["bob"]
    bob.expose("echo", lambda peer, value: value, early=True)
    bob.expose("add", lambda peer, one, two: one + two, changes=True)
    Session.seal = noted  # type: ignore[method-assign, assignment]
    try:
        bob.probe_responder.unix_time = lambda: 1_700_000_000.0
        alice.probe(to_bob.address)
        clock.advance(1)
        alice.discover(to_bob.address)
        clock.advance(1)
        bob._cookies._limit._tokens = -1000.0
        for method, arguments, changes in (("echo", (1,), False), ("add", (2, 3), True), ("echo", (LARGE,), False)):
            alice.ask(to_bob, method, *arguments, changes=changes)
            clock.advance(1)
        alice.ask(to_bob, "nothing").addErrback(lambda failure: None)
        clock.advance(1)
    finally:
        Session.seal = seal  # type: ignore[method-assign]
    for one in said:
        for datagram, message in plains:
            if datagram.hex() == one["datagram"]:
                one["inside"] = message.hex()
    return {
        "team_key": team.hex(),
        "alice_seed": "11" * 32,
        "bob_seed": "22" * 32,
        "alice_public": ends["alice"][1].public.hex(),
        "bob_public": to_bob.public.hex(),
        "alice_pass": b"pass of alice".hex(),
        "bob_pass": b"pass of bob".hex(),
        "room": 16,
        "alice_ephemeral": dice["alice"].secrets[0],
        "bob_ephemeral": dice["bob"].secrets[-1],
        "datagrams": said,
    }


class ProtocolTests(SynchronousTestCase):
    """The test vectors."""

    def test_whole_exchange(self) -> None:
        """Fixed keys and a fixed random generator give exactly the datagrams of the vectors."""
        self.assertEqual(exchange(), json.loads(VECTORS.read_text(encoding="utf-8")))

    def test_every_kind_is_there(self) -> None:
        """The vectors contain every kind of datagram, and fragments and acknowledgements in both directions."""
        said = json.loads(VECTORS.read_text(encoding="utf-8"))["datagrams"]
        self.assertEqual({one["kind"] for one in said}, set(NAMES.values()))
        messages = {(one["from"], one["inside"][:2]) for one in said if one["kind"] == "DATA"}
        self.assertLessEqual({("alice", "01"), ("alice", "02"), ("bob", "01"), ("bob", "02")}, messages)
