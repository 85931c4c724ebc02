"""The checks of ``swarm doctor`` over the facts of one node and its machine.  Pure."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator

from swarmnode.doctor import network_path, team
from swarmnode.doctor.facts import SEVERITIES, Facts, Finding, make_error, make_warning

MIN_FREE_BYTES = 16 * 2**20
"""Bytes of free disk space below which a warning is given."""
NEARLY_FULL_SHARE = 0.9


def diagnose(facts: Facts) -> list[Finding]:
    """Return the problems, the most serious first; a cause is listed once."""
    found = [finding for check in CHECKS for finding in check(facts)]
    if not any(finding.weight == "error" for finding in found):
        found += network_path.check_bootstrap(facts)
    once = {(finding.cause, finding.what): finding for finding in reversed(found)}
    return sorted(reversed(once.values()), key=lambda finding: SEVERITIES.index(finding.weight))


def check_port(facts: Facts) -> Iterator[Finding]:
    """Check that the node can open its port."""
    if facts.port_problem and not facts.is_running:
        yield make_error(
            "port-in-use",
            f"UDP port {facts.port} cannot be opened.",
            facts.port_problem,
            "Stop the program that uses it (see ss -lunp), or remove [node] port to use any free port.",
        )


def check_store(facts: Facts) -> Iterator[Finding]:
    """Check that the store is writable and not full."""
    storage, health = facts.storage, facts.health
    if storage is not None and storage.problem:
        yield make_error(
            "store-unwritable",
            f"The store {storage.path} cannot be written.",
            storage.problem,
            "Fix this problem, or choose another file in [node] store.",
        )
    elif health is not None and health.trouble:
        yield make_error(
            "store-unwritable", "The node cannot write its store.", health.trouble, "Free disk space, or fix the disk."
        )
    elif storage is not None and storage.free is not None and storage.free < MIN_FREE_BYTES:
        free = f"The disk of {storage.path} has {storage.free / 2**20:.0f} MiB free."
        yield make_warning("disk-full", "The disk of the store is nearly full.", free, "Free disk space.")
    if health is None:
        return
    for used, most, what, key in (
        (health.rows, health.max_rows, "records", "store_rows"),
        (health.bytes, health.max_bytes, "bytes", "store_bytes"),
    ):
        if most and used >= NEARLY_FULL_SHARE * most:
            full = used >= most
            yield (make_error if full else make_warning)(
                "store-full",
                f"The node's store is {'full' if full else 'nearly full'}.",
                f"It contains {used:,} of at most {most:,} {what}.",
                f"Raise [node] {key}, or add nodes.",
            )


def check_files(facts: Facts) -> Iterator[Finding]:
    """Check that other users cannot read the node's secrets."""
    for path, mode in facts.open_files:
        yield make_error(
            "key-readable",
            f"Other users can read {path}, which contains secrets.",
            f"Its mode is {mode:04o}.",
            f"Run chmod 600 {path}; if another user may have read the file, replace its key.",
        )


CHECKS: tuple[Callable[[Facts], Iterable[Finding]], ...] = (
    check_port,
    check_store,
    check_files,
    team.check_certificate,
    team.report_rejections,
    team.check_version,
    team.check_team,
    team.check_clock,
    network_path.check_interface,
    network_path.check_known_nodes,
    network_path.check_multicast,
    network_path.report_nat,
)
