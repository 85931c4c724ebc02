"""Tests of what two nodes tell each other of what both should hold."""

from __future__ import annotations

from typing import Any

from middleware.entangled.errors import Refused
from middleware.entangled.record import hashed_key
from middleware.entangled.replication.overlap import BITS, GROUPS, LISTED_S, PLACES
from tests.fleet import Fleet, FleetCase

MANY = 40


class OverlapTests(FleetCase):
    def setUp(self) -> None:
        super().setUp()
        self.whole: Fleet = self.fleet(3)
        for number in range(MANY):
            self.whole.nodes[0].put(hashed_key(str(number)), "state", b"%d" % number)
            self.whole.nodes[0].put(hashed_key("0"), f"{number}", b"so that a part has several pages")
        self.whole.run(1.0)

    def ask(self, method: str, *arguments: object) -> Any:
        to = self.whole.nodes[2].contact
        return self.done(self.whole, self.whole.nodes[1].endpoint.ask(to, method, *arguments), 0.1)

    def places(self, group: int) -> list[list[Any]]:
        """All places of a part, page by page."""
        found: list[list[Any]] = []
        while True:
            page = self.ask("places", group, found[-1][:3] if found else [])
            found += page
            if len(page) < PLACES:
                return found

    def test_every_place_is_listed_once(self) -> None:
        """The pages of all parts have each record once, in order, without what came in between."""
        self.ask("digests", 7, 2)
        found = [self.places(group) for group in range(GROUPS)]
        for part in found:
            self.assertEqual(part, sorted(part))
            self.assertEqual(len(part), len({tuple(place[:3]) for place in part}))
        self.assertEqual({place[0] for part in found for place in part}, {hashed_key(str(n)) for n in range(MANY)})
        self.assertEqual(self.places(-1), [])

    def test_who_pages_sees_one_moment(self) -> None:
        """What is stored after the digests were given is listed after the next ones, or when the list is old."""
        late = hashed_key("late")
        group = late[0] * GROUPS >> 8
        self.ask("digests", 7, 2)
        self.whole.nodes[0].put(late, "state", b"x")
        self.whole.run(0.1)
        self.assertNotIn(late, [place[0] for place in self.places(group)])
        self.whole.run(LISTED_S)
        self.assertIn(late, [place[0] for place in self.places(group)])

    def test_records_come_in_pages(self) -> None:
        """A page has records until it is full, the first one however large, and None for what is not there."""
        node = self.whole.nodes[0]
        large = hashed_key("large")
        for name in "abc":
            node.put(large, name, b"x" * 9000)
        self.whole.run(1.0)
        slots: list[object] = [[large, node.identity.public, name] for name in "abc"]
        self.assertEqual([fields[0][1] for fields in self.ask("fetch", slots)], ["a"])
        missing: list[object] = [[large, node.identity.public, "z"]]
        self.assertEqual(self.ask("fetch", missing * 3), [None] * 3)
        self.assertEqual(len(self.ask("fetch", [*missing * 20, *slots])), PLACES)
        self.assertEqual(self.ask("fetch", []), [])

    def test_wrong_questions(self) -> None:
        """Parts, cursors and slots that cannot be are refused."""
        to, asker = self.whole.nodes[2].contact, self.whole.nodes[1].endpoint
        wrong: list[tuple[object, ...]] = [
            ("digests", BITS, 2),
            ("places", GROUPS, []),
            ("places", 0, [b"", b""]),
            ("fetch", [[b"", b""]]),
            ("fetch", [[b"", b"", 1]]),
            ("fetch", ["x"]),
            ("lacking", ["x"]),
            ("lacking", [[b"", b"", "", 1]]),
        ]
        for method, *arguments in wrong:
            asked = asker.ask(to, str(method), *arguments)
            self.whole.run(0.1)
            self.failureResultOf(asked, Refused)


class JoinTests(FleetCase):
    """What joining costs before the first read, and what follows."""

    def test_a_newcomer_reads_at_once(self) -> None:
        """In a team of 20 the first read of an old key needs few datagrams, whether its first contact has it or not."""
        fleet = self.fleet(20)
        keys = [hashed_key(str(number)) for number in range(6)]
        for key in keys:
            fleet.nodes[3].put(key, "state", b"old")
        fleet.run(2.0)
        for key in keys:
            newcomer = fleet.made(len(fleet.nodes))
            fleet.nodes.append(newcomer)
            fleet.run(1.0)
            before = fleet.board.counters["sent"]
            joined: Any = fleet.enter(newcomer, [fleet.address(0)])
            read = joined.addCallback(lambda _, newcomer=newcomer, key=key: newcomer.get(key, "fast"))
            fleet.run(0.002)
            self.assertEqual([record.value for record in self.successResultOf(read)], [b"old"])
            self.assertLess(fleet.board.counters["sent"] - before, 60)
            fleet.run(3.0)

    def test_a_newcomer_takes_over(self) -> None:
        """Seconds later it knows everybody, is sure, and holds what belongs to it; nobody compares with it again."""
        fleet = self.fleet(10)
        keys = [hashed_key(str(number)) for number in range(60)]
        for key in keys:
            fleet.nodes[3].put(key, "state", b"old")
        fleet.run(2.0)
        newcomer = fleet.add()
        fleet.run(1.0)
        self.assertTrue(newcomer.overlay.is_complete)
        self.assertTrue(newcomer.replica.is_sure())
        belongs = [key for key in keys if newcomer.overlay.belongs(key, newcomer.contact)]
        self.assertGreater(len(belongs), 20)
        self.assertEqual([key for key in keys if newcomer.replica.held(key)], belongs)

    def test_a_newcomer_writes_to_the_right_nodes(self) -> None:
        """A majority write right after joining, before everybody is known, is found by a majority read elsewhere."""
        fleet = self.fleet(20)
        for number in range(6):
            newcomer = fleet.made(len(fleet.nodes))
            fleet.nodes.append(newcomer)
            key = hashed_key(f"new {number}")
            stored: Any = fleet.enter(newcomer, [fleet.address(0)])
            stored.addCallback(lambda _, newcomer=newcomer, key=key: newcomer.put(key, "state", b"new"))
            fleet.run(1.0)
            self.assertGreaterEqual(self.successResultOf(stored), 5)
            read = fleet.nodes[number].get(key)
            self.assertEqual([record.value for record in self.done(fleet, read, 0.5)], [b"new"])
