"""The rules of routers, as text."""

from __future__ import annotations

from twisted.trial.unittest import SynchronousTestCase

from sim.namespaces.kind import Kind


class KindTests(SynchronousTestCase):
    def test_each_kind_has_its_own_rules(self) -> None:
        """No two routers have the same rules, and the braces of each are balanced."""
        texts = {kind: kind.rules() for kind in Kind if kind is not Kind.NONE}
        self.assertEqual(len(set(texts.values())), len(texts))
        for text in texts.values():
            self.assertEqual(text.count("{"), text.count("}"))
            self.assertNotIn("; ;", text)

    def test_what_makes_a_kind(self) -> None:
        """Only the symmetric one has random ports, only the leaky one takes strangers in, only one blocks UDP."""
        self.assertEqual([kind for kind in Kind if "fully-random" in kind.rules()], [Kind.SYM])
        self.assertEqual([kind for kind in Kind if "ct state new drop" not in kind.rules()], [Kind.LEAKY])
        self.assertEqual([kind for kind in Kind if "udp drop" in kind.rules()], [Kind.NOUDP])
        self.assertEqual([kind for kind in Kind if "dnat" in kind.rules()], [Kind.FULL, Kind.ADDR])

    def test_every_kind_is_explained(self) -> None:
        """Each kind has words for people, and no two the same."""
        self.assertEqual(len({kind.meaning for kind in Kind}), len(Kind))
