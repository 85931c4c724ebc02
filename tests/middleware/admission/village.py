"""Complete nodes of a closed team on one virtual clock and one switchboard."""

from __future__ import annotations

import random
from collections.abc import Callable, Sequence
from typing import Any, TypeVar

from twisted.internet.defer import Deferred
from twisted.trial.unittest import SynchronousTestCase

from middleware.admission.join_client import JoinClient
from middleware.admission.join_code import JoinCode, parse_code
from middleware.admission.membership_file import Membership, MemoryMembership
from middleware.admission.operator import Operator
from middleware.admission.team import Team
from middleware.entangled.contact import Contact
from middleware.entangled.errors import NotAdmitted, NotRunning
from middleware.entangled.network.network import Address
from middleware.entangled.network.switchboard import PERFECT, LinkConditions, SwitchboardNetwork
from middleware.entangled.node import EntangledNode
from tests.fleet import Simulation
from tests.middleware.admission.paper import NOW, operator

FIRST = ("device", "operator", "gateway", "bootstrap")
DAY = 86_400.0


class Tape:
    """Records the datagrams that networks receive, in order, with their source."""

    def __init__(self) -> None:
        self.heard: list[tuple[SwitchboardNetwork, bytes, Address]] = []

    def tap(self, network: SwitchboardNetwork) -> None:
        """Record the datagrams that ``network`` receives; it must be open."""
        receiver = network.receiver
        assert receiver is not None

        def heard(datagram: bytes, source: Address) -> None:
            self.heard.append((network, datagram, source))
            receiver(datagram, source)

        network.receiver = heard


class House:
    """One node, the object for its team, and the membership that is kept when the node restarts."""

    def __init__(self, place: int, kept: MemoryMembership) -> None:
        self.place = place
        self.kept = kept
        self.team: Team
        self.node: EntangledNode

    @property
    def name(self) -> str:
        return self.team.admission.me.name

    @property
    def public(self) -> bytes:
        return self.kept.membership.identity.public


class Village(Simulation):
    """A closed team; ``signer`` is its operator, and by default the first node publishes the operator's statements.

    The wall clock is ``days`` ahead of the virtual clock. ``tape`` records the datagrams that are received by nodes
    opened after it was set.
    """

    days = 0.0
    tape: Tape | None = None

    def __init__(self, seed: int = 1, weather: LinkConditions = PERFECT, bootstraps: int = 1) -> None:
        super().__init__(seed, weather)
        self.signer: Operator = operator(seed)
        self.houses: list[House] = []
        self.dice = random.Random(f"{seed}/village")
        first = self.signer.create_membership("vaio", FIRST, self.wall(), self.dice)
        for number in range(bootstraps):
            secret = first.secrets[0][1]
            other = self.signer.create_membership(f"boot{number}", FIRST, self.wall(), self.dice, secret)
            self.move_in(other if number else first)

    def wall(self) -> float:
        """Return the time of the wall clock, which all nodes share."""
        return NOW + self.clock.seconds() + self.days * DAY

    def move_in(self, membership: Membership) -> House:
        """Start a node with this membership and let it join."""
        house = House(len(self.houses), MemoryMembership(membership))
        self.houses.append(house)
        self.open(house)
        self.run(0.5)
        return house

    def paper(self, name: str, *which: str) -> Membership:
        """Return the membership of a node to which the operator granted these roles."""
        secret = self.houses[0].kept.membership.secrets[0][1]
        return self.signer.create_membership(name, which or ("device",), self.wall(), self.dice, secret)

    def enlist(self, name: str, *which: str) -> House:
        """Add a member to which the operator grants these roles."""
        return self.move_in(self.paper(name, *which))

    def open(self, house: House) -> None:
        place = house.place
        house.team = Team(house.kept, self.store(place), self.wall, self.make_life_rng(place))
        network = self.switchboard.make_network(*self.address(place))
        house.node = EntangledNode(
            house.team.identity,
            house.team.secret,
            network,
            self.store(place),
            self.clock,
            self.make_life_rng(place),
            wall=self.wall,
            admission=house.team.admission,
        )
        house.team.attach(house.node, self.clock)
        house.node.start()
        house.team.start()
        if self.tape is not None:
            self.tape.tap(network_of(house))
        known = [self.address(0)] if place else []
        # A rejected node may be closed before it has joined.
        house.node.join(known).addErrback(lambda failure: failure.trap(NotRunning))

    def close(self, house: House, is_sudden: bool = False) -> None:
        house.team.stop()
        if is_sudden:
            house.node.stop_silently()
        else:
            house.node.stop()

    def tell(self, packed: bytes, house: int = 0) -> Deferred[str]:
        """Publish a statement of the operator at a node."""
        return Deferred.fromCoroutine(self.houses[house].team.publish(packed))

    def invite(self, name: str = "dog", uses: int = 1, expires: float = 3600.0, house: int = 0) -> str:
        """Return a code that is valid from now on."""
        code, packed, terms = self.signer.invite(name, ("device",), uses, self.wall(), expires, self.dice)
        told: list[str] = []
        for each in (terms, packed):
            self.tell(each, house).addCallback(told.append)
        self.run(1.0)
        assert told == ["terms", "invite"]
        return code.text

    def knock(
        self, code: str, doors: Sequence[int] = (0,), wish: str = "", seed: bytes = b"", timeout: float = 20.0
    ) -> Deferred[Membership]:
        """Start a newcomer that sends join requests to these nodes."""
        self.life_count += 1
        network = self.switchboard.make_network("10.0.0.2", 9000 + self.life_count)
        read_code: JoinCode = parse_code(code)
        newcomer = JoinClient(read_code, seed or self.dice.randbytes(32), network, self.clock, self.dice, wish)
        return newcomer.join([self.address(door) for door in doors], timeout)

    def welcome(self, name: str = "dog", doors: Sequence[int] = (0,)) -> House:
        """Add a member that joins with a new code."""
        found: list[Membership] = []
        self.knock(self.invite(name), doors).addCallback(found.append)
        self.run(1.5)
        return self.move_in(found[0])

    def members(self, house: int = 0) -> list[str]:
        return [member.name for member in self.houses[house].team.list_members()]

    def address_of(self, house: House) -> Address:
        return self.address(house.place)

    def contact(self, house: House) -> Contact:
        return Contact(house.public, self.address(house.place))

    def stop(self) -> None:
        for house in self.houses:
            self.close(house)


AnyVillage = TypeVar("AnyVillage", bound=Village)


def network_of(house: House) -> SwitchboardNetwork:
    """Return the switchboard port of a node."""
    network: Any = house.node._network
    return network  # type: ignore[no-any-return]


class VillageCase(SynchronousTestCase):
    """A test with a simulated team; no timer may remain on its clock afterwards."""

    def village(self, seed: int = 1, bootstraps: int = 1) -> Village:
        """Return a simulated team that is stopped when the test ends."""
        return self.kept(Village(seed, bootstraps=bootstraps))

    def kept(self, village: AnyVillage) -> AnyVillage:
        """Stop ``village`` when the test ends; return it."""
        self.addCleanup(self.left, village)
        self.addCleanup(village.stop)
        return village

    def outcome(self, village: Village, asked: Deferred[Any], within: float = 2.0) -> Any:
        """Return the result of a request: its value or its error."""
        found: list[Any] = []
        asked.addCallbacks(found.append, lambda failure: found.append(failure.value))
        village.run(within)
        return found[0] if found else None

    def refusal(self, village: Village, ask: Callable[..., Deferred[Any]], house: House, within: float = 2.0) -> str:
        """Return the code with which the node of ``house`` rejects the node that owns ``ask``, or "" if it answers."""
        answer = self.outcome(village, ask(village.contact(house), "ping", bytes(8), changes=True), within)
        if isinstance(answer, NotAdmitted):
            return str(answer.code)
        self.assertIsInstance(answer, bytes)
        return ""

    def left(self, village: Village) -> None:
        """Check that no timer is pending, only datagrams in transit."""
        village.run(1.0)  # deliver the datagrams in transit
        calls = village.clock.getDelayedCalls()
        self.assertEqual(calls, [], "a node left a timer behind")
