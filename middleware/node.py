"""SwarmNode: one Twisted service that connects the packages of the middleware.

Its methods serve a device and its agent: announce the presence, list devices and tasks, submit and follow a
task, request a lease from a task's council, stream camera frames, and call a peer by name.
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
PLACE_CHECK_INTERVAL_S = 0.3
"""Seconds between two checks of a new node whether others took the same place in the order of joining."""
MAX_PLACE_CHECKS = 10
FIGURES_INTERVAL_S = 2.0
"""Seconds between two updates of the node's network figures in its presence; in a large team one minute."""
REVIEW_INTERVAL_S = 10.0
"""Seconds between two checks of the size of the team."""


class SwarmNode(Service):
    """One node of a team.

    ``device`` is the node's own description; ``wall`` returns seconds since the epoch, for display only; ``door`` is
    the admission check.  ``team`` is the closed team of that check, None in an open team; it starts and stops with the
    node.  ``deployed`` holds the modules that operators pushed and the device's owner allowed; ``stop_deployed`` ends
    their processes.  ``halt`` is the stop state of the whole team.  ``later(seconds, call, ...)`` is a timer that ends
    with the node.
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
        self.presence = Presence(self._with_certified_name(device), self._announce, self._chores.later)
        self.streams = Streams(self.entangled.endpoint, clock)
        self.joined: Deferred[None] = Deferred()
        self._known = list(known_nodes)
        self._stop_calls: list[Callable[[], None]] = []
        self._network = network
        self._created_at = clock.seconds()
        self._figures_at = self._reviewed_at = float("-inf")
        self._on_message: Callable[[str], None] = lambda text: None
        self._on_disconnect: Callable[[float], None] = lambda seconds: None
        expose = self.entangled.endpoint.expose
        for verb in LEASE_VERBS:
            # Idempotent: a retransmitted request is executed again, so no reply is cached.
            expose(f"lease.{verb}", partial(self._answer_lease, f"lease.{verb}"), changes=True, idempotent=True)
        expose("bid.offer", self._answer_offer, changes=True, idempotent=True)
        expose("bid.announce", self._answer_announcement, changes=True, idempotent=True)
        expose("bid.cry", self._take_cry, changes=True)
        expose("device.message", self._answer_message, changes=True)
        expose("device.disconnect", self._answer_disconnect, changes=True)

    # -- life -------------------------------------------------------------------------------------------------------

    def startService(self) -> None:
        """Open the port, join the network through the known nodes, and announce this device."""
        super().startService()
        self.entangled.start()
        if self.team is not None:
            self.team.start()
        Deferred.fromCoroutine(self._join()).addErrback(self._log_join_failure)

    def stopService(self) -> None:
        """Send goodbye and close everything except the store, which its opener closes."""
        self._leave(self.entangled.stop)

    def vanish(self) -> None:
        """Stop without sending anything, as after a power failure."""
        self._leave(self.entangled.vanish)

    def _leave(self, leave: Callable[[], None]) -> None:
        self._chores.stop()
        self.streams.stop()
        while self._stop_calls:
            self._stop_calls.pop()()
        if self.team is not None:
            self.team.stop()
        leave()
        self.stop_deployed()
        super().stopService()

    async def _join(self) -> None:
        await self.entangled.join(self._known)
        others = await self._find_others()
        depth = await self.directory.arrive()
        if depth:  # the devices are in other parts of the directory now
            others = await self._find_others()
        previous = [d.joined for d in others if d.uuid == self.uuid]
        self.presence.device = replace(self._with_address(self.presence.device), depth=depth)
        self.presence.appear(previous[0] if previous else _next_place(others))
        device = self.presence.device
        self._log.info("{name} joined as number {joined}", name=device.name, joined=device.joined)
        self._update_figures()
        self._chores.every(FIGURES_INTERVAL_S, self._update_figures)
        self.joined.callback(None)
        await self._resolve_place()

    def _update_figures(self) -> None:
        """Update this node's network figures and directory depth in its presence."""
        entangled, now = self.entangled, self.clock.seconds()
        if now - self._reviewed_at >= REVIEW_INTERVAL_S:
            self._reviewed_at = now
            self.presence.change(
                depth=self.directory.review(), name=self._with_certified_name(self.presence.device).name
            )
        if self.directory.depth and now - self._figures_at < LONGEST:
            return
        self._figures_at = now
        dropped = sum(entangled.endpoint.counters.values())
        contacts, records = len(entangled.overlay.table), len(self.store)
        self.presence.change(network={"contacts": contacts, "records": records, "dropped": dropped})

    async def _resolve_place(self) -> None:
        """Resolve equal places of devices that joined at the same time.

        Each device moves behind all devices with its place and a lower uuid, in one step, so that many devices are
        in order after one exchange of presences, not after one per device.
        """
        for _ in range(MAX_PLACE_CHECKS):
            await self._chores.sleep(PLACE_CHECK_INTERVAL_S)
            others = await self._find_others()
            own_place = self.presence.device.joined
            same = [d for d in others if d.joined == own_place and d.uuid != self.uuid]
            ahead = sum(d.uuid < self.uuid for d in same)
            if ahead:
                self.presence.change(joined=_next_place(others) + ahead - 1)
            elif not same:
                return

    async def _find_others(self) -> list[Device]:
        """Return the present devices (in a large team those around this one); retry until the directory answers."""
        while True:
            try:
                return [device for device, _ in devices_of(await self.directory.around())]
            except NotRunning:
                raise
            except EntangledError as error:
                self._log.info("the directory does not answer; retrying: {error}", error=error)
                await self._chores.sleep(PLACE_CHECK_INTERVAL_S)

    def _with_certified_name(self, device: Device) -> Device:
        """Return ``device`` with the name in its certificate, if it has one."""
        return replace(device, name=self._door.authority(self.entangled.identity.public).name or device.name)

    def _with_address(self, device: Device) -> Device:
        return replace(device, uuid=self.uuid, address=str(self._network.address), since=self.wall())

    def _log_join_failure(self, failure: Any) -> None:
        if failure.check(NotRunning) is None:
            self._log.failure("cannot join", failure)

    # -- devices ----------------------------------------------------------------------------------------------------

    def watch_devices(self, changed: Changed, keep: bool = False) -> Following:
        """Watch the devices of the team; ``devices_of`` reads the records, ``keep`` also stores them.

        In a large team each update takes a round of reads, and ``keep`` has no effect.
        """
        return Following(self.directory, changed, keep)

    def list_devices(self) -> Deferred[Listing]:
        """Fire with all present devices; the list says whether it is complete.  Never fails."""
        return Deferred.fromCoroutine(self.directory.listed())

    def some_devices(
        self, count: int, matches: Matches = lambda device: True, after: bytes | None = None
    ) -> Deferred[Page]:
        """Fire with at most ``count`` devices; see ``Directory.some``.  Never fails."""
        return Deferred.fromCoroutine(self.directory.some(count, matches, after))

    def contact_of(self, record: Record) -> Contact | None:
        """Return the contact of the device that wrote ``record``; the observed address wins over the published one."""
        pair = next(iter(devices_of([record])), None)
        if pair is None:
            return None
        host, _, port = pair[0].address.rpartition(":")
        published = unpacked([record.owner, host, int(port)]) if port.isascii() and port.isdigit() else None
        return published and (self.entangled.overlay.known(published.node_id) or published)

    def team_size(self) -> int:
        """Return the estimated number of nodes in the team, this one included."""
        from middleware.consensus.bidding.scale import team_size

        overlay = self.entangled.overlay
        return team_size(overlay.own_id, overlay.contacts(), overlay.is_large)

    def reached(self, uuids: Sequence[str]) -> list[Contact]:
        """Return the contacts of the given devices that this node knows."""
        return [contact for contact in self.entangled.overlay.contacts() if contact.node_id.hex() in uuids]

    def on_message(self, receive: Callable[[str], None]) -> None:
        """Call ``receive`` with each text that an operator sends to this device."""
        self._on_message = receive

    def on_disconnect(self, leave: Callable[[float], None]) -> None:
        """Call ``leave(seconds)`` when an operator disconnects this device from the network for so many seconds."""
        self._on_disconnect = leave

    # -- tasks ------------------------------------------------------------------------------------------------------

    async def submit(self, task: Task) -> Task:
        """Publish ``task`` with its council, the nodes closest to its key now (rule 1); raise ``UnknownStrategy``."""
        if not is_deployed(task.strategy):  # only nodes with the deployed module can check it
            place_of(task.strategy)
        task = await self.councils.pinned(task)
        await self.entangled.put(TASKS, task.task_id, task.packed(), "team")
        return task

    def watch_tasks(self, changed: Changed, keep: bool = False) -> Watch:
        """Watch the tasks of the team; ``keep`` also stores them."""
        return self.entangled.watch(TASKS, changed, keep)

    def watch_group(self, task_id: str, changed: Changed, keep: bool = False) -> Watch:
        """Watch the reports and the result of one task; ``keep`` also stores them."""
        return self.entangled.watch(group_key(task_id), changed, keep)

    def group(
        self, task: Task, heard: Heard, ordered: Changed = lambda records: None, panel: Panel | None = None
    ) -> Group:
        """Take part in a task, and bid for it if it has a council.

        In a large team only the reporters (``panel``) of a task with a council write records, except for tasks that
        are divided among devices, which need the records of all participants.
        """
        from middleware.consensus.bidding.panel import panel_of

        panel = panel or panel_of(self.uuid, group_key(task.task_id))
        enter = partial(self.bidding, task, task.generation) if task.council else None
        view = self._view(task.strategy) if task.council else None
        devices = self.team_size if task.council and not task.group else lambda: 1
        callbacks = (heard, self._log_failures, ordered, enter, view)
        return Group(task, self.entangled, *callbacks, panel, devices, self.clock.seconds, self.later)

    def bidding(self, task: Task, epoch: int, on_summary: OnSummary) -> Bidding:
        """Bid for ``task`` in ``epoch``; call ``on_summary`` with the bids that the task's council announces."""
        from middleware.consensus.bidding.auction import MAX_WAITING, Auction

        waiting = min(float(task.waiting_period), MAX_WAITING)
        auction = Auction(task.task_id, epoch, task.council, task.strategy, waiting, task.exclusive)
        return self.dissemination.enter(auction, on_summary)

    def order(self, task_id: str, order: bytes) -> Deferred[Stored]:
        """Record an operator's order to a running task (``middleware.tasks.order``, packed)."""
        return self.entangled.put(group_key(task_id), ORDER, order, "team")

    def conclude(self, task_id: str, result: Result) -> Deferred[Stored]:
        """Record the result of a task; this node's role must allow orders."""
        return self.entangled.put(group_key(task_id), RESULT, result.packed(), "team")

    def justify(self, verdict: Verdict) -> None:
        """Publish a decision record of this node's agent; it outlives this node's lease."""
        put = maybeDeferred(self.entangled.put, verdict.key, verdict.slot, verdict.packed(), "team")
        self._log_failures(put)

    async def cancel(self, task: Task, result: Result) -> Stored:
        """Record that ``task`` was cancelled and close its council; return when no agent can act on it.

        If the council is unreachable only the record is written; the acting agent stops when it receives that.
        """
        written = self.conclude(task.task_id, result)
        with suppress(EntangledError):
            await self.councils.of(await self._with_present_council(task)).close()
        return await written

    def strategy(self, name: str) -> Guard:
        """Return the strategy ``name`` in its guard, kept until this node stops; raise ``UnknownStrategy``."""
        return self._strategies.named(name, self.deployed)

    def _view(self, strategy: str) -> View:
        """Return the report fields that a strategy reads; only the costs if it does not exist."""
        from middleware.consensus.view import View, view_of

        try:
            return view_of(self.strategy(strategy))
        except UnknownStrategy:
            return View()

    def lessee(self, task: Task, changed: Callable[[], None], floor: int) -> Lessee:
        """Return this node's proposer for the lease on ``task``; it calls ``changed`` at each change of state.

        ``floor`` is the highest fencing token that the node's device has obeyed; new tokens are higher.
        """
        return self.councils.lessee(task, changed, floor)

    async def _record_council(self, task: Task) -> None:
        """Record the present council of ``task``, unless it or a newer one is recorded already."""
        from middleware.consensus.lease.charter import charter_of

        charter = charter_of(task.charter)
        if charter is not None:
            known = await self._with_present_council(task.with_council(replace(charter, links=())))
            if known.configuration < task.configuration:
                await self.entangled.put(group_key(task.task_id), COUNCIL, task.charter, "team")

    async def _with_present_council(self, task: Task) -> Task:
        """Return ``task`` with the newest council on record."""
        return council_of(task, await self.entangled.get(group_key(task.task_id)))

    @cached_property
    def councils(self) -> Councils:
        """The councils of tasks: this node's acceptors, and its proposers."""
        # Imported on first use: a node without councils saves the memory.
        from middleware.tasks.councils import Councils

        def moved(task: Task) -> None:
            self._log_failures(Deferred.fromCoroutine(self._record_council(task)))

        def may_sit(public: bytes) -> bool:
            return self._door.may(public, "lease.freed")

        return Councils(self.entangled, self.store, self.clock, self.rng, self._created_at, moved, may_sit)

    @cached_property
    def gauge(self) -> Gauge:
        """The quality of the paths to this node's peers."""
        # Imported on first use.
        from middleware.entangled.control.health import Gauge

        return Gauge(self.entangled, self.clock, self._chores)

    @cached_property
    def _strategies(self) -> Strategies:
        """The strategies loaded on this node."""
        # Imported on first use: a node that neither decides nor carries bids saves the memory.
        from middleware.consensus.selection import Strategies

        strategies = Strategies()
        self._stop_calls.append(strategies.stop)
        return strategies

    @cached_property
    def dissemination(self) -> Dissemination:
        """This node's part in flooding the bids for tasks."""
        # Imported on first use: a node that carries no bids saves the memory.
        from middleware.consensus.bidding.auctions import Dissemination, Surroundings

        entangled = self.entangled

        def may_bid(key: bytes, public: bytes) -> bool:
            return entangled.replica.may_store(Slot(key, public, MEMBER))

        around = Surroundings(
            lambda: entangled.contact, entangled.overlay.contacts, self.team_size, self.strategy, may_bid
        )
        dissemination = Dissemination(entangled.identity, entangled.endpoint, around, self.clock, self.rng)
        self._stop_calls.append(dissemination.stop)
        return dissemination

    # -- requests of peers ---------------------------------------------------------------------------------------------

    def _answer_lease(self, method: str, peer: Contact, *arguments: Any) -> object:
        return self.councils.desk.answer(method, peer, arguments)

    def _answer_offer(
        self, peer: Contact, auction: list[object], bids: list[object], age_ms: int, is_shared: bool
    ) -> object:
        offer = partial(self.dissemination.answer_offer, peer, auction, bids, age_ms, is_shared)
        learning = self._learn_bidders(peer, bids)
        return offer() if learning is None else learning.addCallback(lambda _: offer())

    def _answer_announcement(self, peer: Contact, auction: list[object], announcement: list[object]) -> None:
        self.dissemination.answer_announcement(peer, auction, announcement)

    def _take_cry(self, peer: Contact, auction: list[object], bids: list[object]) -> None:
        learning = self._learn_bidders(peer, bids)
        if learning is not None:
            self._log_failures(learning.addCallback(lambda _: self.dissemination.take_cry(peer, auction, bids)))
            return
        self.dissemination.take_cry(peer, auction, bids)

    def _learn_bidders(self, peer: Contact, bids: list[object]) -> Deferred[None] | None:
        """Request missing certificates of bidders from ``peer``; return None if none is missing."""
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
            raise Refused("a device disconnects for more than 0 and at most 3600 seconds")
        # Leave after the answer was sent.
        self._chores.later(0.05, self._on_disconnect, float(seconds))
        return "leaving"

    # -- inside -----------------------------------------------------------------------------------------------------

    def _announce(self, value: bytes) -> None:
        def put() -> Deferred[Any]:
            device = self.presence.device
            return self.directory.announce(device.name, bounded(value), device.depth)

        self._log_failures(maybeDeferred(put))

    def _log_failures(self, work: Deferred[Any]) -> None:
        def ended(failure: Any) -> None:
            if failure.check(WeatherError, NotRunning, Refused) is None:
                self._log.failure("cannot publish to the team", failure)

        work.addErrback(ended)


def _next_place(devices: Sequence[Device]) -> int:
    return max((d.joined for d in devices), default=0) + 1
