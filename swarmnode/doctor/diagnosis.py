"""Diagnosis: every check over the facts of one node; pure."""

from __future__ import annotations

from collections.abc import Callable, Iterable

from swarmnode.doctor import machine, team, way
from swarmnode.doctor.facts import Facts
from swarmnode.doctor.finding import ORDER, Finding

CHECKS: tuple[Callable[[Facts], Iterable[Finding]], ...] = (
    machine.port,
    machine.store,
    machine.files,
    team.certificate,
    team.refused,
    team.version,
    team.wrong_team,
    team.clock,
    way.interface,
    way.known,
    way.multicast,
    way.nat,
)


def diagnosed(facts: Facts) -> list[Finding]:
    """What is wrong, the gravest first, and each cause once."""
    found = [finding for check in CHECKS for finding in check(facts)]
    if not any(finding.weight == "error" for finding in found):
        found += way.nobody(facts)
    once = {(finding.cause, finding.what): finding for finding in reversed(found)}
    return sorted(reversed(once.values()), key=lambda finding: ORDER.index(finding.weight))
