"""Control socket requests about the team of a node; they accept signed statements, never a key.

``devices`` lists all devices in a team of any size, as ``dht get devices`` does in a small team.
"""

from __future__ import annotations

import base64
from collections.abc import Callable, Mapping
from typing import Any

from twisted.internet.defer import Deferred, maybeDeferred

from middleware.admission.certificate import BOOTSTRAP
from middleware.admission.team import Team
from middleware.entangled.control.request_handler import Arguments, BadRequest, make_rows
from middleware.entangled.control.server import RequestRunner
from middleware.entangled.errors import Refused
from middleware.node import SwarmNode

OPEN_TEAM_ERROR = (
    "this node is in an open team without an operator; create a closed team by swarm init, or join one by a code"
)


class TeamVerbs:
    """Runs the control socket requests of one node: those about its team here, all others by ``others``."""

    def __init__(self, others: RequestRunner, node: SwarmNode) -> None:
        self._others = others
        self._node = node

    def run(self, name: object, arguments: object, tell: Callable[[Any], None]) -> Deferred[Any]:
        """Run the request ``name``, as ``RequestHandler.run`` does."""
        if name == "devices":
            return self._node.list_devices().addCallback(lambda listing: make_rows(listing.records))
        work = self._find_handlers().get(name) if isinstance(name, str) else None
        if work is None:
            return self._others.run(name, arguments, tell)
        return maybeDeferred(self._run_for_team, work, arguments)

    def _find_handlers(self) -> Mapping[str, Callable[[Team, Arguments], object]]:
        return {"team roll": self._describe_team, "team tell": self._publish_statement}

    def _run_for_team(self, work: Callable[[Team, Arguments], object], arguments: object) -> object:
        if not isinstance(arguments, dict):
            raise BadRequest("the arguments of a request must be a JSON object")
        if self._node.team is None:
            raise Refused(OPEN_TEAM_ERROR)
        return work(self._node.team, Arguments(arguments))

    def _publish_statement(self, team: Team, a: Arguments) -> object:
        return Deferred.fromCoroutine(team.publish(a.data("statement")))

    def _describe_team(self, team: Team, a: Arguments) -> object:
        """Return the node's view of its team, with the signed entries, so the client can verify it."""
        contacts = self._node.entangled.overlay.contacts()
        here = {contact.public: str(contact.address) for contact in contacts}
        here[team.identity.public] = str(self._node.entangled.contact.address)
        bootstraps = [member.public for member in team.list_members() if BOOTSTRAP in member.roles]
        return {
            "team": team.membership.team,
            "operator": team.membership_list.operator.hex(),
            "secret": max(
                [team.membership.secrets[0][0], *(each.number for each in team.membership_list.list_secrets())]
            ),
            "entries": [base64.b64encode(packed).decode() for packed in team.membership_list.list_packed()],
            "here": {public.hex(): address for public, address in here.items()},
            # A newcomer cannot use the virtual address of a relay or tunnel.
            "doors": [here[each] for each in bootstraps if each in here and not here[each].startswith("~")],
        }
