"""Diagnosis: every check over the facts of one node, and those of the machine that it runs on; pure."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator

from swarmnode.doctor import team, way
from swarmnode.doctor.facts import ORDER, Facts, Finding, error, warning

LEAST_FREE = 16 * 2**20
"""Bytes of free disk below which a store may soon be unable to write."""
NEARLY = 0.9


def diagnosed(facts: Facts) -> list[Finding]:
    """What is wrong, the gravest first, and each cause once."""
    found = [finding for check in CHECKS for finding in check(facts)]
    if not any(finding.weight == "error" for finding in found):
        found += way.nobody(facts)
    once = {(finding.cause, finding.what): finding for finding in reversed(found)}
    return sorted(reversed(once.values()), key=lambda finding: ORDER.index(finding.weight))


def port(facts: Facts) -> Iterator[Finding]:
    """Whether the node could open its port."""
    if facts.port_problem and not facts.is_running:
        yield error(
            "port-in-use",
            f"UDP port {facts.port} cannot be opened.",
            facts.port_problem,
            "End the program that holds it (ss -lunp shows it), or leave [node] port out, so that a free one is taken.",
        )


def store(facts: Facts) -> Iterator[Finding]:
    """Whether the store can be written, and has room."""
    where, health = facts.storage, facts.health
    if where is not None and where.problem:
        yield error(
            "store-unwritable",
            f"The store {where.path} cannot be written.",
            where.problem,
            "Mend that, or name another.",
        )
    elif health is not None and health.trouble:
        yield error(
            "store-unwritable", "The node cannot write its store.", health.trouble, "Make room, or mend the disk."
        )
    elif where is not None and where.free is not None and where.free < LEAST_FREE:
        free = f"{where.free / 2**20:.0f} MiB are free where {where.path} lies."
        yield warning("disk-full", "The disk of the store is nearly full.", free, "Make room.")
    if health is None:
        return
    for used, most, what, key in (
        (health.rows, health.max_rows, "records", "store_rows"),
        (health.bytes, health.max_bytes, "bytes", "store_bytes"),
    ):
        if most and used >= NEARLY * most:
            full = used >= most
            yield (error if full else warning)(
                "store-full",
                f"The node's store is {'full' if full else 'nearly full'}.",
                f"It holds {used:,} of {most:,} {what}.",
                f"Raise [node] {key}, or add nodes.",
            )


def files(facts: Facts) -> Iterator[Finding]:
    """Whether others can read the node's secrets."""
    for path, mode in facts.open_files:
        yield error(
            "key-readable",
            f"Others can read {path}, which holds secrets.",
            f"Its mode is {mode:04o}.",
            f"chmod 600 {path}; if somebody may have read it, have its key replaced.",
        )


CHECKS: tuple[Callable[[Facts], Iterable[Finding]], ...] = (
    port,
    store,
    files,
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
