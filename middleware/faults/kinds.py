"""The faults that can be injected into a node, with their bounds.

Pure; used by the page, the command line, scenarios and nodes.  Every fault ends by itself, because an isolated device
would not receive an order to end its fault.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from middleware.entangled.value import is_number
from middleware.errors import BadFault

CAUSE_METHOD, LIST_METHOD, ASSIGN_METHOD = "device.fault", "device.faults", "device.assign"
"""Methods of a node that allows faults: inject a fault; list the supported kinds and the active faults; publish a
predefined task."""
MIN_S, MAX_S, DEFAULT_S = 0.1, 600.0, 15.0
MAX_DELAY_S = 2.0
"""Maximum seconds between the answer of a device to the order and the beginning of its fault."""


@dataclass(frozen=True)
class FaultKind:
    """The properties of one kind of fault.

    ``is_lost``: if the device executes a task, another device has to take over.  A kind with a ``unit`` has an amount:
    ``amount`` is the default value, ``least`` and ``most`` are the bounds, and ``means`` describes the amount in words.
    """

    about: str
    is_lost: bool = False
    amount: float = 0.0
    least: float = 0.0
    most: float = 0.0
    unit: str = ""
    means: str = ""


KINDS: Mapping[str, FaultKind] = {
    "kill": FaultKind("its process is killed (SIGKILL); a supervisor restarts it", is_lost=True),
    "freeze": FaultKind("its process stops (SIGSTOP), and continues at the end", is_lost=True),
    "radio": FaultKind("no datagram passes in either direction", is_lost=True),
    "one-way": FaultKind("it receives datagrams, but cannot send any", is_lost=True),
    "delay": FaultKind("all its datagrams are delayed in both directions", False, 0.3, 0.0, 5.0, "s", "late by"),
    "loss": FaultKind(
        "a share of its datagrams is lost in both directions", False, 0.2, 0.0, 1.0, "of 1", "share lost"
    ),
    "skew": FaultKind("its wall clock is wrong, which must have no effect", False, 3600.0, -1e6, 1e6, "s", "ahead by"),
    "battery": FaultKind(
        "its battery reads low; below 0.05 it gives up its task", True, 0.03, 0.0, 1.0, "of 1", "charge"
    ),
}


@dataclass(frozen=True)
class Fault:
    """A fault that lasts for ``seconds``; ``kind`` is one of ``KINDS``."""

    kind: str
    seconds: float = DEFAULT_S
    amount: float = 0.0


def parse_fault(kind: object, seconds: object = None, amount: object = None) -> Fault:
    """Check the fields of a fault from an untrusted source; None means the default.  Raise ``BadFault``."""
    if not isinstance(kind, str) or kind not in KINDS:
        raise BadFault("kind", f"there is no fault {str(kind)[:40]!r}", f"choose one of {', '.join(KINDS)}")
    rule = KINDS[kind]
    lasts = _check_number("seconds", DEFAULT_S if seconds is None else seconds, MIN_S, MAX_S, "s")
    if not rule.unit:
        if amount is not None and amount != 0:
            raise BadFault("amount", f"a fault of the kind {kind} has no amount", "leave the amount out")
        return Fault(kind, lasts)
    much = _check_number("amount", rule.amount if amount is None else amount, rule.least, rule.most, rule.unit)
    return Fault(kind, lasts, much)


def parse_delay(answer: object) -> float:
    """Decode a device's answer to the order: the seconds until the fault begins; 0 for an invalid answer."""
    return float(answer) if is_number(answer) and 0.0 < answer <= MAX_DELAY_S else 0.0  # type: ignore[operator,arg-type]


def _check_number(field: str, value: object, least: float, most: float, unit: str) -> float:
    if not is_number(value) or not least <= value <= most:  # type: ignore[operator]
        raise BadFault(field, f"{str(value)[:40]} is out of range", f"it must be from {least:g} to {most:g} {unit}")
    return float(value)  # type: ignore[arg-type]
