"""SwarmNode: one Twisted service that connects the packages of the middleware.

Its methods serve a device and its agent: announce the presence, list devices and tasks, submit and follow a task,
request a lease from a task's council, stream camera frames, and call methods of peers.
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

from middleware.consensus.bidding.group import Group, OnMembers
from middleware.consensus.deployed_modules import DeployedModules, is_deployed
from middleware.consensus.strategy import find_import_path
from middleware.directory.directory import Directory, Matches, Page
from middleware.directory.listing import Listing
from middleware.directory.prefix import MAX_LEASE_S
from middleware.directory.presence import Device, Presence, parse_devices
from middleware.directory.subscription import DeviceSubscription
from middleware.entangled.background import Background
from middleware.entangled.contact import Contact, parse_contact
from middleware.entangled.data.store import Store
from middleware.entangled.errors import EntangledError, NotRunning, Refused, TransientError
from middleware.entangled.identity import Identity
from middleware.entangled.network.multicast import Multicast
from middleware.entangled.network.network import Address, Network
from middleware.entangled.node import EntangledNode
from middleware.entangled.record import Record, Slot
from middleware.entangled.replication.owner import Stored
from middleware.entangled.replication.watch import OnChanged, Watch
from middleware.entangled.streams import Streams
from middleware.entangled.value import check_size
from middleware.entangled.wire.admission_check import OPEN_ADMISSION, AdmissionCheck
from middleware.errors import UnknownStrategy
from middleware.stop.stop_state import StopState
from middleware.tasks.task import COUNCIL, MEMBER, ORDER, RESULT, TASKS, Result, Task, group_key, with_newest_council

if TYPE_CHECKING:
    from middleware.admission.team import Team
    from middleware.consensus.bidding.auction_service import AuctionService, Bidding
    from middleware.consensus.bidding.participant import OnSummary
    from middleware.consensus.bidding.reporters import Reporters
    from middleware.consensus.decision_record import DecisionRecord
    from middleware.consensus.guarded_strategy import GuardedStrategy
    from middleware.consensus.lease.lease_client import LeaseClient
    from middleware.consensus.report_view import ReportView
    from middleware.consensus.strategy_registry import StrategyRegistry
    from middleware.entangled.control.health import LinkMetrics
    from middleware.tasks.council_manager import CouncilManager

CAMERA = "camera"
LEASE_VERBS = ("prepare", "propose", "release", "close", "cancel", "change", "install", "freed")
PLACE_CHECK_INTERVAL_S = 0.3
"""A new node checks at this interval in seconds whether other devices have the same number in the order of joining."""
MAX_PLACE_CHECKS = 10
FIGURES_INTERVAL_S = 2.0
"""Seconds between two updates of the node's network figures in its presence; one minute in a large team."""
REVIEW_INTERVAL_S = 10.0
"""Seconds between two checks of the size of the team."""


class SwarmNode(Service):
    """One node of a team.

    ``device`` is the node's own description; ``wall`` returns seconds since the epoch, for display only; ``admission``
    is the admission check.  ``team`` is the closed team that the check protects, None in an open team; it is started
    and stopped with the node.  ``deployed`` contains the modules that operators pushed and the device's owner allowed;
    ``stop_deployed`` ends the processes of these modules.  ``stop_state`` is the stop state of the whole team.
    ``later(seconds, call, ...)`` calls ``call`` after ``seconds``, unless the node is stopped first.
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
        admission: AdmissionCheck = OPEN_ADMISSION,
        lan: Multicast | None = None,
    ) -> None:
        self.clock = clock
        self.rng = rng
        self.wall = wall
        self.store = store
        self.entangled = EntangledNode(identity, team_key, network, store, clock, rng, lease, wall, admission, lan)
        self.uuid = identity.node_id.hex()
        self._admission = admission
        self._background = Background(clock)
        self.later = self._background.later
        self.team: Team | None = None
        self.deployed: DeployedModules = {}
        self.stop_deployed: Callable[[], None] = lambda: None
        self.stop_state = StopState()
        self.directory = Directory(self.entangled, self._background)
        self.presence = Presence(self._with_certified_name(device), self._announce, self._background.later)
        self.streams = Streams(self.entangled.endpoint, clock)
        self.joined: Deferred[None] = Deferred()
        self._known_nodes = list(known_nodes)
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
        expose("bid.cry", self._answer_flood, changes=True)
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
        """Send goodbye and close everything except the store, which is closed by the code that opened it."""
        self._leave(self.entangled.stop)

    def stop_silently(self) -> None:
        """Stop without sending anything, as after a power failure."""
        self._leave(self.entangled.stop_silently)

    def _leave(self, leave: Callable[[], None]) -> None:
        self._background.stop()
        self.streams.stop()
        while self._stop_calls:
            self._stop_calls.pop()()
        if self.team is not None:
            self.team.stop()
        leave()
        self.stop_deployed()
        super().stopService()

    async def _join(self) -> None:
        await self.entangled.join(self._known_nodes)
        others = await self._find_others()
        depth = await self.directory.choose_initial_depth()
        if depth:  # at the new depth, the neighbourhood contains different devices
            others = await self._find_others()
        previous = [d.joined for d in others if d.uuid == self.uuid]
        self.presence.device = replace(self._with_address(self.presence.device), depth=depth)
        self.presence.appear(previous[0] if previous else _next_place(others))
        device = self.presence.device
        self._log.info("{name} joined as number {joined}", name=device.name, joined=device.joined)
        self._update_figures()
        self._background.every(FIGURES_INTERVAL_S, self._update_figures)
        self.joined.callback(None)
        await self._resolve_place()

    def _update_figures(self) -> None:
        """Update this node's network figures and directory depth in its presence."""
        entangled, now = self.entangled, self.clock.seconds()
        if now - self._reviewed_at >= REVIEW_INTERVAL_S:
            self._reviewed_at = now
            self.presence.change(
                depth=self.directory.update_depth(), name=self._with_certified_name(self.presence.device).name
            )
        if self.directory.depth and now - self._figures_at < MAX_LEASE_S:
            return
        self._figures_at = now
        dropped = sum(entangled.endpoint.counters.values())
        contacts, records = len(entangled.overlay.table), len(self.store)
        self.presence.change(network={"contacts": contacts, "records": records, "dropped": dropped})

    async def _resolve_place(self) -> None:
        """Resolve equal numbers of devices that joined at the same time.

        In one step, each device moves behind all devices that have the same number and a lower uuid.  So even many
        devices are in order after one exchange of presences, instead of one exchange per device.
        """
        for _ in range(MAX_PLACE_CHECKS):
            await self._background.sleep(PLACE_CHECK_INTERVAL_S)
            others = await self._find_others()
            own_place = self.presence.device.joined
            same = [d for d in others if d.joined == own_place and d.uuid != self.uuid]
            ahead = sum(d.uuid < self.uuid for d in same)
            if ahead:
                self.presence.change(joined=_next_place(others) + ahead - 1)
            elif not same:
                return

    async def _find_others(self) -> list[Device]:
        """Return the present devices; retry until the directory answers.

        In a large team, return only this device and its neighbours.
        """
        while True:
            try:
                return [device for device, _ in parse_devices(await self.directory.read_neighbourhood())]
            except NotRunning:
                raise
            except EntangledError as error:
                self._log.info("the directory does not answer; retrying: {error}", error=error)
                await self._background.sleep(PLACE_CHECK_INTERVAL_S)

    def _with_certified_name(self, device: Device) -> Device:
        """Return ``device`` with the name in this node's certificate, if there is one."""
        return replace(device, name=self._admission.find_authority(self.entangled.identity.public).name or device.name)

    def _with_address(self, device: Device) -> Device:
        return replace(device, uuid=self.uuid, address=str(self._network.address), since=self.wall())

    def _log_join_failure(self, failure: Any) -> None:
        if failure.check(NotRunning) is None:
            self._log.failure("cannot join", failure)

    # -- devices ----------------------------------------------------------------------------------------------------

    def watch_devices(self, changed: OnChanged, keep: bool = False) -> DeviceSubscription:
        """Watch the devices of the team; ``parse_devices`` decodes the records, ``keep`` also stores the records.

        In a large team each update requires one round of reads, and ``keep`` has no effect.
        """
        return DeviceSubscription(self.directory, changed, keep)

    def list_devices(self) -> Deferred[Listing]:
        """Fire with all present devices; ``is_complete`` is False if devices may be missing.  Never fails."""
        return Deferred.fromCoroutine(self.directory.list_devices())

    def find_devices(
        self, count: int, matches: Matches = lambda device: True, after: bytes | None = None
    ) -> Deferred[Page]:
        """Fire with at most ``count`` devices; see ``Directory.find_devices``.  Never fails."""
        return Deferred.fromCoroutine(self.directory.find_devices(count, matches, after))

    def find_contact(self, record: Record) -> Contact | None:
        """Return the contact of the device that wrote ``record``.

        An observed address has priority over the published address.
        """
        pair = next(iter(parse_devices([record])), None)
        if pair is None:
            return None
        host, _, port = pair[0].address.rpartition(":")
        published = parse_contact([record.owner, host, int(port)]) if port.isascii() and port.isdigit() else None
        return published and (self.entangled.overlay.find_known(published.node_id) or published)

    def estimate_team_size(self) -> int:
        """Return the estimated number of nodes in the team, this one included."""
        from middleware.consensus.bidding.path_choice import estimate_team_size

        overlay = self.entangled.overlay
        return estimate_team_size(overlay.own_id, overlay.contacts(), overlay.is_large)

    def find_contacts(self, uuids: Sequence[str]) -> list[Contact]:
        """Return the contacts that this node knows among the given devices."""
        return [contact for contact in self.entangled.overlay.contacts() if contact.node_id.hex() in uuids]

    def on_message(self, receive: Callable[[str], None]) -> None:
        """Call ``receive`` with each text that an operator sends to this device."""
        self._on_message = receive

    def on_disconnect(self, leave: Callable[[float], None]) -> None:
        """Call ``leave(seconds)`` when an operator disconnects this device from the network for ``seconds``."""
        self._on_disconnect = leave

    # -- tasks ------------------------------------------------------------------------------------------------------

    async def submit(self, task: Task) -> Task:
        """Publish ``task`` with its council, the nodes that are now closest to its key; raise ``UnknownStrategy``."""
        if not is_deployed(task.strategy):  # a deployed strategy can be checked only by nodes that have the module
            find_import_path(task.strategy)
        task = await self.council_manager.choose_council(task)
        await self.entangled.put(TASKS, task.task_id, task.pack(), "team")
        return task

    def watch_tasks(self, changed: OnChanged, keep: bool = False) -> Watch:
        """Watch the tasks of the team; ``keep`` also stores their records."""
        return self.entangled.watch(TASKS, changed, keep)

    def watch_group(self, task_id: str, changed: OnChanged, keep: bool = False) -> Watch:
        """Watch the reports and the result of one task; ``keep`` also stores their records."""
        return self.entangled.watch(group_key(task_id), changed, keep)

    def join_group(
        self,
        task: Task,
        on_members: OnMembers,
        ordered: OnChanged = lambda records: None,
        reporters: Reporters | None = None,
    ) -> Group:
        """Take part in a task; bid for it if the task has a council.

        If the task has a council, in a large team only its reporters (``reporters``) write records.  For a task that
        belongs to a group, all participants write records, because its assignment needs the records of all.
        """
        from middleware.consensus.bidding.reporters import make_reporters

        reporters = reporters or make_reporters(self.uuid, group_key(task.task_id))
        enter = partial(self.start_bidding, task, task.generation) if task.council else None
        view = self._make_view(task.strategy) if task.council else None
        devices = self.estimate_team_size if task.council and not task.group else lambda: 1
        callbacks = (on_members, self._log_failures, ordered, enter, view)
        return Group(task, self.entangled, *callbacks, reporters, devices, self.clock.seconds, self.later)

    def start_bidding(self, task: Task, epoch: int, on_summary: OnSummary) -> Bidding:
        """Bid for ``task`` in ``epoch``; call ``on_summary`` with the bids that the task's council announces."""
        from middleware.consensus.bidding.auction import MAX_WAITING_S, Auction

        waiting = min(float(task.waiting_period), MAX_WAITING_S)
        auction = Auction(task.task_id, epoch, task.council, task.strategy, waiting, task.exclusive)
        return self.auction_service.take_part(auction, on_summary)

    def record_order(self, task_id: str, order: bytes) -> Deferred[Stored]:
        """Record an operator's order about a running task; ``order`` is a packed ``middleware.tasks.order.Order``."""
        return self.entangled.put(group_key(task_id), ORDER, order, "team")

    def record_result(self, task_id: str, result: Result) -> Deferred[Stored]:
        """Record the result of a task; this node's role must allow orders."""
        return self.entangled.put(group_key(task_id), RESULT, result.pack(), "team")

    def publish_decision_record(self, record: DecisionRecord) -> None:
        """Publish a decision record of this node's agent; the record remains when this node leaves."""
        put = maybeDeferred(self.entangled.put, record.key, record.slot, record.pack(), "team")
        self._log_failures(put)

    async def cancel(self, task: Task, result: Result) -> Stored:
        """Record that ``task`` was cancelled and close its council; return when no agent can act on the task.

        If the council is unreachable, only the record is written; the acting agent stops when it receives that record.
        """
        written = self.record_result(task.task_id, result)
        with suppress(EntangledError):
            await self.council_manager.make_proposer(await self._with_present_council(task)).close()
        return await written

    def get_strategy(self, name: str) -> GuardedStrategy:
        """Return the strategy ``name`` in its guard, which is loaded once per node; raise ``UnknownStrategy``."""
        return self._strategies.get(name, self.deployed)

    def _make_view(self, strategy: str) -> ReportView:
        """Return the report fields that ``strategy`` reads; only the costs if there is no such strategy."""
        from middleware.consensus.report_view import ReportView, make_view

        try:
            return make_view(self.get_strategy(strategy))
        except UnknownStrategy:
            return ReportView()

    def make_lease_client(self, task: Task, changed: Callable[[], None], floor: int) -> LeaseClient:
        """Return this node's client for the lease on ``task``; it calls ``changed`` at each change of state.

        ``floor`` is the highest fencing token that the node's device has obeyed; new tokens are higher.
        """
        return self.council_manager.make_lease_client(task, changed, floor)

    async def _record_council(self, task: Task) -> None:
        """Record the current council of ``task``, unless this council or a newer one is already recorded."""
        from middleware.consensus.lease.charter import parse_charter

        charter = parse_charter(task.charter)
        if charter is not None:
            known = await self._with_present_council(task.with_council(replace(charter, changes=())))
            if known.configuration < task.configuration:
                await self.entangled.put(group_key(task.task_id), COUNCIL, task.charter, "team")

    async def _with_present_council(self, task: Task) -> Task:
        """Return ``task`` with the newest recorded council."""
        return with_newest_council(task, await self.entangled.get(group_key(task.task_id)))

    @cached_property
    def council_manager(self) -> CouncilManager:
        """The councils of tasks: this node's acceptors and lease clients."""
        # Imported on first use, so a node that takes part in no council saves the memory.
        from middleware.tasks.council_manager import CouncilManager

        def moved(task: Task) -> None:
            self._log_failures(Deferred.fromCoroutine(self._record_council(task)))

        def may_sit(public: bytes) -> bool:
            return self._admission.may_call(public, "lease.freed")

        return CouncilManager(self.entangled, self.store, self.clock, self.rng, self._created_at, moved, may_sit)

    @cached_property
    def link_metrics(self) -> LinkMetrics:
        """The quality of the paths to this node's peers."""
        # Imported on first use.
        from middleware.entangled.control.health import LinkMetrics

        return LinkMetrics(self.entangled, self.clock, self._background)

    @cached_property
    def _strategies(self) -> StrategyRegistry:
        """The strategies loaded on this node."""
        # Imported on first use, so a node that neither decides nor forwards bids saves the memory.
        from middleware.consensus.strategy_registry import StrategyRegistry

        strategies = StrategyRegistry()
        self._stop_calls.append(strategies.stop)
        return strategies

    @cached_property
    def auction_service(self) -> AuctionService:
        """This node's part in flooding the bids for tasks."""
        # Imported on first use, so a node that forwards no bids saves the memory.
        from middleware.consensus.bidding.auction_service import AuctionService, Environment

        entangled = self.entangled

        def may_bid(key: bytes, public: bytes) -> bool:
            return entangled.replica.may_store(Slot(key, public, MEMBER))

        around = Environment(
            lambda: entangled.contact, entangled.overlay.contacts, self.estimate_team_size, self.get_strategy, may_bid
        )
        service = AuctionService(entangled.identity, entangled.endpoint, around, self.clock, self.rng)
        self._stop_calls.append(service.stop)
        return service

    # -- requests of peers ---------------------------------------------------------------------------------------------

    def _answer_lease(self, method: str, peer: Contact, *arguments: Any) -> object:
        return self.council_manager.lease_service.answer(method, peer, arguments)

    def _answer_offer(
        self, peer: Contact, auction: list[object], bids: list[object], age_ms: int, is_shared: bool
    ) -> object:
        offer = partial(self.auction_service.answer_offer, peer, auction, bids, age_ms, is_shared)
        learning = self._learn_bidders(peer, bids)
        return offer() if learning is None else learning.addCallback(lambda _: offer())

    def _answer_announcement(self, peer: Contact, auction: list[object], announcement: list[object]) -> None:
        self.auction_service.answer_announcement(peer, auction, announcement)

    def _answer_flood(self, peer: Contact, auction: list[object], bids: list[object]) -> None:
        learning = self._learn_bidders(peer, bids)
        if learning is not None:
            self._log_failures(learning.addCallback(lambda _: self.auction_service.answer_flood(peer, auction, bids)))
            return
        self.auction_service.answer_flood(peer, auction, bids)

    def _learn_bidders(self, peer: Contact, bids: list[object]) -> Deferred[None] | None:
        """Request missing certificates of bidders from ``peer``; return None if none is missing."""
        from middleware.consensus.bidding.outgoing_message import MAX_BIDS_PER_MESSAGE

        certificates = self.entangled.replica.certificates
        owners = [
            each[0]
            for each in bids[:MAX_BIDS_PER_MESSAGE]
            if isinstance(each, list) and each and type(each[0]) is bytes
        ]
        if not certificates.find_missing(peer, owners):
            return None
        return Deferred.fromCoroutine(certificates.fetch_missing(peer, owners))

    def _answer_message(self, peer: Contact, text: str) -> str:
        if not 0 < len(text) <= 200:
            raise Refused("a message is a text of 1 to 200 characters")
        self._on_message(text)
        self.presence.add_message(self.wall(), f"operator: {text}")
        return "delivered"

    def _answer_disconnect(self, peer: Contact, seconds: float) -> str:
        if not 0 < seconds <= 3600:
            raise Refused("the duration of a disconnection must be more than 0 and at most 3600 seconds")
        # Leave after the answer has been sent.
        self._background.later(0.05, self._on_disconnect, float(seconds))
        return "leaving"

    # -- inside -----------------------------------------------------------------------------------------------------

    def _announce(self, value: bytes) -> None:
        def put() -> Deferred[Any]:
            device = self.presence.device
            return self.directory.announce(device.name, check_size(value), device.depth)

        self._log_failures(maybeDeferred(put))

    def _log_failures(self, work: Deferred[Any]) -> None:
        def ended(failure: Any) -> None:
            if failure.check(TransientError, NotRunning, Refused) is None:
                self._log.failure("cannot publish to the team", failure)

        work.addErrback(ended)


def _next_place(devices: Sequence[Device]) -> int:
    return max((d.joined for d in devices), default=0) + 1
