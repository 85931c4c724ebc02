"""Tests of publication and search by keyword."""

from __future__ import annotations

from hypothesis import given, settings
from hypothesis import strategies as st
from twisted.trial.unittest import SynchronousTestCase

from middleware.entangled.errors import TooLarge
from middleware.entangled.network.switchboard import LinkConditions
from middleware.entangled.space.keyword import BadName, Keywords, Match, words
from tests.fleet import FleetCase


class WordsTests(SynchronousTestCase):
    def test_names(self) -> None:
        """A name is split at each character that is not a letter or digit; words are case-folded and unique."""
        for name, wanted in [
            ("red_target-3.jpg", ["red", "target", "3", "jpg"]),
            ("Red RED red", ["red"]),
            ("Straße ﬁn", ["strasse", "fin"]),
            ("--", []),
            ("камера 1", ["камера", "1"]),
        ]:
            self.assertEqual(words(name), wanted)

    @settings(max_examples=200)
    @given(text=st.text(max_size=30))
    def test_stable(self, text: str) -> None:
        """Splitting any text gives unique words."""
        found = words(text)
        self.assertEqual(len(set(found)), len(found))


class KeywordsTests(FleetCase):
    def test_search(self) -> None:
        """A search returns the names that contain all of its words, in any case."""
        fleet = self.fleet(5)
        a, b, c = (Keywords(node) for node in fleet.nodes[:3])
        self.done(fleet, a.publish("red_target-3.jpg", b"one"))
        self.done(fleet, b.publish("red ball", b"two"))
        one = Match("red_target-3.jpg", fleet.nodes[0].identity.public, b"one")
        two = Match("red ball", fleet.nodes[1].identity.public, b"two")
        self.assertEqual(self.done(fleet, c.search("target")), [one])
        self.assertEqual(self.done(fleet, c.search("RED jpg")), [one])
        self.assertEqual(self.done(fleet, c.search(["ball", "red"])), [two])
        both = self.done(fleet, c.search("red"))
        self.assertEqual({match.name for match in both}, {one.name, two.name})
        self.assertEqual(self.done(fleet, c.search("red blue")), [])
        self.assertEqual(self.done(fleet, c.search("tar")), [])

    def test_publishers_at_the_same_moment(self) -> None:
        """Eight nodes publish one name concurrently under datagram loss, and all eight matches are in the index."""
        fleet = self.fleet(8, weather=LinkConditions(delay_s=0.005, jitter_s=0.004, loss=0.1))
        keywords = [Keywords(node) for node in fleet.nodes]
        work = [one.publish("same name", bytes([number])) for number, one in enumerate(keywords)]
        fleet.run(6.0)
        for publishing in work:
            self.successResultOf(publishing)
        found = self.done(fleet, keywords[0].search("name"))
        self.assertEqual(sorted(match.data for match in found), [bytes([number]) for number in range(8)])

    def test_replace_and_remove(self) -> None:
        """A publisher replaces and removes only its own matches."""
        fleet = self.fleet(4)
        a, b = Keywords(fleet.nodes[0]), Keywords(fleet.nodes[1])
        for one, data in [(a, b"1"), (b, b"2"), (a, b"3")]:
            self.done(fleet, one.publish("red ball", data), 1.0)
        self.assertEqual(sorted(m.data for m in self.done(fleet, b.search("ball"))), [b"2", b"3"])
        self.done(fleet, a.remove("red ball"))
        for word in ("red", "ball"):
            self.assertEqual([m.data for m in self.done(fleet, b.search(word))], [b"2"])

    def test_watch(self) -> None:
        """A watch reports each added, changed and removed match of its keyword within 0.5 s, and no other match."""
        fleet = self.fleet(4)
        a = Keywords(fleet.nodes[0])
        told: list[list[bytes]] = []
        watch = Keywords(fleet.nodes[3]).watch_keyword("Ball", lambda found: told.append([m.data for m in found]))
        fleet.run(1.0)
        for work in (
            lambda: a.publish("red ball", b"1"),
            lambda: a.publish("red ball", b"2"),
            lambda: a.publish("blue sky", b"3"),
            lambda: a.remove("red ball"),
        ):
            self.done(fleet, work(), 0.5)
        self.assertEqual(told, [[b"1"], [b"2"], []])
        watch.stop()
        self.done(fleet, a.publish("red ball", b"4"), 1.0)
        self.assertEqual(len(told), 3)

    def test_wrong_use(self) -> None:
        """Names without words, names with too many words and oversized data raise an error."""
        fleet = self.fleet(2)
        a = Keywords(fleet.nodes[0])
        for name in ("", "--", " ".join(f"a{n}" for n in range(17))):
            self.assertRaises(BadName, a.publish, name, b"")
            self.assertRaises(BadName, a.search, name)
            self.assertRaises(BadName, a.remove, name)
        self.assertRaises(BadName, a.watch_keyword, "--", print)
        self.assertRaises(TooLarge, a.publish, "name", b"x" * 2**21)
        self.assertRaises(TooLarge, a.publish, "n" * 65, b"")
