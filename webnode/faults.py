"""Faults that the page injects into devices of the team that allow it, with the time of each takeover."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

from twisted.internet.defer import Deferred, fail
from twisted.logger import Logger

from middleware.directory.presence import devices_of
from middleware.entangled.errors import EntangledError, NoAnswer
from middleware.entangled.record import Record
from middleware.errors import BadFault
from middleware.faults.kinds import ASKED, CAUSE, KINDS, Fault, begins_in, parse_fault
from middleware.faults.takeover import Takeover, acting
from middleware.node import SwarmNode
from webnode.errors import Refusal
from webnode.field import Json, text

PATIENCE_S = 1.5
"""Seconds for which a device may think about an order; whoever gave it waits for two."""
TOLD_S = 60.0
"""Seconds for which one still tells of a fault that is over."""
KEPT = 50
REMEMBERED = 1000
"""Devices beyond which one forgets those that are not here."""


@dataclass
class _Caused:
    n: int
    fault: Fault
    name: str
    clock: Takeover


class FaultControl:
    """The faults that were caused through this node; ``clock`` gives seconds that only go forward."""

    _log = Logger()

    def __init__(self, node: SwarmNode, clock: Callable[[], float]) -> None:
        self._node = node
        self._clock = clock
        self._kinds: dict[str, tuple[str, ...]] = {}
        self._asked: set[str] = set()
        self._names: dict[str, str] = {}
        self._caused: list[_Caused] = []
        self._count = 0
        self._watch = node.watch_devices(self._changed)

    def kinds(self, uuid: str) -> Sequence[str]:
        """What can be caused there; nothing as long as it has not said so."""
        return self._kinds.get(uuid, ())

    def cause(self, uuid: str, kind: str, seconds: float, amount: float | None) -> Deferred[None]:
        """Cause one, without an ``amount`` as much as is usual; fires when the device has said that it will.

        Fails with ``Refusal``: 400 names the field, 409 and 504 the device.  The clock runs from when the device said
        that it would begin.
        """
        try:
            fault = parse_fault(kind, seconds, amount)
        except BadFault as error:
            return fail(Refusal(error.field, error.problem, error.remedy))
        record = next((each for device, each in devices_of(self._watch.records) if device.uuid == uuid), None)
        contact = None if record is None else self._node.contact_of(record)
        if contact is None:
            return fail(Refusal("device", "it has left the network", "wait until it is back", 409))
        name = self._names.get(uuid, "it")
        if kind not in self.kinds(uuid):
            can = ", ".join(self.kinds(uuid))
            remedy = f"choose one of {can}" if can else 'write "allow = true" below [faults] of its settings'
            return fail(Refusal("kind" if can else "device", f"{name} does not allow {kind}", remedy, 409))
        task = acting(device for device, _ in devices_of(self._watch.records)).get(uuid, "")

        def taken(answer: object) -> None:
            now = self._clock() + begins_in(answer)
            self._count += 1
            self._caused.insert(0, _Caused(self._count, fault, name, Takeover(uuid, task, now, now + fault.seconds)))
            del self._caused[KEPT:]

        def refused(failure: Any) -> None:
            failure.trap(EntangledError)
            if failure.check(NoAnswer):
                raise Refusal("device", f"{name} does not answer", "wait until it is back", 504)
            problem = text(failure.getErrorMessage(), "it refused")
            raise Refusal("device", f"{name}: {problem}", "look at its settings", 409)

        asked = self._node.entangled.call(
            contact, CAUSE, fault.kind, fault.seconds, amount, timeout=PATIENCE_S, changes=True
        )
        return asked.addCallbacks(taken, refused)

    def active(self) -> list[dict[str, Json]]:
        """Those that go on or ended a short while ago, the newest first, and what came of each.

        ``n`` counts them; ``left_s`` and ``since_s`` are its seconds to come and gone; ``task`` is what the device was
        at; ``takeover_s`` and ``to`` are the seconds until another (by name) acted on that task, None and empty until
        then; ``watched`` says whether the clock runs.
        """
        now = self._clock()
        self._caused = [each for each in self._caused if now < each.clock.until + TOLD_S]
        return [self._row(each, now) for each in self._caused]

    # -- inside -----------------------------------------------------------------------------------------------------

    def _row(self, caused: _Caused, now: float) -> dict[str, Json]:
        clock, fault = caused.clock, caused.fault
        return {
            "n": caused.n,
            "uuid": clock.lost,
            "name": caused.name,
            "kind": fault.kind,
            "amount": fault.amount if KINDS[fault.kind].unit else None,
            "left_s": round(min(fault.seconds, max(0.0, clock.until - now)), 1),
            "since_s": round(max(0.0, now - clock.began), 1),
            "task": clock.task,
            "takeover_s": None if clock.seconds is None else round(clock.seconds, 2),
            "to": self._names.get(clock.to, clock.to[:8]),
            "watched": clock.is_open(now),
        }

    def _changed(self, records: list[Record]) -> None:
        devices = devices_of(records)
        acts, now = acting(device for device, _ in devices), self._clock()
        self._names.update({device.uuid: device.name for device, _ in devices})
        for each in self._caused:
            each.clock.look(acts, now)
        for device, record in devices:
            if device.uuid not in self._asked:
                self._asked.add(device.uuid)
                self._learn(device.uuid, record)
        # Who comes back may have other settings, and is asked again; until then what it said before holds.
        self._asked &= {device.uuid for device, _ in devices}
        if len(self._names) > REMEMBERED:
            self._names = {device.uuid: device.name for device, _ in devices}
            self._kinds = {uuid: self._kinds[uuid] for uuid in self._names.keys() & self._kinds.keys()}

    def _learn(self, uuid: str, record: Record) -> None:
        contact = self._node.contact_of(record)
        if contact is None:
            return

        def told(answer: Any) -> None:
            kinds = answer.get("kinds") if isinstance(answer, dict) else None
            if isinstance(kinds, list):
                self._kinds[uuid] = tuple(kind for kind in KINDS if kind in kinds)

        def untold(failure: Any) -> None:
            failure.trap(EntangledError)
            if failure.check(NoAnswer):
                self._asked.discard(uuid)  # once more at the next change of any device
            else:
                self._kinds.pop(uuid, None)

        asked = self._node.entangled.call(contact, ASKED).addCallbacks(told, untold)
        asked.addErrback(lambda failure: self._log.failure("while asking for faults", failure))
