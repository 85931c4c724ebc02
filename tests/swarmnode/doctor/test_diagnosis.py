"""Tests of the diagnosis that follows from measured facts."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

from twisted.trial.unittest import SynchronousTestCase

from middleware.entangled.network.interface import Interface
from middleware.entangled.network.network import Address
from middleware.entangled.wire.probe import VERSION
from swarmnode.doctor.diagnosis import diagnose
from swarmnode.doctor.facts import Answer, Certificate, Facts, Health, LanDiscovery, Probe, Storage

LO = Interface(1, "lo", ("127.0.0.1",), is_loopback=True)
WLAN = Interface(2, "wlan0", ("192.168.1.7", "fd00::7"))
CABLE = Interface(3, "eth0", ("10.1.1.7",))
FAR, NEAR = Address("203.0.113.5", 8484), Address("192.168.1.9", 8484)
WALL = 1_800_000_000.0
MEMBER = Probe(NEAR, Answer(NEAR, offset=0.1), is_member=True, is_near=True)
OUTSIDE = Probe(FAR, Answer(FAR, offset=-0.1, seen=Address("192.168.1.7", 5)), is_member=True)
SILENT, SILENT_NEAR = Probe(FAR), Probe(NEAR, is_near=True)
HEALTHY = LanDiscovery((Answer(NEAR, offset=0.0),), is_sent=True, has_received_own=True)
WELL = Facts(
    "dog1",
    "192.168.1.7",
    8484,
    WALL,
    interfaces=(LO, WLAN, CABLE),
    known=(MEMBER, OUTSIDE),
    lan=HEALTHY,
    source_address="192.168.1.7",
    is_gateway_resolved=True,
)
CALLED = LanDiscovery((), is_sent=True, has_received_own=True)
"""A discovery on the LAN without a reply from another node."""
DAY = 86400.0
OFF = Probe(Address("192.168.1.33", 8484), is_near=True, is_resolved=False)
STRANGER = Probe(FAR, Answer(FAR, fingerprint=b"b" * 8, offset=0.0))
NO_MARK = Probe(FAR, Answer(FAR, offset=0.0))
UNREADABLE = Certificate(problem="others can read it")
Case = tuple[dict[str, Any], str, str]
"""The facts that differ from the healthy node's facts; the severity and text of the only finding."""


def seen_at(*ports: int) -> dict[str, Any]:
    """Return the facts of known nodes that see this machine at these external ports of its router."""
    probes = [
        Probe(at, Answer(at, seen=Address("198.51.100.1", port)), is_member=True)
        for at, port in zip((FAR, Address("203.0.113.6", 8484)), ports, strict=False)
    ]
    return {"known": tuple(probes), "lan": None}


class DiagnosisTests(SynchronousTestCase):
    """Each cause is found and has a reason and a remedy; a healthy node has no finding."""

    def check(self, *cases: Case) -> None:
        """Check that each case has exactly one finding."""
        for changes, cause, words in cases:
            found = diagnose(replace(WELL, **changes))
            self.assertEqual([f"{finding.weight} {finding.cause}" for finding in found], [cause], changes)
            self.assertTrue(all([found[0].what, found[0].why, found[0].remedy]))
            self.assertIn(words, f"{found[0].what} {found[0].why} {found[0].remedy}")

    def check_well(self, *cases: dict[str, Any]) -> None:
        """Check that no case has a finding."""
        for changes in cases:
            self.assertEqual(diagnose(replace(WELL, **changes)), [], changes)

    def test_way(self) -> None:
        """Problems on the path to known nodes are found: firewalls, client isolation and wrong addresses."""
        blocked = {"known": (replace(SILENT, is_tcp=True),), "lan": None}
        guarded = replace(SILENT_NEAR, is_resolved=True)
        unplugged = (LO, WLAN, replace(CABLE, is_running=False))
        alone = {"known": (SILENT,), "lan": None}
        self.check(
            (blocked, "error udp-blocked", "203.0.113.5 replies to TCP"),
            ({"known": (MEMBER, Probe(FAR, error="refused"))}, "warning nobody-listens", "203.0.113.5:8484"),
            ({"known": (Probe(FAR, error="refused"),), "lan": None}, "warning nobody-listens", ""),
            (
                {"known": (replace(SILENT_NEAR, is_resolved=False),), "lan": CALLED},
                "error client-isolation",
                "The router replies",
            ),
            ({"known": (MEMBER, OFF)}, "warning off", "192.168.1.33"),
            ({"known": (OFF,)}, "warning off", ""),
            ({"known": (guarded,), "lan": CALLED}, "error peer-firewall", "Allow incoming UDP 8484"),
            ({**alone, "host": "192.168.7.7"}, "error wrong-interface", "192.168.1.7"),
            ({**alone, "host": "127.0.0.1"}, "error wrong-interface", "on another machine"),
            (
                {**alone, "host": "10.1.1.7", "interfaces": unplugged},
                "error wrong-interface",
                "eth0 is not connected",
            ),
            ({**alone, "host": "10.1.1.7"}, "error wrong-interface", "Set [node] host to 192.168.1.7"),
            ({"interfaces": (LO,), "known": (), "lan": None}, "error offline", ""),
            (alone, "error no-bootstrap", "203.0.113.5:8484"),
            ({"known": (), "lan": CALLED}, "warning no-bootstrap", "known_nodes is empty"),
        )
        # A reply over UDP shows that UDP is not blocked, and a running node that has contacts is not isolated.
        other = Probe(Address("203.0.113.6", 1), is_tcp=True)
        self.check_well({}, {"known": (OUTSIDE, other)}, {**alone, "health": Health(2), "is_running": True})

    def test_multicast(self) -> None:
        """Multicast blocked by the network is distinguished from multicast blocked by this machine.

        Replies of this machine itself do not count.
        """
        own = LanDiscovery((Answer(Address("192.168.1.7", 8485), offset=0.0),), True, True)
        self.check(
            ({"lan": CALLED}, "warning multicast-blocked", "This network does not forward multicast"),
            ({"lan": own}, "warning multicast-blocked", "This network does not forward multicast"),
            ({"lan": LanDiscovery((), True, False)}, "warning multicast-blocked", "This machine does not receive"),
            ({"lan": LanDiscovery((), False, False)}, "warning multicast-blocked", "This machine cannot send"),
        )

    def test_kind_of_router(self) -> None:
        """Equal external ports for all peers mean a cone NAT, different ports a symmetric NAT.

        One peer is not enough.
        """
        self.check(
            (seen_at(5000, 5000), "note nat-cone", ""),
            (seen_at(5000, 6000), "warning nat-symmetric", "198.51.100.1:6000"),
            (seen_at(5000), "note nat", ""),
        )

    def test_team(self) -> None:
        """A different team, a different version and an invalid certificate are separate causes."""
        newer = Probe(FAR, Answer(FAR, version=VERSION + 1, offset=0.0))
        self.check(
            ({"known": (STRANGER,), "fingerprint": b"a" * 8, "lan": None}, "error wrong-team", "swarm join"),
            ({"known": (NO_MARK,), "lan": None}, "error wrong-team", "same [node] team_key"),
            ({"known": (NO_MARK,), "fingerprint": b"a" * 8, "lan": None}, "error wrong-team", "in an open team"),
            ({"known": (newer,), "lan": None}, "error version-skew", "Upgrade this one"),
            ({"certificate": Certificate(0.0, WALL - 1)}, "error certificate-expired", ""),
            ({"certificate": Certificate(WALL + DAY, WALL + 9 * DAY)}, "error certificate-early", ""),
            ({"certificate": Certificate(0.0, WALL + DAY)}, "warning certificate-ends", ""),
            ({"certificate": UNREADABLE}, "error certificate-unreadable", ""),
            # Without a readable membership no node can be verified, so unknown fingerprints are not reported.
            ({"known": (STRANGER,), "lan": None, "certificate": UNREADABLE}, "error certificate-unreadable", ""),
        )
        self.check_well({"certificate": Certificate(WALL - DAY, WALL + 30 * DAY)})

    def test_refusals_that_the_running_node_met(self) -> None:
        """Each reason for which peers have refused the node has a finding with a remedy."""
        causes = {
            "revoked": "certificate-revoked",
            "expired": "certificate-expired",
            "doubled": "two-of-one",
            "foreign": "wrong-team",
            "a new one": "a new one",
        }
        for code, cause in causes.items():
            health = Health(0, refusals=((code, "203.0.113.5:8484"),))
            self.check(({"health": health}, f"error {cause}", "203.0.113.5:8484"))

    def test_clock(self) -> None:
        """A clock that differs from the median clock of the peers is found.

        A reply of this machine itself, and a single wrong peer, do not change the result.

        If the local clock is wrong, a certificate that is valid by the clocks of the peers is not reported as expired.
        """

        def offset(*seconds: float) -> dict[str, Any]:
            lan = LanDiscovery(
                tuple(Answer(Address("192.168.1.9", n), offset=s) for n, s in enumerate(seconds)), True, True
            )
            return {"known": (), "lan": lan}

        own = LanDiscovery((Answer(Address("192.168.1.7", 8485), offset=0.0), Answer(NEAR, offset=-7200.0)), True, True)
        passed = Certificate(WALL - 410 * DAY, WALL - 45 * DAY)
        self.check(
            (offset(60.0, 61.0), "warning clock-off", "60 seconds behind"),
            (offset(-7200.0), "error clock-off", "2 hours ahead of"),
            ({"known": (), "lan": own}, "error clock-off", "2 hours ahead of"),
            ({**offset(-400 * DAY), "certificate": passed}, "error clock-off", "400 days ahead of"),
        )
        self.check_well(offset(0.0, 1e9, 1.0))

    def test_machine(self) -> None:
        """A port in use, a store without free space, and secrets that other users can read are found."""
        taken = {"port_problem": "Another program listens at 192.168.1.7:8484."}
        self.check(
            (taken, "error port-in-use", "8484"),
            ({"storage": Storage("a.sqlite", "Its disk is read-only.")}, "error store-unwritable", "read-only"),
            ({"storage": Storage("a.sqlite", free=2**20)}, "warning disk-full", "1 MiB"),
            ({"health": Health(1, trouble="disk is full")}, "error store-unwritable", "disk is full"),
            ({"health": Health(1, rows=100, max_rows=100)}, "error store-full", "store_rows"),
            ({"health": Health(1, bytes=95, max_bytes=100)}, "warning store-full", "store_bytes"),
            ({"open_files": (("dog1.toml", 0o644),)}, "error key-readable", "chmod 600 dog1.toml"),
        )
        self.check_well({**taken, "is_running": True})

    def test_the_gravest_comes_first(self) -> None:
        """Errors come before warnings, and warnings before notes."""
        changes = {**seen_at(5), "lan": LanDiscovery((), True, False), "open_files": (("a", 0o644),)}
        found = diagnose(replace(WELL, **changes))
        self.assertEqual([finding.weight for finding in found], ["error", "warning", "note"])
