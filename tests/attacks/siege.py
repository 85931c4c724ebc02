"""Siege: a closed team that lives by the table of roles, and the hands of those who attack it."""

from __future__ import annotations

import random
from typing import Any

from twisted.internet.defer import Deferred

from middleware.admission import roles
from middleware.admission.membership import Membership
from middleware.entangled.contact import Contact
from middleware.entangled.identity import Identity
from middleware.entangled.network.network import Address
from middleware.entangled.network.switchboard import SwitchboardNetwork
from middleware.entangled.wire.door import Authority, Life, OpenDoor
from middleware.entangled.wire.endpoint import Endpoint
from tests.middleware.admission.village import House, Village, VillageCase

SOURCE = Address("10.6.6.6", 666)


class ClosedTeam(Village):
    """A village whose members may do what their roles say."""

    rules = roles
    tape: Tape | None = None

    def open(self, house: House) -> None:
        """Begin a life of a node, of which the tape hears all."""
        super().open(house)
        if self.tape is not None:
            self.tape.tap(network_of(house))

    def enlist(self, name: str, *which: str) -> House:
        """One more member, to whom the operator gave these roles."""
        return self.move_in(self.paper(name, *which))

    def paper(self, name: str, *which: str) -> Membership:
        """The membership of somebody to whom the operator gave these roles."""
        secret = self.houses[0].kept.membership.secrets[0][1]
        return self.signer.founded(name, which or ("device",), self.wall(), self.dice, secret)


class PaperDoor(OpenDoor):
    """The door of an attacker: shows whatever it likes, and lets in everybody."""

    def __init__(self, shown: bytes, room: int = 640, life: int = 1) -> None:
        self.shown = shown
        self.room = room
        self.life = Life(life, b"attacker")
        self.fingerprint = bytes(8)

    def judge(self, public: bytes, shown: bytes) -> str:
        """Everybody."""
        return ""

    def may(self, public: bytes, method: str) -> bool:
        """Everything."""
        return True

    def may_store(self, slot: object) -> bool:
        """Everything."""
        return True

    def may_stay(self, slot: object) -> bool:
        """Everything."""
        return True

    def authority(self, owner: bytes) -> Authority:
        """Everybody has it."""
        return Authority()

    def certificate(self, owner: bytes) -> bytes:
        """Its own, whoever is meant."""
        return self.shown

    def learn(self, owner: bytes, certificate: bytes) -> bool:
        """Any."""
        return True


class SiegeCase(VillageCase):
    """A test of a closed team and of those who attack it."""

    def siege(self, seed: int = 1, bootstraps: int = 1) -> ClosedTeam:
        """A closed team that is stopped when the test ends."""
        team = ClosedTeam(seed, bootstraps=bootstraps)
        self.addCleanup(self.left, team)
        self.addCleanup(team.stop)
        return team

    def attacker(
        self, team: Village, identity: Identity, secret: bytes, shown: bytes, at: Address = SOURCE, life: int = 1
    ) -> Endpoint:
        """An endpoint that shows what it likes, stopped when the test ends."""
        network = team.board.network(*at)
        dice = random.Random(f"attacker {at}")
        endpoint = Endpoint(identity, secret, network, team.clock, dice, PaperDoor(shown, life=life))
        endpoint.start()
        self.addCleanup(endpoint.stop)
        return endpoint

    def insider(self, team: ClosedTeam, name: str, *which: str, at: Address = SOURCE) -> tuple[Endpoint, Identity]:
        """The bare hands of a member with these roles: a good pass, and no manners."""
        paper = team.paper(name, *which)
        secret = paper.secrets[0][1]
        return self.attacker(team, paper.identity, secret, paper.shown, at), paper.identity

    def outcome(self, team: Village, asked: Deferred[Any], within: float = 2.0) -> Any:
        """What came of a question: its answer, or the error."""
        found: list[Any] = []
        asked.addCallbacks(found.append, lambda failure: found.append(failure.value))
        team.run(within)
        return found[0] if found else None


class OneSession:
    """What those who take datagrams look at of a session."""

    def __init__(self, public: bytes, at: Address = SOURCE) -> None:
        self.contact = Contact(public, at)


class Tape:
    """Records what arrives at networks, in the order in which it came, with from where."""

    def __init__(self) -> None:
        self.heard: list[tuple[SwitchboardNetwork, bytes, Address]] = []

    def tap(self, network: SwitchboardNetwork) -> None:
        """Listen in on a network that is open already."""
        receiver = network.receiver
        assert receiver is not None

        def heard(datagram: bytes, source: Address) -> None:
            self.heard.append((network, datagram, source))
            receiver(datagram, source)

        network.receiver = heard


def network_of(house: House) -> SwitchboardNetwork:
    """The port of a house on the board."""
    network: Any = house.node._network
    return network  # type: ignore[no-any-return]
