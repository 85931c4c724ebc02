"""Tests of what the doctor makes of the facts."""

from __future__ import annotations

from dataclasses import replace

from twisted.trial.unittest import SynchronousTestCase

from middleware.entangled.network.interface import Interface
from middleware.entangled.network.network import Address
from middleware.entangled.wire.hail import VERSION
from swarmnode.doctor.diagnosis import diagnosed
from swarmnode.doctor.facts import Answer, Certificate, Facts, Health, Lan, Probe, Storage
from swarmnode.doctor.finding import Finding

LO = Interface(1, "lo", ("127.0.0.1",), is_loopback=True)
WLAN = Interface(2, "wlan0", ("192.168.1.7", "fd00::7"))
CABLE = Interface(3, "eth0", ("10.1.1.7",))
FAR, NEAR = Address("203.0.113.5", 8484), Address("192.168.1.9", 8484)
WALL = 1_800_000_000.0
MEMBER = Probe(NEAR, Answer(NEAR, offset=0.1), is_member=True, is_near=True)
OUTSIDE = Probe(FAR, Answer(FAR, offset=-0.1, seen=Address("192.168.1.7", 5)), is_member=True)
SILENT, SILENT_NEAR = Probe(FAR), Probe(NEAR, is_near=True)
HEALTHY = Lan((Answer(NEAR, offset=0.0),), is_sent=True, is_own_heard=True)
WELL = Facts(
    "dog1",
    "192.168.1.7",
    8484,
    WALL,
    interfaces=(LO, WLAN, CABLE),
    known=(MEMBER, OUTSIDE),
    lan=HEALTHY,
    way_out="192.168.1.7",
    is_gateway_resolved=True,
)


class DiagnosisTests(SynchronousTestCase):
    """Each cause is named, with its reason and remedy, and a healthy node has none."""

    def only(self, facts: Facts, cause: str, *words: str) -> Finding:
        """The one finding, of that cause, which says these words."""
        found = diagnosed(facts)
        self.assertEqual([finding.cause for finding in found], [cause], found)
        self.assertTrue(all([found[0].what, found[0].why, found[0].remedy]))
        said = f"{found[0].what} {found[0].why} {found[0].remedy}"
        for word in words:
            self.assertIn(word, said)
        return found[0]

    def test_nothing_is_wrong(self) -> None:
        """A node whose known nodes and neighbours answer has no finding."""
        self.assertEqual(diagnosed(WELL), [])

    def test_udp_blocked(self) -> None:
        """Who answers to TCP and to no datagram is behind something that blocks UDP."""
        facts = replace(WELL, known=(replace(SILENT, is_tcp=True),), lan=None)
        self.only(facts, "udp-blocked", "203.0.113.5 answers to TCP", "tunnels")

    def test_udp_is_not_blocked_where_one_answers(self) -> None:
        """One outside that answers over UDP clears the network; the silent one is another matter."""
        other = Probe(Address("203.0.113.6", 1), is_tcp=True)
        self.assertEqual(diagnosed(replace(WELL, known=(OUTSIDE, other))), [])

    def test_nobody_listens(self) -> None:
        """A machine that says that its port is closed has no node there."""
        facts = replace(WELL, known=(MEMBER, Probe(FAR, error="refused")))
        self.assertEqual(self.only(facts, "nobody-listens", "203.0.113.5:8484").weight, "warning")
        self.only(replace(WELL, known=(Probe(FAR, error="refused"),), lan=None), "nobody-listens")

    def test_client_isolation(self) -> None:
        """Neighbours whose hardware does not answer, while the router's does, are kept apart."""
        facts = replace(WELL, known=(replace(SILENT_NEAR, is_resolved=False),), lan=Lan((), True, True))
        self.only(facts, "client-isolation", "The router answers", "access point")

    def test_one_that_is_off_is_no_isolation(self) -> None:
        """Where other neighbours answer, the silent one is just not there."""
        off = Probe(Address("192.168.1.33", 8484), is_near=True, is_resolved=False)
        facts = replace(WELL, known=(MEMBER, off))
        self.assertEqual(self.only(facts, "off", "192.168.1.33").weight, "warning")
        self.only(replace(WELL, known=(off,), lan=HEALTHY), "off")

    def test_firewall_of_a_neighbour(self) -> None:
        """A neighbour whose hardware answers and which says nothing to datagrams has a firewall."""
        facts = replace(WELL, known=(replace(SILENT_NEAR, is_resolved=True),), lan=Lan((), True, True))
        self.only(facts, "peer-firewall", "192.168.1.9", "Open UDP 8484")

    def test_multicast_blocked_by_the_network(self) -> None:
        """A neighbour that answers by its address, while nobody answers a call to all, shows that multicast is lost."""
        facts = replace(WELL, lan=Lan((), True, True))
        self.only(facts, "multicast-blocked", "This network does not carry multicast", "known_nodes")

    def test_multicast_blocked_on_this_machine(self) -> None:
        """A call that does not come back, or cannot be sent, is this machine's own firewall."""
        self.only(replace(WELL, lan=Lan((), True, False)), "multicast-blocked", "This machine does not let")
        self.only(replace(WELL, lan=Lan((), False, False)), "multicast-blocked", "This machine cannot send")

    def test_a_second_node_on_this_machine_proves_no_multicast(self) -> None:
        """An answer from this machine itself says nothing of the network."""
        own = Lan((Answer(Address("192.168.1.7", 8485), offset=0.0),), True, True)
        self.only(replace(WELL, lan=own), "multicast-blocked")

    def test_wrong_interface(self) -> None:
        """A host that is no address of this machine, or is its own alone, or unplugged, is a wrong interface."""
        silent = (SILENT,)
        self.only(replace(WELL, host="192.168.7.7", known=silent, lan=None), "wrong-interface", "192.168.1.7")
        self.only(replace(WELL, host="127.0.0.1", known=silent, lan=None), "wrong-interface", "on another machine")
        unplugged = replace(CABLE, is_running=False)
        facts = replace(WELL, host="10.1.1.7", interfaces=(LO, WLAN, unplugged), known=silent, lan=None)
        self.only(facts, "wrong-interface", "eth0 is not connected", "192.168.1.7")

    def test_known_nodes_by_another_interface(self) -> None:
        """A node at the cable whose known nodes are reached by Wi-Fi, and do not answer, listens at the wrong one."""
        facts = replace(WELL, host="10.1.1.7", known=(SILENT,), lan=None)
        self.only(facts, "wrong-interface", "from 192.168.1.7", "Set [node] host to 192.168.1.7")

    def test_offline(self) -> None:
        """A machine with nothing but its loopback has no network."""
        self.only(replace(WELL, interfaces=(LO,), known=(), lan=None), "offline")

    def test_no_bootstrap(self) -> None:
        """Known nodes that are all silent, for no cause that shows, are named; one that knows none is warned."""
        self.only(replace(WELL, known=(SILENT,), lan=None), "no-bootstrap", "203.0.113.5:8484")
        alone = replace(WELL, known=(), lan=Lan((), True, True))
        self.assertEqual(self.only(alone, "no-bootstrap", "known_nodes is empty").weight, "warning")

    def test_running_node_with_company_needs_no_bootstrap(self) -> None:
        """A node that runs and has contacts is not alone, whatever the doctor's own calls met."""
        facts = replace(WELL, known=(SILENT,), lan=None, health=Health(2), is_running=True)
        self.assertEqual(diagnosed(facts), [])

    def test_kind_of_router(self) -> None:
        """One port seen by all is a friendly router, another port for each a symmetric one, one witness too few."""

        def seen(*ports: int) -> Facts:
            probes = [
                Probe(at, Answer(at, seen=Address("198.51.100.1", port)), is_member=True)
                for at, port in zip((FAR, Address("203.0.113.6", 8484)), ports, strict=False)
            ]
            return replace(WELL, known=tuple(probes), lan=None)

        self.assertEqual(self.only(seen(5000, 5000), "nat-cone").weight, "note")
        self.assertEqual(self.only(seen(5000, 6000), "nat-symmetric", "198.51.100.1:6000").weight, "warning")
        self.assertEqual(self.only(seen(5000), "nat").weight, "note")

    def test_wrong_team(self) -> None:
        """Who answers everybody and not this team is of another one: by its mark, or by its key."""
        stranger = Probe(FAR, Answer(FAR, fingerprint=b"b" * 8, offset=0.0))
        self.only(replace(WELL, known=(stranger,), fingerprint=b"a" * 8, lan=None), "wrong-team", "swarm join")
        self.only(
            replace(WELL, known=(Probe(FAR, Answer(FAR, offset=0.0)),), lan=None), "wrong-team", "same [node] team_key"
        )
        open_one = replace(WELL, known=(Probe(FAR, Answer(FAR, offset=0.0)),), fingerprint=b"a" * 8, lan=None)
        self.only(open_one, "wrong-team", "of an open team")

    def test_certificate(self) -> None:
        """A certificate that has ended, is not valid yet, ends soon or cannot be read is named with its moments."""
        day = 86400.0
        for certificate, cause in (
            (Certificate(0.0, WALL - 1), "certificate-expired"),
            (Certificate(WALL + day, WALL + 9 * day), "certificate-early"),
            (Certificate(0.0, WALL + day), "certificate-ends"),
            (Certificate(problem="others can read it"), "certificate-unreadable"),
        ):
            self.only(replace(WELL, certificate=certificate), cause)
        self.assertEqual(diagnosed(replace(WELL, certificate=Certificate(WALL - day, WALL + 30 * day))), [])

    def test_unreadable_membership_is_no_other_team(self) -> None:
        """Where the membership cannot be read nobody could be greeted, so nobody is called a stranger for that."""
        stranger = Probe(FAR, Answer(FAR, fingerprint=b"b" * 8, offset=0.0))
        facts = replace(WELL, known=(stranger,), lan=None, certificate=Certificate(problem="others can read it"))
        self.only(facts, "certificate-unreadable")

    def test_refusals_that_the_running_node_met(self) -> None:
        """What peers said when they did not let the node in is told with the remedy of each."""
        for code, cause in (
            ("revoked", "certificate-revoked"),
            ("expired", "certificate-expired"),
            ("doubled", "two-of-one"),
            ("foreign", "wrong-team"),
            ("a new one", "a new one"),
        ):
            health = Health(0, refusals=((code, "203.0.113.5:8484"),))
            self.only(replace(WELL, health=health), cause, "203.0.113.5:8484")

    def test_clock(self) -> None:
        """A clock that differs from the others' median is named; one liar among three changes nothing."""

        def offset(*seconds: float) -> Facts:
            lan = Lan(tuple(Answer(Address("192.168.1.9", n), offset=s) for n, s in enumerate(seconds)), True, True)
            return replace(WELL, known=(), lan=lan)

        self.assertEqual(self.only(offset(60.0, 61.0), "clock-off", "behind", "60 seconds").weight, "warning")
        self.assertEqual(self.only(offset(-7200.0), "clock-off", "ahead of", "2 hours").weight, "error")
        self.assertEqual(diagnosed(offset(0.0, 1e9, 1.0)), [])

    def test_clock_of_this_machine_alone(self) -> None:
        """Nodes of this machine have its clock, and so say nothing of it."""
        own = Answer(Address("192.168.1.7", 8485), offset=0.0)
        lan = Lan((own, Answer(NEAR, offset=-7200.0)), is_sent=True, is_own_heard=True)
        self.only(replace(WELL, known=(), lan=lan), "clock-off", "2 hours ahead of")

    def test_certificate_by_a_wrong_clock(self) -> None:
        """A certificate that holds by the others' clocks is not called expired: the clock is what is wrong."""
        day = 86400.0
        lan = Lan((Answer(NEAR, offset=-400 * day),), is_sent=True, is_own_heard=True)
        certificate = Certificate(WALL - 410 * day, WALL - 45 * day)
        self.only(replace(WELL, known=(), lan=lan, certificate=certificate), "clock-off", "400 days ahead of")

    def test_version(self) -> None:
        """A node of another version is named, and who is to upgrade; it is not taken for another team."""
        newer = Probe(FAR, Answer(FAR, version=VERSION + 1, offset=0.0))
        self.only(replace(WELL, known=(newer,), lan=None), "version-skew", "Upgrade this one")

    def test_port_in_use(self) -> None:
        """A port that another program holds is named; the node's own, while it runs, is not."""
        facts = replace(WELL, port_problem="Another program listens at 192.168.1.7:8484.")
        self.only(facts, "port-in-use", "8484")
        self.assertEqual(diagnosed(replace(facts, is_running=True)), [])

    def test_store(self) -> None:
        """A store that cannot be written, has no room or is nearly full is named."""
        self.only(replace(WELL, storage=Storage("a.sqlite", "Its disk is read-only.")), "store-unwritable", "read-only")
        self.only(replace(WELL, storage=Storage("a.sqlite", free=2**20)), "disk-full", "1 MiB")
        self.only(replace(WELL, health=Health(1, trouble="disk is full")), "store-unwritable", "disk is full")
        full = self.only(replace(WELL, health=Health(1, rows=100, max_rows=100)), "store-full", "store_rows")
        self.assertEqual(full.weight, "error")
        nearly = self.only(replace(WELL, health=Health(1, bytes=95, max_bytes=100)), "store-full", "store_bytes")
        self.assertEqual(nearly.weight, "warning")

    def test_open_key_file(self) -> None:
        """A file with secrets that others can read is named with its mode and the command that mends it."""
        self.only(replace(WELL, open_files=(("dog1.toml", 0o644),)), "key-readable", "0644", "chmod 600 dog1.toml")

    def test_the_gravest_comes_first(self) -> None:
        """Errors come before warnings, and those before notes."""
        seen = Probe(FAR, Answer(FAR, seen=Address("198.51.100.1", 5)), is_member=True)
        facts = replace(WELL, known=(seen,), lan=Lan((), True, False), open_files=(("a", 0o644),))
        self.assertEqual([finding.weight for finding in diagnosed(facts)], ["error", "warning", "note"])
