"""Team: whether those who are there are of this node's team, and let it in."""

from __future__ import annotations

from collections.abc import Iterator
from datetime import UTC, datetime
from statistics import median

from middleware.entangled.wire.door import DOUBLED, EARLY, EXPIRED, FOREIGN, REVOKED, SUPERSEDED, meaning
from middleware.entangled.wire.hail import VERSION
from swarmnode.doctor.facts import Facts, Finding, error, warning

SKEW = 300.0
"""Seconds by which clocks of one team may differ before a certificate seems not valid yet, or expired."""
NOTICED = 10.0
SOON = 7 * 86400.0
"""Seconds before its end that a certificate is spoken of."""
CAUSES = {
    EXPIRED: "certificate-expired",
    EARLY: "certificate-early",
    REVOKED: "certificate-revoked",
    FOREIGN: "wrong-team",
    DOUBLED: "two-of-one",
    SUPERSEDED: "two-of-one",
}


def wrong_team(facts: Facts) -> Iterator[Finding]:
    """Whether there are nodes, and none of them of this team."""
    heard = [probe for probe in facts.known if probe.answer is not None and probe.answer.version == VERSION]
    foreign = [probe for probe in heard if not probe.is_member]
    if not foreign or (facts.certificate is not None and facts.certificate.problem):
        return  # or nobody could be greeted as this team's node
    theirs = foreign[0].answer.fingerprint if foreign[0].answer is not None else b""
    if theirs != facts.fingerprint and any(theirs):
        why = f"It shows the team {theirs.hex()}, and this node is of {_team(facts.fingerprint)}."
        remedy = "Join that team with a code of its operator (swarm join CODE), or name nodes of this one."
    elif any(facts.fingerprint):
        why = "It is of an open team, and this node of a closed one, or does not know the team's newest secret."
        remedy = "Join that team, or name nodes of this one; a node that was away for long joins again."
    else:
        why = "It answers everybody's HAIL, and not what is sealed with this node's [node] team_key."
        remedy = "Give both the same [node] team_key."
    yield error("wrong-team", f"The node at {foreign[0].address} is of another team.", why, remedy)


def version(facts: Facts) -> Iterator[Finding]:
    """Whether others speak another version of the protocol."""
    for answer in [each for each in facts.answers if each.version != VERSION][:1]:
        older = "it" if answer.version < VERSION else "this one"
        yield error(
            "version-skew",
            f"The node at {answer.address} speaks another version of the protocol.",
            f"It speaks {answer.version}, this one {VERSION}.",
            f"Upgrade {older}: pip install --upgrade swarm-node.",
        )


def clock(facts: Facts) -> Iterator[Finding]:
    """Whether this machine's clock differs from the others'."""
    offsets = _offsets(facts)
    offset = median(offsets) if offsets else 0.0
    if abs(offset) < NOTICED:
        return
    way = "behind" if offset > 0 else "ahead of"
    make = error if abs(offset) > SKEW else warning
    yield make(
        "clock-off",
        f"This machine's clock is {_span(abs(offset))} {way} the others'.",
        f"{len(offsets)} of them say so" if len(offsets) > 1 else "The one that answers says so; it may be that one's.",
        "Set it, or have it set: timedatectl set-ntp true. Certificates hold by the clock.",
    )


def certificate(facts: Facts) -> Iterator[Finding]:
    """Whether the node's own certificate holds now, and what others said of it."""
    own, offsets = facts.certificate, _offsets(facts)
    offset = median(offsets) if offsets else 0.0
    # By a clock that is wrong a good certificate seems bad: then the clock is the cause, and has a finding of its own.
    now = facts.wall + (offset if abs(offset) > SKEW else 0.0)
    if own is not None and own.problem:
        yield error("certificate-unreadable", "The node's membership cannot be used.", own.problem, "Do as it says.")
    elif own is not None and now >= own.not_after:
        why = f"It ended on {_day(own.not_after)}; this machine's clock shows {_day(facts.wall)}."
        yield error(CAUSES[EXPIRED], "The node's certificate has expired.", why, _remedy(EXPIRED))
    elif own is not None and now < own.not_before - SKEW:
        why = f"It begins on {_day(own.not_before)}; this machine's clock shows {_day(facts.wall)}."
        yield error(CAUSES[EARLY], "The node's certificate is not valid yet.", why, _remedy(EARLY))
    elif own is not None and now > own.not_after - SOON:
        yield warning(
            "certificate-ends",
            f"The node's certificate ends in {_span(own.not_after - now)}.",
            f"Its last moment is {_day(own.not_after)}.",
            "Let it run in sight of a bootstrap node for an hour, or have the operator renew it: swarm renew NAME.",
        )


def refused(facts: Facts) -> Iterator[Finding]:
    """What the running node was told when it was not let in."""
    for code, whom in facts.health.refusals if facts.health is not None else ():
        yield error(CAUSES.get(code, code), f"{whom} does not let this node in: {code}.", "It said so.", _remedy(code))


def _offsets(facts: Facts) -> list[float]:
    """By how many seconds the clocks of other machines differ: nodes of this machine have its own."""
    answers = [answer for answer in facts.answers if answer.address.host not in facts.own]
    return [answer.offset for answer in answers if answer.offset is not None]


def _remedy(code: str) -> str:
    words = meaning(code).partition("; ")[2] or meaning(code)
    return words[0].upper() + words[1:] + "."


def _team(fingerprint: bytes) -> str:
    return fingerprint.hex() if any(fingerprint) else "an open team"


def _day(moment: float) -> str:
    try:
        return f"{datetime.fromtimestamp(moment, UTC):%Y-%m-%d %H:%M} UTC"
    except (OverflowError, ValueError, OSError):
        return "no day that a clock shows"


def _span(seconds: float) -> str:
    for size, name in ((86400.0, "days"), (3600.0, "hours"), (60.0, "minutes")):
        if seconds >= 2 * size:
            return f"{seconds / size:.0f} {name}"
    return f"{seconds:.0f} seconds"
