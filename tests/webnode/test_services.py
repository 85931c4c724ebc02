"""Tests of ``webnode.services``: the required and the optional parts of a web node."""

from __future__ import annotations

from twisted.trial.unittest import SynchronousTestCase

from tests.webnode.memory import MemoryTeamControl
from webnode.auth import OpenSessions
from webnode.services import Services


class ServicesTests(SynchronousTestCase):
    def test_let_everybody_in(self) -> None:
        """Open sessions give every user the role operator, with or without a token."""
        sessions = OpenSessions()
        token = self.successResultOf(sessions.sign_in("whatever", "10.0.0.9", 5.0))
        sessions.revoke(sessions.authenticate(token.text, 6.0).token_id)
        self.assertEqual([sessions.authenticate(each, 7.0).role for each in (token.text, "")], ["operator"] * 2)
        self.assertGreater(token.until, 5.0)

    def test_say_what_it_has(self) -> None:
        """``feature_names`` lists only the optional parts that the node has, including the map if there is one."""
        self.assertEqual(Services(MemoryTeamControl(), OpenSessions()).feature_names, [])
        control = MemoryTeamControl(robot_map={"walls": [3.0, 2.4], "dogs": [], "target": None})
        self.assertEqual(Services(control, OpenSessions()).feature_names, ["yard"])
