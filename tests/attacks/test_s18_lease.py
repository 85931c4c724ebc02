"""Attack S18: take, end or block the lease of another node, or use the name of another device."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

from twisted.internet.defer import Deferred

from middleware.admission.team import Team
from middleware.consensus.bidding.group import Group
from middleware.consensus.lease.lease_client import LeaseClient
from middleware.consensus.lease.lease_codec import pack_members
from middleware.directory.presence import DEVICES, Device, parse_devices
from middleware.entangled.contact import Contact
from middleware.entangled.errors import Refused
from middleware.entangled.identity import Identity
from middleware.entangled.quorum.register import Reply, ReplyKind
from middleware.entangled.record import Record
from middleware.node import SwarmNode
from middleware.tasks.task import COMPLETED, RESULT, TASKS, Result, Task, group_key, parse_tasks
from tests.attacks.siege import SOURCE, SiegeCase
from tests.middleware.admission.village import House, Village

TASK = Task("t1", "search", "Find it")
HUGE = 2**62 - 2
DEVICE_NAME = "dog1"


class LeaseTeam(Village):
    """A closed team of swarm nodes: a gateway and devices."""

    def __init__(self, seed: int = 1, bootstraps: int = 1) -> None:
        self.nodes: list[SwarmNode] = []
        super().__init__(seed, bootstraps=bootstraps)
        for number in range(1, 5):
            self.enlist(f"dog{number}", "device")
        self.run(TASK.lease_ttl)

    def open(self, house: House) -> None:
        place = house.place
        house.team = Team(house.kept, self.store(place), self.wall, self.make_life_rng(place))
        name = house.team.admission.me.name
        node = SwarmNode(
            Device("", name, capabilities={"camera": {"width": 208}}),
            house.team.identity,
            house.team.secret,
            [self.address(0)] if place else [],
            self.switchboard.make_network(*self.address(place)),
            self.store(place),
            self.clock,
            self.make_life_rng(place),
            self.wall,
            admission=house.team.admission,
        )
        house.team.attach(node.entangled, self.clock)
        node.team = house.team
        house.node = node.entangled
        self.nodes.append(node)
        node.startService()

    def close(self, house: House, is_sudden: bool = False) -> None:
        self.nodes[house.place].stopService()


class LeaseCase(SiegeCase):
    """A team with a task, and a malicious member with the role device."""

    def setUp(self) -> None:
        super().setUp()
        self.team = team = self.kept(LeaseTeam())
        self.task: Task = self.outcome(team, Deferred.fromCoroutine(team.nodes[0].submit(TASK)), 1.0)
        self.clients: list[LeaseClient] = []
        self.bad, self.own = self.insider(team, "bad", "device")

    def make_client(self, place: int) -> LeaseClient:
        """Return the lease client of an honest node; it is released when the test ends."""
        make_client = self.team.nodes[place].make_lease_client(self.task, lambda: None, 0)
        self.clients.append(make_client)
        self.addCleanup(self.team.run, 2.0)
        self.addCleanup(make_client.release)
        return make_client

    def held_by(self, place: int, within: float = 1.0) -> LeaseClient:
        """Return the lease client of an honest node after it has won the lease."""
        make_client = self.make_client(place)
        make_client.claim()
        self.team.run(within)
        self.assert_won(make_client)
        return make_client

    def assert_won(self, make_client: LeaseClient) -> None:
        """Check that the client holds the lease, with a token far below the maximum."""
        self.assertIsNotNone(make_client.lease, "an honest node does not win the lease")
        self.assertLess(make_client.token, 2**40)

    def attack(self, method: str, *arguments: object) -> list[Any]:
        """Send the same request to every node; return the answers or errors."""
        found = []
        for house in self.team.houses:
            asked = self.bad.ask(self.team.contact(house), method, *arguments, changes=True)
            found.append(self.outcome(self.team, asked, 0.3))
        return found

    def store(self, *records: Record) -> list[Any]:
        return self.attack("store", [record.pack() for record in records])

    def members(self) -> list[int]:
        """Return the indexes of the council members in the team."""
        known = [house.public for house in self.team.houses]
        return [known.index(member.public) for member in self.task.council]

    def outsiders(self) -> list[int]:
        return [place for place in range(len(self.team.houses)) if place not in self.members()]


class ReconfigurationTests(LeaseCase):
    def test_forged_council(self) -> None:
        """A council that one device invents is not installed, and grants the lease to no second node."""
        holder = self.held_by(self.members()[0])
        others = [self.team.contact(self.team.houses[place]) for place in self.outsiders()]
        own = Contact(self.own.public, SOURCE)
        packed = [contact.pack() for contact in (*others, own)][:3]
        self.attack("lease.install", TASK.task_id, 2, packed, 0, 0, 1.5)
        self.attack("lease.install", TASK.task_id, b"", False, 1.5)
        second = self.make_client(self.outsiders()[0])
        second.claim()
        self.team.run(1.0)
        self.assertIsNotNone(holder.lease)
        self.assertIsNone(second.lease)
        self.assertEqual((second.proposer.configuration, second.proposer.members), (1, self.task.council))

    def test_member_that_lies_about_the_council(self) -> None:
        """A member that returns a wrong council redirects no client."""
        holder = self.held_by(self.members()[0])
        liar, accomplices = self.members()[1], self.outsiders()
        forged = tuple(self.team.contact(self.team.houses[place]) for place in accomplices)
        lease_service: Any = self.team.nodes[liar].council_manager.lease_service
        lease_service._reply_after_write = lambda reply: ["moved", 0, "", 0, 0.0, 9, pack_members(forged)]
        second = self.make_client(accomplices[0])
        second.claim()
        self.team.run(3.0)
        self.assertIsNotNone(holder.lease)
        self.assertIsNone(second.lease)
        self.assertEqual(second.proposer.members, self.task.council)

    def test_council_of_the_device_alone(self) -> None:
        """A council rejects a change to a new council in which the device or invented keys have a majority."""
        own = Contact(self.own.public, SOURCE).pack()
        invented = [Contact(Identity(bytes([n]) * 32).public, SOURCE).pack() for n in range(2)]
        viewer = Contact(self.insider(self.team, "eye", "viewer", at=SOURCE._replace(port=7))[1].public, SOURCE)
        honest = [self.team.contact(house).pack() for house in self.team.houses]
        for council in ([own], [own, honest[0]], [own, *invented], [*honest[:2], viewer.pack()]):
            self.attack("lease.prepare", TASK.task_id, 1, 2**20, 1.5)
            answers = self.attack("lease.change", TASK.task_id, 1, 2**20, council, 0, False)
            self.assertTrue(all(isinstance(answer, Refused) for answer in answers))
        self.held_by(self.outsiders()[0])

    def test_certified_council(self) -> None:
        """A council that the old council signed is installed, and its tokens are higher than the old tokens."""
        holder = self.held_by(self.members()[0])
        token = holder.token
        contacts = [self.team.contact(house) for house in self.team.houses]
        following = [self.task.council[0], *(contacts[place] for place in self.outsiders())]
        self.assertIsNone(self.outcome(self.team, holder.change_council(following), 2.0))
        self.assertEqual((holder.proposer.configuration, list(holder.proposer.members)), (2, following))
        self.assert_won(holder)
        self.assertGreater(holder.token, token)
        links = [holder.proposer.charter.changes[0]] if holder.proposer.charter is not None else []
        self.assertEqual([len(link.votes) for link in links], [2])


class ClosingTests(LeaseCase):
    def test_device_closes(self) -> None:
        """A device without the lease cannot close the task, with any token or as an operator."""
        holder = self.held_by(self.members()[0])
        for token in (0, holder.token, holder.token + 1, HUGE):
            self.attack("lease.close", TASK.task_id, 1, token)
        self.attack("lease.cancel", TASK.task_id, 1)
        self.team.run(2 * TASK.lease_ttl)
        self.assertIsNotNone(holder.lease)
        self.assertFalse(holder.is_over)

    def test_device_closes_before_anybody_acts(self) -> None:
        """A device cannot close a task while no node holds its lease."""
        for token in (0, 1, HUGE):
            self.attack("lease.close", TASK.task_id, 1, token)
        self.attack("lease.cancel", TASK.task_id, 1)
        self.held_by(2)

    def test_operator_closes(self) -> None:
        """The gateway, which may send orders, closes a task while another node holds its lease."""
        holder = self.held_by(self.members()[0])
        council = self.team.nodes[0].council_manager.make_proposer(self.task)
        self.assertIsNone(self.outcome(self.team, council.close(), 4.0))
        self.assertTrue(holder.is_over)

    def test_member_that_says_it_is_over(self) -> None:
        """A client gets the lease even if one council member falsely replies that the task has ended."""
        liar = self.members()[1]
        acceptor: Any = self.team.nodes[liar].council_manager.lease_service._acceptor
        for name in ("prepare", "lease"):
            setattr(acceptor, name, lambda *_, **__: Reply(ReplyKind.OVER))
        self.held_by(self.outsiders()[0], 2.0)


class NumberTests(LeaseCase):
    def test_highest_ballot(self) -> None:
        """After a device has used the highest ballots, other nodes can still get the lease."""
        for counter in (HUGE, HUGE - 1, 2**61, 2**52, 2**40):
            self.attack("lease.prepare", TASK.task_id, 1, counter, 1.5)
        self.held_by(self.outsiders()[0], 3.0)

    def test_highest_token(self) -> None:
        """After a device has proposed the highest tokens, other nodes can still get the lease when it expires."""
        for number in range(1, 4):
            self.attack("lease.prepare", TASK.task_id, 1, number * 2**20, 0.1)
            for token in (HUGE + 1, HUGE, 2**61, 2**53, 2**40):
                self.attack("lease.propose", TASK.task_id, 1, number * 2**20, token, 0.1)
            self.team.run(1.0)
        self.held_by(self.outsiders()[0], 3.0)

    def test_false_news(self) -> None:
        """Notifications with the highest token, sent by a device, do not block any client."""
        place = self.outsiders()[0]
        make_client = self.make_client(place)
        make_client.stand_by(1)
        self.attack("lease.freed", TASK.task_id, HUGE, 0.0)
        make_client.release()
        self.team.run(1.0)
        make_client.claim()
        self.team.run(1.0)
        self.assert_won(make_client)

    def test_member_that_lies_about_numbers(self) -> None:
        """A member that replies with the highest numbers does not block any client."""
        acceptor: Any = self.team.nodes[self.members()[1]].council_manager.lease_service._acceptor
        genuine = acceptor.prepare

        def lie(*arguments: Any) -> Reply:
            reply: Reply = genuine(*arguments)
            return reply._replace(kind=ReplyKind.GRANTED, token=HUGE, promised=reply.promised._replace(counter=HUGE))

        acceptor.prepare = lie
        self.held_by(self.outsiders()[0], 3.0)


class TaskTests(LeaseCase):
    def record(self, key: bytes, name: str, value: bytes, owner: Identity | None = None) -> Record:
        own = owner or self.own
        return Record(key, name, own.public, 2**40, "team", 600.0, value).sign(own)

    def seen(self) -> dict[str, Task]:
        """Return the tasks, which must be the same at every node."""
        all_seen = [parse_tasks(self.outcome(self.team, node.entangled.get(TASKS), 1.0)) for node in self.team.nodes]
        self.assertTrue(all(seen == all_seen[0] for seen in all_seen))
        return all_seen[0]

    def test_task_made_or_altered(self) -> None:
        """A device cannot create a task, or change a task or its council."""
        before = self.seen()
        other = replace(self.task, generation=9, priority=9, council=self.task.council[:1], charter=b"")
        self.store(
            self.record(TASKS, "t1", other.pack()), self.record(TASKS, "t2", replace(other, task_id="t2").pack())
        )
        self.assertEqual(self.seen(), before)

    def test_task_concluded(self) -> None:
        """Every node ignores a record of a device that falsely states that another device's task has ended."""
        heard: dict[int, Result | None] = {}

        def follow(place: int) -> Group:
            node = self.team.nodes[place]
            return node.join_group(self.task, lambda members, outcome: heard.update({place: outcome}))

        groups = [follow(place) for place in range(len(self.team.nodes))]
        holder = self.held_by(self.members()[0])
        forged = Result(COMPLETED, "dog1", 1.0, holder.token + 1).pack()
        key = group_key(TASK.task_id)
        self.store(self.record(key, RESULT, forged), self.record(key, "done", forged))
        self.team.run(2.0)
        for group in groups:
            group.leave()
        self.assertEqual(set(heard.values()) - {None}, set())
        self.assertIsNotNone(holder.lease)


class NameTests(LeaseCase):
    def test_name_of_another(self) -> None:
        """A device that announces itself under the name of another device is not listed under this name."""
        device = Device(self.own.node_id.hex(), DEVICE_NAME, capabilities={"camera": {"width": 208}}, joined=9)
        for slot in (DEVICE_NAME, "bad"):
            self.store(Record(DEVICES, slot, self.own.public, 1, "leased", 60.0, device.pack()).sign(self.own))
        right = replace(device, name="bad")
        listing = self.outcome(self.team, self.team.nodes[0].list_devices(), 2.0)
        self.assertEqual(self.names(listing.records), ["dog1", "dog2", "dog3", "dog4", "vaio"])
        self.store(Record(DEVICES, "bad", self.own.public, 2, "leased", 60.0, right.pack()).sign(self.own))
        listing = self.outcome(self.team, self.team.nodes[0].list_devices(), 2.0)
        self.assertEqual(self.names(listing.records), ["bad", "dog1", "dog2", "dog3", "dog4", "vaio"])

    def test_two_members_of_one_name(self) -> None:
        """If two members have the same name, each is listed with a part of its id after the name."""
        self.team.enlist("dog2", "device")
        self.team.run(2.0)
        listing = self.outcome(self.team, self.team.nodes[0].list_devices(), 2.0)
        twins = [name for name in self.names(listing.records) if name.startswith("dog2")]
        self.assertEqual(twins, sorted(f"dog2-{node.uuid[:6]}" for node in self.twins()))

    def twins(self) -> list[SwarmNode]:
        return [node for node in self.team.nodes if node.presence.device.name == "dog2"]

    def names(self, records: list[Record]) -> list[str]:
        """Return the names under which devices are listed."""
        return sorted(device.name for device, _ in parse_devices(records))
