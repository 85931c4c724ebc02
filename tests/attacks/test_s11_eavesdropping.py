"""Attack S11: read names, tasks, positions, messages and keys in the datagrams of a team.

This module searches every byte on the switchboard. ``tests/live/test_eavesdropping.py`` searches real datagrams on
loopback in the same way.
"""

from __future__ import annotations

import base64
from collections.abc import Iterable

from middleware.entangled.identity import derive_node_id
from middleware.entangled.record import hash_key
from tests.attacks.siege import SiegeCase
from tests.middleware.admission.village import Tape, network_of

WORDS = ("rosa-kennel-17", "fetch the crimson ball", "x=12.3456 y=-7.8910", "jumping over the hedge", "hedgehog")
PLACE = b'{"x": 12.345678, "y": -7.891011}'


def forms(secret: bytes) -> set[bytes]:
    """Return the encodings in which a secret could appear in a datagram."""
    return {secret, secret.hex().encode(), base64.b64encode(secret)[:-2], secret[::-1]}


def found(stream: Iterable[bytes], needles: Iterable[bytes]) -> list[bytes]:
    """Return the strings of ``needles`` that occur in any of the datagrams."""
    whole = b"\0\0\0\0".join(stream)
    return [needle for needle in needles if needle in whole]


class EavesdroppingTests(SiegeCase):
    def setUp(self) -> None:
        """Record a join by code, writes, reads, watches and calls."""
        super().setUp()
        self.team = self.village()
        self.tape = Tape()
        self.team.tape = self.tape
        self.tape.tap(network_of(self.team.houses[0]))
        self.dog = self.team.enlist(WORDS[0])
        self.cat = self.team.welcome("hedgehog")
        self.key = hash_key("task")
        self.dog.node.watch(self.key, lambda records: None)
        self.outcome(self.team, self.cat.node.put(self.key, WORDS[4], WORDS[1].encode()))
        self.outcome(self.team, self.dog.node.put(self.key, "place", PLACE * 200))
        self.team.houses[0].node.endpoint.expose("device.message", lambda peer, text: text)
        contact = self.team.contact(self.team.houses[0])
        self.outcome(self.team, self.cat.node.call(contact, "find_value", self.key))
        self.outcome(self.team, self.dog.node.call(contact, "device.message", WORDS[3]))
        self.outcome(self.team, self.dog.node.call(contact, "device.message", WORDS[2]))
        self.heard = [datagram for _, datagram, _ in self.tape.heard]

    def test_nothing_is_readable(self) -> None:
        """No datagram contains a name, task, position or message, in plain text, hexadecimal or base64."""
        self.assertGreater(len(self.heard), 100)
        self.assertGreater(sum(map(len, self.heard)), 50_000)
        needles = set().union(*(forms(word.encode()) for word in (*WORDS, "device.message", "find_value", "place")))
        self.assertEqual(found(self.heard, needles | {PLACE, b"12.345678", b"-7.8910", b"capabilities"}), [])

    def test_nobody_is_told_by_its_key(self) -> None:
        """No datagram contains a public key, node id or record key, so a listener cannot identify the peers."""
        keys = [house.public for house in self.team.houses]
        needles = set().union(*(forms(each) for each in (*keys, *map(derive_node_id, keys), self.key)))
        self.assertEqual(found(self.heard, needles), [])

    def test_no_secret_and_no_pass(self) -> None:
        """No datagram contains the team's secrets, identity seeds, certificates or statements of the operator."""
        secret = self.team.houses[0].team.secret
        seeds = [house.kept.membership.seed for house in self.team.houses]
        shown = [house.kept.membership.certificate for house in self.team.houses]
        packed = self.team.houses[0].team.membership_list.list_packed()
        pieces = [each[place : place + 32] for each in (*shown, *packed) for place in range(0, len(each) - 32, 32)]
        needles = set().union(*(forms(each) for each in (secret, self.team.signer.seed, *seeds)), pieces)
        self.assertEqual(found(self.heard, needles), [])

    def test_the_ear_hears(self) -> None:
        """The search works, because it finds the only unencrypted value: the team's fingerprint in a PROBE_REPLY."""
        self.outcome(self.team, self.dog.node.endpoint.probe(self.team.address(0)))
        heard = [datagram for _, datagram, _ in self.tape.heard]
        fingerprint = self.team.houses[0].team.admission.fingerprint
        self.assertEqual(found(heard, [fingerprint]), [fingerprint])

    def test_the_same_word_looks_different(self) -> None:
        """The ciphertexts of two equal messages share no eight bytes, so a listener cannot see the repetition."""
        contact = self.team.contact(self.team.houses[0])
        start = len(self.tape.heard)
        for _ in range(2):
            self.outcome(self.team, self.dog.node.call(contact, "device.message", WORDS[3]), 0.1)
        sealed = [datagram[13:] for _, datagram, _ in self.tape.heard[start:] if datagram[0] == 0x13]
        pieces: set[bytes] = set()
        for each in sealed:
            mine = {each[place : place + 8] for place in range(len(each) - 7)}
            self.assertFalse(mine & pieces)
            pieces |= mine
