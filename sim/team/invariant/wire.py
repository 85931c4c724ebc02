"""Invariants of the wire, R1 to R4: invalid datagrams, repeated requests, amplification, and table sizes."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Iterator

from sim.team.event import Answered, Asked, Event, InvalidDatagram, RequestExecuted, TableSize, UnvalidatedTraffic

KINDS = Asked, Answered, InvalidDatagram, RequestExecuted, UnvalidatedTraffic, TableSize
"""The events that these invariants use."""


def r1(events: Iterable[Event]) -> Iterator[str]:
    """Counters only: an invalid datagram changes a node's counters, but no other state, and causes no log or error."""
    for event in events:
        if not isinstance(event, InvalidDatagram):
            continue
        if event.raised:
            yield f"a {event.kind} datagram raises {event.raised}"
        if event.after != event.before:
            yield f"a {event.kind} datagram of type {event.datagram[:1].hex()} changes node {event.place}"
        if event.logged:
            yield f"a {event.kind} datagram is logged: {event.logged}"


def r2(events: Iterable[Event]) -> Iterator[str]:
    """At most once: a request that changes state is executed at most once, and an answer proves its execution."""
    runs: Counter[tuple[int, int, int]] = Counter()
    lives: dict[int, int] = {}
    requests: dict[int, Asked] = {}
    for event in events:
        match event:
            case RequestExecuted(_, place, life, question):
                lives[place] = max(life, lives.get(place, 0))
                runs[place, life, question] += 1
            case Asked(_, number, _, "run"):
                requests[number] = event
            case Answered(_, number, (answer, place, life, newest)) if number in requests:
                ran = runs[place, life, requests[number].subject]  # type: ignore[index]
                if answer != requests[number].subject or (ran != 1 and newest == life):
                    yield f"question {requests[number].subject} was answered with {answer!r} and ran {ran} times"
    for (place, _, question), ran in runs.items():
        if ran > 1:
            yield f"node {place} ran question {question} {ran} times"


def r3(events: Iterable[Event]) -> Iterator[str]:
    """No amplification: an unvalidated address gets at most as many bytes as it sent, and other addresses get none."""
    for event in events:
        if isinstance(event, InvalidDatagram):
            size = len(event.datagram)
            is_elsewhere = any(not is_back for is_back, _ in event.answers)
            if is_elsewhere or sum(answer for _, answer in event.answers) > size:
                yield f"a {event.kind} datagram of {size} bytes is answered with {list(event.answers)}"
        elif isinstance(event, UnvalidatedTraffic) and event.sent > event.received:
            yield f"{event.sent} bytes to an unvalidated address that sent {event.received}"


def r4(events: Iterable[Event]) -> Iterator[str]:
    """Caps: no table exceeds its limit."""
    for event in events:
        if isinstance(event, TableSize) and event.size > event.cap:
            yield f"node {event.place} remembers {event.size} {event.what}, {event.cap} are allowed"
