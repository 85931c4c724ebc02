"""Checks of ``swarm doctor`` on team membership: other nodes are of this team and accept this node."""

from __future__ import annotations

from collections.abc import Iterator
from datetime import UTC, datetime
from statistics import median

from middleware.entangled.wire.admission_check import DOUBLED, EARLY, EXPIRED, FOREIGN, REVOKED, SUPERSEDED, explain
from middleware.entangled.wire.probe import VERSION
from swarmnode.doctor.facts import Facts, Finding, make_error, make_warning

MAX_SKEW_S = 300.0
"""Clock difference in seconds above which a certificate can seem expired or not valid yet."""
MIN_REPORTED_SKEW_S = 10.0
EXPIRY_WARNING_S = 7 * 86400.0
"""Seconds before its end from which a certificate is reported."""
CAUSE_CODES = {
    EXPIRED: "certificate-expired",
    EARLY: "certificate-early",
    REVOKED: "certificate-revoked",
    FOREIGN: "wrong-team",
    DOUBLED: "two-of-one",
    SUPERSEDED: "two-of-one",
}


def check_team(facts: Facts) -> Iterator[Finding]:
    """Check that the nodes found belong to this team."""
    probed = [probe for probe in facts.known if probe.answer is not None and probe.answer.version == VERSION]
    foreign = [probe for probe in probed if not probe.is_member]
    if not foreign or (facts.certificate is not None and facts.certificate.problem):
        return  # no node could be probed as a member of this team
    fingerprint_seen = foreign[0].answer.fingerprint if foreign[0].answer is not None else b""
    if fingerprint_seen != facts.fingerprint and any(fingerprint_seen):
        why = f"That node belongs to the team {fingerprint_seen.hex()}, this node to {_format_team(facts.fingerprint)}."
        remedy = (
            "Join that team with a code of its operator (swarm join CODE), or set known_nodes to nodes of this team."
        )
    elif any(facts.fingerprint):
        why = "Either that node is in an open team, or this node does not have the newest team secret."
        remedy = (
            "Join that team, or set known_nodes to nodes of this team; after a long absence a node has to join again."
        )
    else:
        why = "That node replies to a PROBE, but not to a DISCOVERY with this node's [node] team_key."
        remedy = "Set the same [node] team_key on both nodes."
    yield make_error("wrong-team", f"The node at {foreign[0].address} belongs to another team.", why, remedy)


def check_version(facts: Facts) -> Iterator[Finding]:
    """Check that the nodes found have the same protocol version."""
    for answer in [each for each in facts.answers if each.version != VERSION][:1]:
        older = "it" if answer.version < VERSION else "this one"
        yield make_error(
            "version-skew",
            f"The node at {answer.address} has another version of the protocol.",
            f"That node has version {answer.version}, this node has version {VERSION}.",
            f"Upgrade {older}: pip install --upgrade swarm-node.",
        )


def check_clock(facts: Facts) -> Iterator[Finding]:
    """Check this machine's clock against the other machines."""
    offsets = _list_clock_offsets(facts)
    offset = median(offsets) if offsets else 0.0
    if abs(offset) < MIN_REPORTED_SKEW_S:
        return
    direction = "behind" if offset > 0 else "ahead of"
    make = make_error if abs(offset) > MAX_SKEW_S else make_warning
    yield make(
        "clock-off",
        f"This machine's clock is {_format_duration(abs(offset))} {direction} the other nodes' clocks.",
        f"Measured at {len(offsets)} nodes." if len(offsets) > 1 else "Measured at one node, whose clock may be wrong.",
        "Set this clock, for example with timedatectl set-ntp true. The validity of certificates depends on the clock.",
    )


def check_certificate(facts: Facts) -> Iterator[Finding]:
    """Check that the node's certificate is valid now, and that other nodes accept it."""
    own, offsets = facts.certificate, _list_clock_offsets(facts)
    offset = median(offsets) if offsets else 0.0
    # With a wrong clock a valid certificate seems invalid: report the clock as the cause.
    now = facts.wall + (offset if abs(offset) > MAX_SKEW_S else 0.0)
    if own is not None and own.problem:
        yield make_error(
            "certificate-unreadable",
            "The node's membership is not usable.",
            own.problem,
            "Follow the remedy in this reason.",
        )
    elif own is not None and now >= own.not_after:
        why = f"It ended on {_format_time(own.not_after)}; this machine's clock shows {_format_time(facts.wall)}."
        yield make_error(CAUSE_CODES[EXPIRED], "The node's certificate has expired.", why, _make_remedy(EXPIRED))
    elif own is not None and now < own.not_before - MAX_SKEW_S:
        why = f"It begins on {_format_time(own.not_before)}; this machine's clock shows {_format_time(facts.wall)}."
        yield make_error(CAUSE_CODES[EARLY], "The node's certificate is not valid yet.", why, _make_remedy(EARLY))
    elif own is not None and now > own.not_after - EXPIRY_WARNING_S:
        yield make_warning(
            "certificate-ends",
            f"The node's certificate ends in {_format_duration(own.not_after - now)}.",
            f"It is valid until {_format_time(own.not_after)}.",
            "Keep the node connected to a bootstrap node for an hour, or renew as operator: swarm renew NAME.",
        )


def report_rejections(facts: Facts) -> Iterator[Finding]:
    """Report the refusals that the running node received."""
    for code, peer in facts.health.refusals if facts.health is not None else ():
        yield make_error(
            CAUSE_CODES.get(code, code),
            f"{peer} rejects this node: {code}.",
            "That peer sent a refusal.",
            _make_remedy(code),
        )


def _list_clock_offsets(facts: Facts) -> list[float]:
    """Return the clock differences to other machines, in seconds; nodes on this machine share its clock."""
    answers = [answer for answer in facts.answers if answer.address.host not in facts.own_addresses]
    return [answer.offset for answer in answers if answer.offset is not None]


def _make_remedy(code: str) -> str:
    words = explain(code).partition("; ")[2] or explain(code)
    return words[0].upper() + words[1:] + "."


def _format_team(fingerprint: bytes) -> str:
    return fingerprint.hex() if any(fingerprint) else "an open team"


def _format_time(moment: float) -> str:
    try:
        return f"{datetime.fromtimestamp(moment, UTC):%Y-%m-%d %H:%M} UTC"
    except (OverflowError, ValueError, OSError):
        return "an invalid date"


def _format_duration(seconds: float) -> str:
    for size, name in ((86400.0, "days"), (3600.0, "hours"), (60.0, "minutes")):
        if seconds >= 2 * size:
            return f"{seconds / size:.0f} {name}"
    return f"{seconds:.0f} seconds"
