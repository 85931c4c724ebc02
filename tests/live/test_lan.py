"""Tests of the LAN's multicast group over real sockets on the loopback interface."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from twisted.internet import reactor as _reactor
from twisted.internet.defer import Deferred
from twisted.internet.protocol import DatagramProtocol
from twisted.internet.task import deferLater
from twisted.trial.unittest import TestCase

from middleware.entangled.network.interface import Interface, list_interfaces
from middleware.entangled.network.lan import LanMulticast
from middleware.entangled.network.network import Address

reactor: Any = _reactor


class LoopbackTests(TestCase):
    """Two members of the multicast group on the loopback interface."""

    def group(
        self, host: str = "127.0.0.1", look: Any = list_interfaces, moved: Callable[[], None] = lambda: None
    ) -> tuple[LanMulticast, list[tuple[bytes, Address]]]:
        """Return a member of the group, and the list of datagrams that the member receives."""
        heard: list[tuple[bytes, Address]] = []
        group = LanMulticast(reactor, host, look)
        group.listen(lambda datagram, source: heard.append((datagram, source)), moved)
        self.addCleanup(group.close)
        return group, heard

    def soon(self, heard: list[Any], count: int = 1, tries: int = 200) -> Deferred[None]:
        """Return a Deferred that fires when ``count`` datagrams have arrived."""

        async def wait() -> None:
            for _ in range(tries):
                if len(heard) >= count:
                    return
                await deferLater(reactor, 0.01)
            self.fail(f"heard {heard}")

        return Deferred.fromCoroutine(wait())

    async def test_all_in_the_group_hear_a_call_and_can_answer(self) -> None:
        """A datagram to the group reaches each member on the machine, and a reply reaches the sender."""
        a, heard_a = self.group()
        _, heard_b = self.group()
        a.send(b"who?")
        await self.soon(heard_b)
        self.assertEqual(heard_b[0][0], b"who?")
        source = heard_b[0][1]
        self.assertEqual(source.host, "127.0.0.1")
        await self.soon(heard_a)  # the member's own datagram
        answering = reactor.listenUDP(0, DatagramProtocol(), "127.0.0.1")
        self.addCleanup(answering.stopListening)
        answering.write(b"here", tuple(source))
        await self.soon(heard_a, 2)
        self.assertEqual(heard_a[1], (b"here", Address("127.0.0.1", answering.getHost().port)))

    async def test_a_change_is_told(self) -> None:
        """A change of the network interfaces is reported; the first list of interfaces is not reported as a change."""
        loopback = Interface(1, "lo", ("127.0.0.1",), is_loopback=True)
        found = [[loopback], [loopback], [Interface(1, "lo", ("127.0.0.1", "::1"), is_loopback=True)]]
        changes: list[int] = []
        group, _ = self.group(
            "", lambda: found.pop(0) if len(found) > 1 else found[0], lambda: changes.append(len(found))
        )
        group._update_interfaces()
        self.assertEqual(changes, [])
        group._update_interfaces()
        self.assertEqual(changes, [1])

    def test_the_loopback_is_an_interface(self) -> None:
        """The machine's interfaces are listed, including loopback with its address."""
        loopback = [each for each in list_interfaces() if each.is_loopback]
        self.assertIn("127.0.0.1", loopback[0].addresses)

    async def test_no_interface_is_no_error(self) -> None:
        """Without an interface a datagram is lost without an error; ``close`` may be called twice."""
        group, heard = self.group("192.0.2.77", lambda: [])
        group.send(b"who?")
        await deferLater(reactor, 0.05)
        self.assertEqual(heard, [])
        group.close()
        group.close()
