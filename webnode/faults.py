"""Inject faults into devices of the team that allow it, and measure the takeovers."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

from twisted.internet.defer import Deferred, fail
from twisted.logger import Logger

from middleware.directory.presence import parse_devices
from middleware.entangled.errors import EntangledError, NoAnswer
from middleware.entangled.record import Record
from middleware.errors import BadFault
from middleware.faults.kinds import CAUSE_METHOD, KINDS, LIST_METHOD, Fault, parse_delay, parse_fault
from middleware.faults.takeover import Takeover, find_executing
from middleware.node import SwarmNode
from webnode.errors import Refusal
from webnode.sanitize import Json, clean_text

ANSWER_LIMIT_S = 1.5
"""Timeout of a device's reply in seconds; the browser waits for two."""
SHOWN_S = 60.0
"""Seconds for which a fault is listed after its end."""
MAX_FAULTS = 50
MAX_NAMES = 1000
"""Maximum number of devices known; beyond it, absent devices are forgotten."""


@dataclass
class _InjectedFault:
    n: int
    fault: Fault
    name: str
    takeover: Takeover


class FaultControl:
    """The faults injected through this node; ``clock`` returns monotonic seconds."""

    _log = Logger()

    def __init__(self, node: SwarmNode, clock: Callable[[], float]) -> None:
        self._node = node
        self._clock = clock
        self._kinds: dict[str, tuple[str, ...]] = {}
        self._queried: set[str] = set()
        self._names: dict[str, str] = {}
        self._injected: list[_InjectedFault] = []
        self._count = 0
        self._watch = node.watch_devices(self._on_records)

    def get_kinds(self, uuid: str) -> Sequence[str]:
        """Return the fault kinds that the device allows; empty until it has reported them."""
        return self._kinds.get(uuid, ())

    def inject(self, uuid: str, kind: str, seconds: float, amount: float | None) -> Deferred[None]:
        """Inject a fault, by default with the usual ``amount``; fires when the device has accepted it.

        Fails with ``Refusal``: 400 for an invalid field, 409 and 504 for the device.  The takeover time counts from the
        beginning that the device announced.
        """
        try:
            fault = parse_fault(kind, seconds, amount)
        except BadFault as error:
            return fail(Refusal(error.field, error.problem, error.remedy))
        record = next((each for device, each in parse_devices(self._watch.records) if device.uuid == uuid), None)
        contact = None if record is None else self._node.find_contact(record)
        if contact is None:
            return fail(Refusal("device", "the device has left the network", "wait until the device is back", 409))
        name = self._names.get(uuid, "it")
        if kind not in self.get_kinds(uuid):
            allowed = ", ".join(self.get_kinds(uuid))
            remedy = f"choose one of {allowed}" if allowed else 'set "allow = true" below [faults] in its settings'
            return fail(Refusal("kind" if allowed else "device", f"{name} does not allow {kind}", remedy, 409))
        task = find_executing(device for device, _ in parse_devices(self._watch.records)).get(uuid, "")

        def add_fault(answer: object) -> None:
            now = self._clock() + parse_delay(answer)
            self._count += 1
            self._injected.insert(
                0, _InjectedFault(self._count, fault, name, Takeover(uuid, task, now, now + fault.seconds))
            )
            del self._injected[MAX_FAULTS:]

        def refused(failure: Any) -> None:
            failure.trap(EntangledError)
            if failure.check(NoAnswer):
                raise Refusal("device", f"{name} does not answer", "wait until the device is back", 504)
            problem = clean_text(failure.getErrorMessage(), "the device rejected the fault")
            raise Refusal("device", f"{name}: {problem}", "check its settings", 409)

        call = self._node.entangled.call(
            contact, CAUSE_METHOD, fault.kind, fault.seconds, amount, timeout=ANSWER_LIMIT_S, changes=True
        )
        return call.addCallbacks(add_fault, refused)

    def list_active(self) -> list[dict[str, Json]]:
        """Return the faults that are active or ended recently, newest first.

        ``n`` is the number of the fault; ``left_s`` and ``since_s`` are its remaining and elapsed seconds; ``task`` is
        the task on which the device acted; ``takeover_s`` is the time until another device acted on that task and
        ``to`` the name of that device, None and empty before; ``watched`` says whether the takeover is still measured.
        """
        now = self._clock()
        self._injected = [each for each in self._injected if now < each.takeover.until + SHOWN_S]
        return [self._make_row(each, now) for each in self._injected]

    # -- inside -----------------------------------------------------------------------------------------------------

    def _make_row(self, injected: _InjectedFault, now: float) -> dict[str, Json]:
        takeover, fault = injected.takeover, injected.fault
        return {
            "n": injected.n,
            "uuid": takeover.lost,
            "name": injected.name,
            "kind": fault.kind,
            "amount": fault.amount if KINDS[fault.kind].unit else None,
            "left_s": round(min(fault.seconds, max(0.0, takeover.until - now)), 1),
            "since_s": round(max(0.0, now - takeover.began), 1),
            "task": takeover.task,
            "takeover_s": None if takeover.seconds is None else round(takeover.seconds, 2),
            "to": self._names.get(takeover.to, takeover.to[:8]),
            "watched": takeover.is_open(now),
        }

    def _on_records(self, records: list[Record]) -> None:
        devices = parse_devices(records)
        executing, now = find_executing(device for device, _ in devices), self._clock()
        self._names.update({device.uuid: device.name for device, _ in devices})
        for each in self._injected:
            each.takeover.observe(executing, now)
        for device, record in devices:
            if device.uuid not in self._queried:
                self._queried.add(device.uuid)
                self._query_kinds(device.uuid, record)
        # A device that returns may have other settings and is queried again; the previous reply holds until then.
        self._queried &= {device.uuid for device, _ in devices}
        if len(self._names) > MAX_NAMES:
            self._names = {device.uuid: device.name for device, _ in devices}
            self._kinds = {uuid: self._kinds[uuid] for uuid in self._names.keys() & self._kinds.keys()}

    def _query_kinds(self, uuid: str, record: Record) -> None:
        contact = self._node.find_contact(record)
        if contact is None:
            return

        def store_kinds(answer: Any) -> None:
            kinds = answer.get("kinds") if isinstance(answer, dict) else None
            if isinstance(kinds, list):
                self._kinds[uuid] = tuple(kind for kind in KINDS if kind in kinds)

        def handle_failure(failure: Any) -> None:
            failure.trap(EntangledError)
            if failure.check(NoAnswer):
                self._queried.discard(uuid)  # query again at the next change of any device
            else:
                self._kinds.pop(uuid, None)

        call = self._node.entangled.call(contact, LIST_METHOD).addCallbacks(store_kinds, handle_failure)
        call.addErrback(lambda failure: self._log.failure("cannot read which faults a device allows", failure))
