"""Tests of ``middleware.entangled.network.tunnel_connections``, tunnels over several connections, in virtual time."""

from __future__ import annotations

import random

from middleware.entangled.network.memory_streams import Pipe
from middleware.entangled.network.network import Address
from middleware.entangled.network.tunnel import MAX_PER_HOST, MAX_TOTAL_CONNECTIONS, TunnelNetwork
from middleware.entangled.network.tunnel_connections import (
    COPIES,
    DIAL_NEXT_S,
    LOSSY_RETRANSMISSIONS,
    MAX_CONNECTIONS,
    MAX_STALLED_BYTES,
    REDUNDANCY_S,
    REPLACE_STALLED_S,
    STALLED_S,
)
from middleware.entangled.network.websocket import TOKEN_HEADER
from tests.middleware.test_tunnel import GREETING, HOST, PLAIN, URL, Heard, TunnelCase

STEP = 0.1
WHOLE = GREETING.replace(b"\r\n\r\n", b"\r\n" + TOKEN_HEADER.encode() + b": %s\r\n\r\n")


class TunnelConnectionsTests(TunnelCase):
    def talk(self, client: TunnelNetwork, served: Heard, seconds: float, size: int = 100) -> tuple[list[float], float]:
        """Send ten datagrams per second; return the number of copies per arrived datagram, and the longest gap."""
        number, last, gap = 0, self.clock.seconds(), 0.0
        served.clear()
        seen: dict[bytes, int] = {}
        while number * STEP < seconds:
            number += 1
            client.send(number.to_bytes(4, "big") + bytes(size), PLAIN.address)
            self.clock.advance(STEP)
            for datagram, _ in served:
                if datagram not in seen:
                    gap, last = max(gap, self.clock.seconds() - last), self.clock.seconds()
                seen[datagram] = seen.get(datagram, 0) + 1
            served.clear()
        return [float(times) for times in seen.values()], max(gap, self.clock.seconds() - last)

    def three(self) -> tuple[TunnelNetwork, Heard, TunnelNetwork, Heard, Pipe]:
        """Return two ends of a tunnel with three connections, and the first connection, which has stalled."""
        client, came, server, served = self.pair()
        (first,) = self.pipes.streams
        first.is_stalled = True
        self.talk(client, served, 1.0)
        first.is_stalled = False
        self.talk(client, served, 0.5)
        came.clear()
        served.clear()
        self.assertEqual(len(self.pipes.streams), MAX_CONNECTIONS)
        return client, came, server, served, first

    def test_one_while_all_is_well(self) -> None:
        """On a link with delay but no loss a tunnel uses one connection, and sends each datagram once."""
        client, _, _, served = self.pair()
        self.pipes.delay_s = 0.4
        self.talk(client, served, 1.0)
        times, gap = self.talk(client, served, 60.0, 1000)
        self.clock.advance(30.0)
        self.assertEqual(set(times), {1.0})
        self.assertLess(gap, 2 * STEP)
        self.assertEqual((len(self.pipes.dialled), len(self.pipes.streams)), (1, 1))
        (only,) = self.pipes.streams
        for _ in range(5):  # a short wait for one retransmission after an idle period causes no second connection
            self.clock.advance(5.0)
            only.is_stalled = True
            client.send(b"x", PLAIN.address)
            self.clock.advance(0.25)
            client.send(b"x", PLAIN.address)
            only.is_stalled = False
        self.assertEqual(len(self.pipes.dialled), 1)

    def test_stream_that_stands_still(self) -> None:
        """If a connection stalls, two more are opened; within 0.5 s all datagrams use the two working connections."""
        client, _, server, served = self.pair()

        (address,) = server.peers
        (first,) = self.pipes.streams
        first.is_stalled = True
        _, gap = self.talk(client, served, 1.0)
        self.assertLess(gap, STALLED_S + 0.25)
        self.assertEqual(len(self.pipes.streams), MAX_CONNECTIONS)
        times, gap = self.talk(client, served, 20.0)
        self.assertLess(gap, 2 * STEP)
        self.assertEqual(set(times), {float(COPIES)})
        self.assertEqual((server.peers, client.peers), ([address], [PLAIN.address]))

    def test_dial_the_dead_anew(self) -> None:
        """A stalled connection is soon replaced if another connection works.

        If all connections stall, none is replaced.
        """
        client, _, server, served = self.pair()
        (first,) = self.pipes.streams
        first.is_stalled = True
        self.talk(client, served, REPLACE_STALLED_S + 1.5)
        self.assertTrue(first.is_lost)
        self.assertEqual(len(self.pipes.streams), MAX_CONNECTIONS)
        dialled = len(self.pipes.dialled)
        for stream in self.pipes.streams:
            stream.is_stalled = True
        self.talk(client, served, 4.0)
        self.assertEqual(len(self.pipes.dialled), dialled)

    def test_way_back(self) -> None:
        """The server also sends over two connections, and avoids a stalled connection."""
        client, came, server, served, first = self.three()
        (address,) = server.peers
        first.other.is_stalled = True
        for number in range(100):
            server.send(bytes([number]), address)
            self.clock.advance(STEP)
        self.assertEqual({datagram[0] for datagram, _ in came}, set(range(100)))
        self.assertEqual({source for _, source in came}, {PLAIN.address})

    def test_one_again(self) -> None:
        """Half a minute after the last stall both ends use one connection again."""
        client, _, server, served, _ = self.three()
        self.talk(client, served, REDUNDANCY_S - 4.0)
        self.assertEqual(len(self.pipes.streams), MAX_CONNECTIONS)
        self.talk(client, served, 6.0)
        self.assertEqual((len(self.pipes.streams), len(server._connections)), (1, 1))
        times, _ = self.talk(client, served, 5.0)
        self.assertEqual((set(times), len(times)), ({1.0}, 50))

    def test_little_waits_in_what_stands_still(self) -> None:
        """Few datagrams wait in a stalled stream; datagrams that would arrive too late are dropped."""
        client, _, _, served = self.pair()
        (only,) = self.pipes.streams
        self.pipes.cut(HOST)
        only.is_stalled = True
        self.talk(client, served, 4.0, 1000)
        self.assertLess(only.unacked, 2 * MAX_STALLED_BYTES)
        self.assertGreater(client.counters["dropped"], 20)

    def test_open_by_another(self) -> None:
        """If a connection does not open, a second connection is tried and opens the tunnel."""
        _, served = self.made(is_plain=True)
        client, _ = self.made("10.0.0.2", PLAIN)
        self.pipes.cut(HOST)
        client.send(b"x", PLAIN.address)
        self.clock.advance(DIAL_NEXT_S / 2)
        self.pipes.heal()
        _, gap = self.talk(client, served, 3.0)
        self.assertLess(gap, DIAL_NEXT_S + 1.5)
        self.clock.advance(5.0)
        self.assertEqual(len(self.pipes.streams), 1)

    def test_hard_to_open(self) -> None:
        """If the first message of a client had to be retransmitted, the client starts with three connections."""
        self.made(is_plain=True)
        client, _ = self.made("10.0.0.2", PLAIN)
        measured = client._transport.read_state
        client._transport.read_state = lambda transport: (  # type: ignore[method-assign]
            None
            if (seen := measured(transport)) is None
            else type(seen)(seen.unacked, seen.acked, LOSSY_RETRANSMISSIONS)
        )
        client.send(b"x", PLAIN.address)
        self.clock.advance(0.1)
        client.send(b"x", PLAIN.address)
        self.clock.advance(0.1)
        self.assertEqual(len(self.pipes.streams), MAX_CONNECTIONS)

    def test_tokens(self) -> None:
        """Up to three connections with the same token are one peer; connections without a token are separate peers."""
        server, served = self.made(is_plain=True)
        one, other = b"a" * 32, b"b" * 32
        crowd = [self.dribble(WHOLE % (1, token)) for token in (one, one, other, b"", b"", b"a" * 31)]
        self.clock.advance(0.1)
        self.assertEqual((len(server.peers), len(server._connections)), (5, 6))
        crowd += [self.dribble(WHOLE % (1, one)) for _ in range(5)]
        self.clock.advance(0.1)
        self.assertEqual((len(server.peers), len(server._connections)), (5, 4 + MAX_CONNECTIONS))
        self.assertFalse(crowd[-1].is_lost)

    def test_caps_allow_for_it(self) -> None:
        """Each member of a team behind one address may have three connections.

        At the limit the server closes some of these connections before it rejects a new one.
        """
        server, served = self.made()
        members = [self.member(server, served, "10.0.0.2") for _ in range(MAX_PER_HOST)]
        for member in members:
            member._tunnels[URL.address]._redundant_until = 1e9
            member.send(b"m", URL.address)
            self.clock.advance(0.01)
        self.assertEqual((len(server.peers), len(server._connections)), (MAX_PER_HOST, MAX_CONNECTIONS * MAX_PER_HOST))
        self.assertTrue(self.dribble(host="10.0.0.2").is_lost)
        for number in range(MAX_TOTAL_CONNECTIONS - MAX_CONNECTIONS * MAX_PER_HOST + 10):
            self.member(server, served, f"10.2.{number // 250}.{number % 250}")
        self.assertEqual(len(server._connections), MAX_TOTAL_CONNECTIONS)
        self.assertEqual(len(server.peers), MAX_TOTAL_CONNECTIONS - (MAX_CONNECTIONS - 1) * MAX_PER_HOST + 10)

    def member(self, server: TunnelNetwork, served: Heard, host: str) -> TunnelNetwork:
        """Create a member to which the server replies."""
        member, _ = self.made(host, URL)
        member._rng = random.Random(len(self.ends))
        member.send(b"m", URL.address)
        self.clock.advance(0.01)
        address: Address = served.pop()[1]
        server.send(b"hello", address)
        return member
