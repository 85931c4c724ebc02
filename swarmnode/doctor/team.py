"""Checks of ``swarm doctor`` on team membership: other nodes are of this team and accept this node."""

from __future__ import annotations

from collections.abc import Iterator
from datetime import UTC, datetime
from statistics import median

from middleware.entangled.wire.door import DOUBLED, EARLY, EXPIRED, FOREIGN, REVOKED, SUPERSEDED, meaning
from middleware.entangled.wire.hail import VERSION
from swarmnode.doctor.facts import Facts, Finding, error, warning

SKEW = 300.0
"""Clock difference in seconds above which a certificate can seem expired or not valid yet."""
NOTICED = 10.0
SOON = 7 * 86400.0
"""Seconds before its end from which a certificate is reported."""
CAUSES = {
    EXPIRED: "certificate-expired",
    EARLY: "certificate-early",
    REVOKED: "certificate-revoked",
    FOREIGN: "wrong-team",
    DOUBLED: "two-of-one",
    SUPERSEDED: "two-of-one",
}


def wrong_team(facts: Facts) -> Iterator[Finding]:
    """Check that the nodes found are of this team."""
    probed = [probe for probe in facts.known if probe.answer is not None and probe.answer.version == VERSION]
    foreign = [probe for probe in probed if not probe.is_member]
    if not foreign or (facts.certificate is not None and facts.certificate.problem):
        return  # no node could be probed as a member of this team
    fingerprint_seen = foreign[0].answer.fingerprint if foreign[0].answer is not None else b""
    if fingerprint_seen != facts.fingerprint and any(fingerprint_seen):
        why = f"It belongs to the team {fingerprint_seen.hex()}, and this node to {_team(facts.fingerprint)}."
        remedy = "Join that team with a code of its operator (swarm join CODE), or set known_nodes of this team."
    elif any(facts.fingerprint):
        why = "It is of an open team and this node of a closed one, or this node does not have the newest team secret."
        remedy = "Join that team, or set known_nodes of this team; a node that was away for long has to join again."
    else:
        why = "It replies to probes of any node, but not to probes with this node's [node] team_key."
        remedy = "Set the same [node] team_key on both."
    yield error("wrong-team", f"The node at {foreign[0].address} is of another team.", why, remedy)


def version(facts: Facts) -> Iterator[Finding]:
    """Check that the nodes found have the same protocol version."""
    for answer in [each for each in facts.answers if each.version != VERSION][:1]:
        older = "it" if answer.version < VERSION else "this one"
        yield error(
            "version-skew",
            f"The node at {answer.address} has another version of the protocol.",
            f"It has version {answer.version}, this node {VERSION}.",
            f"Upgrade {older}: pip install --upgrade swarm-node.",
        )


def clock(facts: Facts) -> Iterator[Finding]:
    """Check this machine's clock against the other machines."""
    offsets = _offsets(facts)
    offset = median(offsets) if offsets else 0.0
    if abs(offset) < NOTICED:
        return
    direction = "behind" if offset > 0 else "ahead of"
    make = error if abs(offset) > SKEW else warning
    yield make(
        "clock-off",
        f"This machine's clock is {_span(abs(offset))} {direction} the other nodes' clocks.",
        f"Measured at {len(offsets)} nodes." if len(offsets) > 1 else "Measured at one node, whose clock may be wrong.",
        "Set it, for example by timedatectl set-ntp true. The validity of certificates depends on the clock.",
    )


def certificate(facts: Facts) -> Iterator[Finding]:
    """Check that the node's certificate is valid now, and that other nodes accept it."""
    own, offsets = facts.certificate, _offsets(facts)
    offset = median(offsets) if offsets else 0.0
    # With a wrong clock a valid certificate seems invalid; the clock is then reported as the cause.
    now = facts.wall + (offset if abs(offset) > SKEW else 0.0)
    if own is not None and own.problem:
        yield error(
            "certificate-unreadable",
            "The node's membership is not usable.",
            own.problem,
            "Apply the remedy that the reason names.",
        )
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
            f"It is valid until {_day(own.not_after)}.",
            "Let it run for an hour while it reaches a bootstrap node, or renew it as operator: swarm renew NAME.",
        )


def refused(facts: Facts) -> Iterator[Finding]:
    """Report the refusals that the running node received."""
    for code, peer in facts.health.refusals if facts.health is not None else ():
        yield error(CAUSES.get(code, code), f"{peer} rejects this node: {code}.", "It sent a refusal.", _remedy(code))


def _offsets(facts: Facts) -> list[float]:
    """Return the clock differences to other machines, in seconds; nodes on this machine share its clock."""
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
        return "an invalid date"


def _span(seconds: float) -> str:
    for size, name in ((86400.0, "days"), (3600.0, "hours"), (60.0, "minutes")):
        if seconds >= 2 * size:
            return f"{seconds / size:.0f} {name}"
    return f"{seconds:.0f} seconds"
