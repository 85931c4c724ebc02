"""Control socket requests about the team of a node; they accept signed statements, never a key.

``devices`` lists all devices in a team of any size, as ``dht get devices`` does in a small one.
"""

from __future__ import annotations

import base64
from collections.abc import Callable
from typing import Any

from twisted.internet.defer import Deferred, maybeDeferred

from middleware.admission.certificate import BOOTSTRAP
from middleware.admission.team import Team
from middleware.entangled.control.port import Runs
from middleware.entangled.control.verb import Arguments, BadRequest, rows_of
from middleware.entangled.errors import Refused
from middleware.node import SwarmNode

OPEN = "this node is in an open team without an operator; create a closed team by swarm init, or join one by a code"


class TeamVerbs:
    """The control socket requests of one node: its team's, and ``others`` for the rest."""

    def __init__(self, others: Runs, node: SwarmNode) -> None:
        self._others = others
        self._node = node

    def run(self, name: object, arguments: object, tell: Callable[[Any], None]) -> Deferred[Any]:
        """Run the request ``name``, as ``Verbs.run`` does."""
        if name == "devices":
            return self._node.list_devices().addCallback(lambda listing: rows_of(listing.records))
        work = {"team tell": self._tell, "team roll": self._roll}.get(name if isinstance(name, str) else "")
        if work is None:
            return self._others.run(name, arguments, tell)
        return maybeDeferred(self._run_for_team, work, arguments)

    def _run_for_team(self, work: Callable[[Team, Arguments], object], arguments: object) -> object:
        if not isinstance(arguments, dict):
            raise BadRequest("the arguments of a request have to be an object with names")
        if self._node.team is None:
            raise Refused(OPEN)
        return work(self._node.team, Arguments(arguments))

    def _tell(self, team: Team, a: Arguments) -> object:
        return Deferred.fromCoroutine(team.tell(a.data("statement")))

    def _roll(self, team: Team, a: Arguments) -> object:
        """Return the node's view of its team, with the signed entries, so the client can verify it."""
        contacts = self._node.entangled.overlay.contacts()
        here = {contact.public: str(contact.address) for contact in contacts}
        here[team.identity.public] = str(self._node.entangled.contact.address)
        bootstraps = [member.public for member in team.members() if BOOTSTRAP in member.roles]
        return {
            "team": team.membership.team,
            "operator": team.roll.operator.hex(),
            "secret": max([team.membership.secrets[0][0], *(each.number for each in team.roll.secrets())]),
            "entries": [base64.b64encode(packed).decode() for packed in team.roll.packed()],
            "here": {public.hex(): address for public, address in here.items()},
            # A newcomer cannot reach bootstrap nodes that are reached by relay or tunnel.
            "doors": [here[each] for each in bootstraps if each in here and not here[each].startswith("~")],
        }
