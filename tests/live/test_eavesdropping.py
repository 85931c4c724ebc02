"""Tests of attack S11: the data that an eavesdropper can read when a team sends names, positions and messages."""

from __future__ import annotations

import os
import random
import socket
import sys
import time
from collections.abc import Generator
from typing import Any

from twisted.internet import reactor as _reactor
from twisted.internet.defer import Deferred, inlineCallbacks
from twisted.internet.task import deferLater
from twisted.trial.unittest import SkipTest, TestCase

from middleware.admission.membership_file import Membership, MemoryMembership
from middleware.admission.operator import create_operator
from middleware.admission.team import Team
from middleware.entangled.data.memory import MemoryStore
from middleware.entangled.identity import derive_node_id
from middleware.entangled.network.network import Address
from middleware.entangled.network.udp import UdpNetwork
from middleware.entangled.node import EntangledNode
from middleware.entangled.record import hash_key
from sim.namespaces.capture import find_words, parse_datagram

reactor: Any = _reactor
EVERYTHING = 0x0003
BUFFER = 8 << 20
NAMES = [b"rosa-kennel-17", b"hedgehog", b"task/crimson", b"fetch the crimson ball", b"device.message", b"find_value"]
PLACE = b'{"x": 12.345678, "y": -7.891011}'


class EavesdroppingTests(TestCase):
    """Two nodes of a closed team on loopback, and a raw socket that captures all traffic."""

    def setUp(self) -> None:
        """Start the capture before any node starts."""
        try:
            self.ear = socket.socket(socket.AF_PACKET, socket.SOCK_RAW, socket.htons(EVERYTHING))
        except PermissionError as error:
            why = "a raw socket takes root, or CAP_NET_RAW"
            if os.environ.get("SWARM_CI") == "1":
                self.fail(f"SWARM_CI=1, and nothing can be captured: {why}")
            stream = sys.__stderr__ or sys.stderr
            stream.write(f"\n!!!\n!!! THE TEST OF WHAT CAN BE CAPTURED IS SKIPPED: {why}\n!!!\n")
            raise SkipTest(why) from error
        self.addCleanup(self.ear.close)
        self.ear.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, BUFFER)
        self.ear.bind(("lo", 0))
        self.ear.setblocking(False)
        self.papers: list[Membership] = []

    def node(self, paper: Membership, known: list[Address]) -> tuple[EntangledNode, Deferred[None]]:
        """Return a node with this membership, and a Deferred that fires when the node has joined."""
        self.papers.append(paper)
        dice, store = random.SystemRandom(), MemoryStore()
        team = Team(MemoryMembership(paper), store, time.time, dice)
        network = UdpNetwork(reactor, "127.0.0.1", 0)
        node = EntangledNode(
            *(team.identity, team.secret, network, store, reactor, dice), wall=time.time, admission=team.admission
        )
        team.attach(node, reactor)
        node.endpoint.expose("device.message", lambda peer, text: text)
        node.start()
        team.start()

        def end() -> Deferred[Any]:
            team.stop()
            node.stop()
            network.close()
            return network.closed

        self.addCleanup(end)
        return node, node.join(known)

    def heard(self, ports: set[int]) -> list[bytes]:
        """Return the captured datagrams from and to these ports."""
        found: list[bytes] = []
        while True:
            try:
                frame = self.ear.recv(65_535)
            except BlockingIOError:
                return found
            held = parse_datagram(frame)
            if held is not None and {int(end.rpartition(":")[2]) for end in held[:2]} & ports:
                found.append(held[2])

    @inlineCallbacks
    def test_nothing_is_readable(self) -> Generator[Deferred[Any], Any, None]:
        """No name, task, position, message, key, certificate or secret can be read in the captured datagrams."""
        dice = random.SystemRandom()
        signer = create_operator("kennel", dice)
        first = signer.create_membership("hedgehog", ("device", "bootstrap", "gateway"), time.time(), dice)
        second = signer.create_membership(
            "rosa-kennel-17", ("device", "operator"), time.time(), dice, first.secrets[0][1]
        )
        one, _ = self.node(first, [])
        two, joined = self.node(second, [one.contact.address])
        yield joined
        key = hash_key("task/crimson")
        two.watch(key, lambda records: None)
        yield two.put(key, "hedgehog", b"fetch the crimson ball", concern="one")
        yield one.put(key, "task/crimson", PLACE * 300, concern="one")
        yield one.get(key, "fast")
        said = yield two.call(one.contact, "device.message", "rosa-kennel-17 at " + PLACE.decode())
        self.assertIn("rosa", said)
        yield deferLater(reactor, 0.2, lambda: None)
        heard = self.heard({one.contact.address.port, two.contact.address.port})
        whole = b"\0\0\0\0".join(heard)
        self.assertGreater(len(heard), 20)
        self.assertGreater(len(whole), 10_000)
        self.assertEqual(find_words(whole, [*NAMES, PLACE, b"12.345678", b"-7.891011"]), [])
        secret = [first.secrets[0][1], signer.seed, signer.public, key]
        for paper in self.papers:
            public = paper.identity.public
            secret += [paper.seed, public, derive_node_id(public), paper.certificate[:40], paper.certificate[-40:]]
        self.assertEqual([each for each in secret if each in whole or each.hex().encode() in whole], [])
        # The capture works: it contains the team's fingerprint, which a discovery reply contains unencrypted.
        yield two.endpoint.probe(one.contact.address)
        yield deferLater(reactor, 0.1, lambda: None)
        fingerprint = one.endpoint.admission.fingerprint
        self.assertTrue(any(fingerprint in each for each in self.heard({one.contact.address.port})))
