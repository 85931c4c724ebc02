"""Tests of attack S8: to an unverified address a node sends no more bytes than it received from that address."""

from __future__ import annotations

import asyncio
import sys
from pathlib import Path
from random import Random

from benchmarks.nat.hosts import Hosts
from benchmarks.nat.matrix import Pair, Trial
from sim.namespaces.capture import Capture, read_datagrams
from sim.namespaces.internet import PUBLIC_ADDRESSES, PUBLIC_HOST, Internet, Site
from sim.namespaces.nat import NatKind
from tests.live.namespaces import NamespaceCase

STRANGER = """
import socket, sys, time
target, pause = (sys.argv[1], int(sys.argv[2])), float(sys.argv[3])
held = []
for line in sys.stdin:
    held.append(socket.socket(socket.AF_INET, socket.SOCK_DGRAM))
    held[-1].sendto(bytes.fromhex(line), target)
    time.sleep(pause)
"""
PAUSE_S = 0.002


class AmplificationTests(NamespaceCase):
    """A node at ``pub``, a member that joined it, and an attacker that sends recorded and random datagrams."""

    def test_a_stranger_gets_no_more_than_he_sends(self) -> None:
        """The node sends fewer bytes than it receives from an unknown address.

        The datagrams are recorded ones from another address, and random ones with each possible first byte.
        """
        folder = Path(self.mktemp()).absolute()
        folder.mkdir(parents=True)
        with Internet([Site("a", NatKind.PORT), Site("b", NatKind.PORT), Site("stranger", NatKind.NONE)]) as net:
            port = asyncio.run(self._attacked(net, folder))
            self.assertGreater(port, 0)

    async def _attacked(self, net: Internet, folder: Path) -> int:
        async with Hosts(net, [PUBLIC_HOST, "a1", "b1"], folder) as fleet:
            trial = Trial(fleet, Pair("plain", "port", "port", "a1", "b1"), 1, Random(1))
            net.record_frames(folder / "join.pcap")
            await trial.run(5.0, 5.0)
            net.record_frames(None)
            self.assertEqual(trial.outcome.trouble, "")
            heard = list(read_datagrams(folder / "join.pcap"))
            asked = [
                (int(to.rpartition(":")[2]), held) for _, to, held in heard if to.startswith(PUBLIC_ADDRESSES[0] + ":")
            ]
            port = asked[0][0]
            rng = Random(2)
            noise = [bytes([first]) + rng.randbytes(rng.choice((0, 7, 40, 200, 900, 1399))) for first in range(256)]
            sent = [held for _, held in asked] + noise + [held for _, held in asked]
            with Capture(net, PUBLIC_HOST, folder / "attack.pcap") as seen:
                process = net.start(
                    "stranger1", [sys.executable, "-c", STRANGER, PUBLIC_ADDRESSES[0], str(port), str(PAUSE_S)], **IN
                )
                assert process.stdin is not None
                process.stdin.write("".join(held.hex() + "\n" for held in sent))
                process.stdin.close()
                while process.poll() is None:
                    await asyncio.sleep(0.05)
            traffic = seen.from_host(net.address("stranger1"))
            self.assertEqual(traffic.received, len(sent))
            # Some replies have arrived, so the comparison is meaningful.
            self.assertGreater(traffic.sent, 0)
            self.assertLessEqual(traffic.amplification, 1.0)
            # Each datagram has its own source port, so the reply to it is compared only with its own length.
            for peer, each in seen.traffic.items():
                if peer.startswith(net.address("stranger1") + ":"):
                    self.assertLessEqual(each.amplification, 1.0)
            return port


IN = {"stdin": -1, "text": True}
