"""SwarmNode: one Twisted service that wires the rooms of the middleware; it decides nothing itself.

What a device can do with its team goes through here: be present, see the devices and tasks, submit and follow a task,
ask the council for a lease, send a camera's frames, and call a peer by name.
"""

from __future__ import annotations

import random
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import replace
from functools import cached_property, partial
from typing import TYPE_CHECKING, Any

from twisted.application.service import Service
from twisted.internet.defer import Deferred, maybeDeferred
from twisted.internet.interfaces import IReactorTime
from twisted.logger import Logger

from middleware.consensus.bidding.group import Group, Heard
from middleware.consensus.deployed import Deployed, is_deployed
from middleware.consensus.strategy import place_of
from middleware.directory.directory import Directory, Matches, Page
from middleware.directory.following import Following
from middleware.directory.listing import Listing
from middleware.directory.prefix import LONGEST
from middleware.directory.presence import Device, Presence, devices_of
from middleware.entangled.background import Background
from middleware.entangled.contact import Contact, unpacked
from middleware.entangled.data.store import Store
from middleware.entangled.errors import EntangledError, NotRunning, Refused, WeatherError
from middleware.entangled.identity import Identity
from middleware.entangled.network.multicast import Multicast
from middleware.entangled.network.network import Address, Network
from middleware.entangled.node import EntangledNode
from middleware.entangled.record import Record, Slot
from middleware.entangled.replication.owner import Stored
from middleware.entangled.replication.watch import Changed, Watch
from middleware.entangled.streams import Streams
from middleware.entangled.value import bounded
from middleware.entangled.wire.door import OPEN, Door
from middleware.errors import UnknownStrategy
from middleware.stop.halt import Halt
from middleware.tasks.task import COUNCIL, MEMBER, ORDER, RESULT, TASKS, Result, Task, council_of, group_key

if TYPE_CHECKING:
    from middleware.admission.team import Team
    from middleware.consensus.bidding.auctions import Bidding, Dissemination
    from middleware.consensus.bidding.panel import Panel
    from middleware.consensus.bidding.party import OnSummary
    from middleware.consensus.guard import Guard
    from middleware.consensus.lease.lessee import Lessee
    from middleware.consensus.selection import Strategies
    from middleware.consensus.verdict import Verdict
    from middleware.consensus.view import View
    from middleware.entangled.control.health import Gauge
    from middleware.tasks.councils import Councils

CAMERA = "camera"
LEASE_VERBS = ("prepare", "propose", "release", "close", "cancel", "change", "install", "freed")
LOOK_AGAIN = 0.3
"""Seconds after which a newcomer looks whether others took the same place in the order of joining."""
LOOKS = 10
COUNTING = 2.0
"""Seconds between two looks at the node's own network figures; in a large team they are told once a minute."""
REVIEWING = 10.0
"""Seconds between two looks at the size of the team."""


class SwarmNode(Service):
    """One node of a team.

    ``team`` is the closed team whose ``door`` the node has, None in an open one; it starts and stops with the node.
    ``device`` is what the node says of itself; ``wall`` gives seconds of the wall clock, for people only.  ``deployed``
    is what operators pushed and its owner allowed, ``stop_deployed`` ends its processes; ``halt`` says whether the
    whole team is to stand.
    ``later(seconds, call, ...)`` is a timer that ends with the node.
    """

    _log = Logger()

    def __init__(
        self,
        device: Device,
        identity: Identity,
        team_key: bytes,
        known_nodes: Sequence[Address],
        network: Network,
        store: Store,
        clock: IReactorTime,
        rng: random.Random,
        wall: Callable[[], float],
        lease: float = 1.0,
        door: Door = OPEN,
        lan: Multicast | None = None,
    ) -> None:
        self.clock = clock
        self.rng = rng
        self.wall = wall
        self.store = store
        self.entangled = EntangledNode(identity, team_key, network, store, clock, rng, lease, wall, door, lan)
        self.uuid = identity.node_id.hex()
        self._door = door
        self._chores = Background(clock)
        self.later = self._chores.later
        self.team: Team | None = None
        self.deployed: Deployed = {}
        self.stop_deployed: Callable[[], None] = lambda: None
        self.halt = Halt()
        self.directory = Directory(self.entangled, self._chores)
        self.presence = Presence(self._named(device), self._announce, self._chores.later)
        self.streams = Streams(self.entangled.endpoint, clock)
        self.joined: Deferred[None] = Deferred()
        self._known = list(known_nodes)
        self._ends: list[Callable[[], None]] = []
        self._network = network
        self._born_at = clock.seconds()
        self._counted_at = self._reviewed_at = float("-inf")
        self._on_message: Callable[[str], None] = lambda text: None
        self._on_disconnect: Callable[[float], None] = lambda seconds: None
        expose = self.entangled.endpoint.expose
        for verb in LEASE_VERBS:
            # To repeat what a council member is asked does no harm; nothing need be kept of the first time.
            expose(f"lease.{verb}", partial(self._answer_lease, f"lease.{verb}"), changes=True, idempotent=True)
        expose("bid.offer", self._answer_offer, changes=True, idempotent=True)
        expose("bid.announce", self._answer_announcement, changes=True, idempotent=True)
        expose("bid.cry", self._take_cry, changes=True)
        expose("device.message", self._answer_message, changes=True)
        expose("device.disconnect", self._answer_disconnect, changes=True)

    # -- life -------------------------------------------------------------------------------------------------------

    def startService(self) -> None:
        """Open the port, join the network through the known nodes, and appear among the devices."""
        super().startService()
        self.entangled.start()
        if self.team is not None:
            self.team.start()
        Deferred.fromCoroutine(self._join()).addErrback(self._not_joined)

    def stopService(self) -> None:
        """Say goodbye and close everything but the store, which belongs to whoever opened it."""
        self._leave(self.entangled.stop)

    def vanish(self) -> None:
        """Leave without a word, as when the power fails."""
        self._leave(self.entangled.vanish)

    def _leave(self, leave: Callable[[], None]) -> None:
        self._chores.stop()
        self.streams.stop()
        while self._ends:
            self._ends.pop()()
        if self.team is not None:
            self.team.stop()
        leave()
        self.stop_deployed()
        super().stopService()

    async def _join(self) -> None:
        await self.entangled.join(self._known)
        others = await self._others()
        depth = await self.directory.arrive()
        if depth:  # those seen so far stand elsewhere
            others = await self._others()
        kept = [d.joined for d in others if d.uuid == self.uuid]
        self.presence.device = replace(self._addressed(self.presence.device), depth=depth)
        self.presence.appear(kept[0] if kept else _next_place(others))
        device = self.presence.device
        self._log.info("{name} joined as number {joined}", name=device.name, joined=device.joined)
        self._count()
        self._chores.every(COUNTING, self._count)
        self.joined.callback(None)
        await self._step_behind()

    def _count(self) -> None:
        """Say how this node stands in the network (the page's network data), and where in the directory."""
        entangled, now = self.entangled, self.clock.seconds()
        if now - self._reviewed_at >= REVIEWING:
            self._reviewed_at = now
            self.presence.change(depth=self.directory.review(), name=self._named(self.presence.device).name)
        if self.directory.depth and now - self._counted_at < LONGEST:
            return
        self._counted_at = now
        dropped = sum(entangled.endpoint.counters.values())
        contacts, records = len(entangled.overlay.table), len(self.store)
        self.presence.change(network={"contacts": contacts, "records": records, "dropped": dropped})

    async def _step_behind(self) -> None:
        """Those that join at the same moment take the same place: each steps behind all those whose uuid is lower.

        All at once, so that a crowd is in order as soon as it has seen itself, and not after as many looks as it has
        heads, with a record of each for each of them.
        """
        for _ in range(LOOKS):
            await self._chores.sleep(LOOK_AGAIN)
            others = await self._others()
            mine = self.presence.device.joined
            same = [d for d in others if d.joined == mine and d.uuid != self.uuid]
            ahead = sum(d.uuid < self.uuid for d in same)
            if ahead:
                self.presence.change(joined=_next_place(others) + ahead - 1)
            elif not same:
                return

    async def _others(self) -> list[Device]:
        """The devices that are here, in a large team those around this one, as soon as anybody can tell."""
        while True:
            try:
                return [device for device, _ in devices_of(await self.directory.around())]
            except NotRunning:
                raise
            except EntangledError as error:
                self._log.info("nobody says who is here; asking again: {error}", error=error)
                await self._chores.sleep(LOOK_AGAIN)

    def _named(self, device: Device) -> Device:
        """The device under the name of its certificate, where the team gives certificates."""
        return replace(device, name=self._door.authority(self.entangled.identity.public).name or device.name)

    def _addressed(self, device: Device) -> Device:
        return replace(device, uuid=self.uuid, address=str(self._network.address), since=self.wall())

    def _not_joined(self, failure: Any) -> None:
        if failure.check(NotRunning) is None:
            self._log.failure("while joining", failure)

    # -- devices ----------------------------------------------------------------------------------------------------

    def watch_devices(self, changed: Changed, keep: bool = False) -> Following:
        """Follow who is here; ``devices_of`` reads the records, and ``keep`` leaves them in the store as well.

        In a large team that is for those who need all of them: it takes a round of reads, and none are kept.
        """
        return Following(self.directory, changed, keep)

    def list_devices(self) -> Deferred[Listing]:
        """All devices that are here now; the list knows whether it is complete.  Never fails."""
        return Deferred.fromCoroutine(self.directory.listed())

    def some_devices(
        self, count: int, matches: Matches = lambda device: True, after: bytes | None = None
    ) -> Deferred[Page]:
        """Some of the devices, where a page has no room for all; see ``Directory.some``.  Never fails."""
        return Deferred.fromCoroutine(self.directory.some(count, matches, after))

    def contact_of(self, record: Record) -> Contact | None:
        """How to reach the device that wrote ``record``: where it is seen, which may be elsewhere than it says."""
        pair = next(iter(devices_of([record])), None)
        if pair is None:
            return None
        host, _, port = pair[0].address.rpartition(":")
        said = unpacked([record.owner, host, int(port)]) if port.isascii() and port.isdigit() else None
        return said and (self.entangled.overlay.known(said.node_id) or said)

    def team_size(self) -> int:
        """About how many nodes the team has, this one included."""
        from middleware.consensus.bidding.scale import team_size

        overlay = self.entangled.overlay
        return team_size(overlay.own_id, overlay.contacts(), overlay.is_large)

    def reached(self, uuids: Sequence[str]) -> list[Contact]:
        """How to reach those of the devices that this node has met."""
        return [contact for contact in self.entangled.overlay.contacts() if contact.node_id.hex() in uuids]

    def on_message(self, receive: Callable[[str], None]) -> None:
        """Call ``receive`` with each text that an operator sends to this device."""
        self._on_message = receive

    def on_disconnect(self, leave: Callable[[float], None]) -> None:
        """Call ``leave`` with seconds when an operator takes this device off the network for that long."""
        self._on_disconnect = leave

    # -- tasks ------------------------------------------------------------------------------------------------------

    async def submit(self, task: Task) -> Task:
        """Publish ``task`` with the council pinned: the nodes closest to its key now (consensus rule 1).

        Raises ``UnknownStrategy`` where there is no strategy of the name that it gives.
        """
        if not is_deployed(task.strategy):  # those are the business of the nodes that have them
            place_of(task.strategy)
        task = await self.councils.pinned(task)
        await self.entangled.put(TASKS, task.task_id, task.packed(), "team")
        return task

    def watch_tasks(self, changed: Changed, keep: bool = False) -> Watch:
        """Follow the tasks of the team; ``keep`` leaves them in the store as well."""
        return self.entangled.watch(TASKS, changed, keep)

    def watch_group(self, task_id: str, changed: Changed, keep: bool = False) -> Watch:
        """Follow the reports and the outcome of one task; ``keep`` leaves them in the store as well."""
        return self.entangled.watch(group_key(task_id), changed, keep)

    def group(
        self, task: Task, heard: Heard, ordered: Changed = lambda records: None, panel: Panel | None = None
    ) -> Group:
        """Take part in a task: a place among its participants.  Where it has a council, bids go there, too.

        Then, in a large team, a ``panel`` writes records for all; tasks that are divided together need all of them.
        """
        from middleware.consensus.bidding.panel import panel_of

        panel = panel or panel_of(self.uuid, group_key(task.task_id))
        enter = partial(self.bidding, task, task.generation) if task.council else None
        view = self._view(task.strategy) if task.council else None
        devices = self.team_size if task.council and not task.group else lambda: 1
        told = (heard, self._quietly, ordered, enter, view)
        return Group(task, self.entangled, *told, panel, devices, self.clock.seconds, self.later)

    def bidding(self, task: Task, epoch: int, on_summary: OnSummary) -> Bidding:
        """Bid for ``task`` in ``epoch``: ``on_summary`` is told which bids the task's council announces."""
        from middleware.consensus.bidding.auction import MAX_WAITING, Auction

        waiting = min(float(task.waiting_period), MAX_WAITING)
        auction = Auction(task.task_id, epoch, task.council, task.strategy, waiting, task.exclusive)
        return self.dissemination.enter(auction, on_summary)

    def order(self, task_id: str, order: bytes) -> Deferred[Stored]:
        """Record what an operator wants of a task that is under way (``middleware.tasks.order``, packed)."""
        return self.entangled.put(group_key(task_id), ORDER, order, "team")

    def conclude(self, task_id: str, result: Result) -> Deferred[Stored]:
        """Record how a task ended, as a node that may order tasks."""
        return self.entangled.put(group_key(task_id), RESULT, result.packed(), "team")

    def justify(self, verdict: Verdict) -> None:
        """Record why this node's agent decided so; stays when this node goes."""
        put = maybeDeferred(self.entangled.put, verdict.key, verdict.slot, verdict.packed(), "team")
        self._quietly(put)

    async def cancel(self, task: Task, result: Result) -> Stored:
        """Record that ``task`` was cancelled, and have its council grant nothing more; done when nobody can act on it.

        Where the council cannot be reached the record alone has to do, and who acts stops when it hears of it.
        """
        written = self.conclude(task.task_id, result)
        with suppress(EntangledError):
            await self.councils.of(await self._present(task)).close()
        return await written

    def strategy(self, name: str) -> Guard:
        """The strategy of that name behind its guard, for as long as this node is here.

        Raises ``UnknownStrategy`` where there is none.
        """
        return self._strategies.named(name, self.deployed)

    def _view(self, strategy: str) -> View:
        """What the strategy of that name goes by; where there is none, the nearest does."""
        from middleware.consensus.view import View, view_of

        try:
            return view_of(self.strategy(strategy))
        except UnknownStrategy:
            return View()

    def lessee(self, task: Task, changed: Callable[[], None], floor: int) -> Lessee:
        """The claimant of the right to act on ``task``, in this node's name.

        ``floor`` is the highest token that the node's own device has obeyed, so that a new token is always higher.
        """
        return self.councils.lessee(task, changed, floor)

    async def _record(self, task: Task) -> None:
        """Record the present council of ``task``, unless that or a newer one is recorded already."""
        from middleware.consensus.lease.charter import charter_of

        charter = charter_of(task.charter)
        if charter is not None:
            known = await self._present(task.with_council(replace(charter, links=())))
            if known.configuration < task.configuration:
                await self.entangled.put(group_key(task.task_id), COUNCIL, task.charter, "team")

    async def _present(self, task: Task) -> Task:
        """``task`` with its present council, as far as it is recorded."""
        return council_of(task, await self.entangled.get(group_key(task.task_id)))

    @cached_property
    def councils(self) -> Councils:
        """The councils of the team's tasks: where this node sits in them, and how it asks them."""
        # Imported by the first who calls it to one: a node that is in none is spared the memory.
        from middleware.tasks.councils import Councils

        def moved(task: Task) -> None:
            self._quietly(Deferred.fromCoroutine(self._record(task)))

        def may_sit(public: bytes) -> bool:
            return self._door.may(public, "lease.freed")

        return Councils(self.entangled, self.store, self.clock, self.rng, self._born_at, moved, may_sit)

    @cached_property
    def gauge(self) -> Gauge:
        """How good the ways to this node's peers are."""
        # Imported by the first who wants to know.
        from middleware.entangled.control.health import Gauge

        return Gauge(self.entangled, self.clock, self._chores)

    @cached_property
    def _strategies(self) -> Strategies:
        """What decides on this node who should act."""
        # Imported by the first who decides, or carries a bid: a node that does neither is spared the memory.
        from middleware.consensus.selection import Strategies

        strategies = Strategies()
        self._ends.append(strategies.stop)
        return strategies

    @cached_property
    def dissemination(self) -> Dissemination:
        """How the bids for tasks travel through this node."""
        # Imported by the first bid: a node that never carries one is spared the memory.
        from middleware.consensus.bidding.auctions import Dissemination, Surroundings

        entangled = self.entangled

        def may_bid(key: bytes, public: bytes) -> bool:
            return entangled.replica.may_store(Slot(key, public, MEMBER))

        around = Surroundings(
            lambda: entangled.contact, entangled.overlay.contacts, self.team_size, self.strategy, may_bid
        )
        dissemination = Dissemination(entangled.identity, entangled.endpoint, around, self.clock, self.rng)
        self._ends.append(dissemination.stop)
        return dissemination

    # -- what peers ask ---------------------------------------------------------------------------------------------

    def _answer_lease(self, method: str, peer: Contact, *arguments: Any) -> object:
        return self.councils.desk.answer(method, peer, arguments)

    def _answer_offer(
        self, peer: Contact, auction: list[object], bids: list[object], age_ms: int, is_shared: bool
    ) -> object:
        offer = partial(self.dissemination.answer_offer, peer, auction, bids, age_ms, is_shared)
        learnt = self._learn_bidders(peer, bids)
        return offer() if learnt is None else learnt.addCallback(lambda _: offer())

    def _answer_announcement(self, peer: Contact, auction: list[object], announcement: list[object]) -> None:
        self.dissemination.answer_announcement(peer, auction, announcement)

    def _take_cry(self, peer: Contact, auction: list[object], bids: list[object]) -> None:
        learnt = self._learn_bidders(peer, bids)
        if learnt is not None:
            self._quietly(learnt.addCallback(lambda _: self.dissemination.take_cry(peer, auction, bids)))
            return
        self.dissemination.take_cry(peer, auction, bids)

    def _learn_bidders(self, peer: Contact, bids: list[object]) -> Deferred[None] | None:
        """Ask ``peer`` for the certificates of those bidders that are unknown here; None where all are known."""
        from middleware.consensus.bidding.errand import MAX_BIDS

        certificates = self.entangled.replica.certificates
        owners = [each[0] for each in bids[:MAX_BIDS] if isinstance(each, list) and each and type(each[0]) is bytes]
        if not certificates.lacking(peer, owners):
            return None
        return Deferred.fromCoroutine(certificates.learn(peer, owners))

    def _answer_message(self, peer: Contact, text: str) -> str:
        if not 0 < len(text) <= 200:
            raise Refused("a message is a text of 1 to 200 characters")
        self._on_message(text)
        self.presence.say(self.wall(), f"operator: {text}")
        return "delivered"

    def _answer_disconnect(self, peer: Contact, seconds: float) -> str:
        if not 0 < seconds <= 3600:
            raise Refused("a device leaves for more than 0 and at most 3600 seconds")
        # After the answer is out.
        self._chores.later(0.05, self._on_disconnect, float(seconds))
        return "leaving"

    # -- inside -----------------------------------------------------------------------------------------------------

    def _announce(self, value: bytes) -> None:
        def put() -> Deferred[Any]:
            device = self.presence.device
            return self.directory.announce(device.name, bounded(value), device.depth)

        self._quietly(maybeDeferred(put))

    def _quietly(self, work: Deferred[Any]) -> None:
        def ended(failure: Any) -> None:
            if failure.check(WeatherError, NotRunning, Refused) is None:
                self._log.failure("while telling the team", failure)

        work.addErrback(ended)


def _next_place(devices: Sequence[Device]) -> int:
    return max((d.joined for d in devices), default=0) + 1
