"""Measure the directory of up to 10,000 devices: the records of each node, and the cost of a listing.

The model consists of ids only. Each device knows its nearest nodes, and is listed at the positions that
``middleware.directory.prefix`` computes; the k nodes closest to a position store that list, and
``middleware.directory.listing`` reads the lists. The team consists of complete nodes in virtual time, connected by one
switchboard.
"""

from __future__ import annotations

import argparse
import random
import sys
import time
from bisect import bisect_left
from collections import Counter
from collections.abc import Iterator, Sequence

from benchmarks.bidding import BITS, K, Ring
from middleware.directory.listing import Listing
from middleware.directory.prefix import MAX_UNDIVIDED, choose_depth, compute_lease, compute_places, estimate_size
from middleware.directory.presence import MAX_DEPTH, Device, parse_device
from middleware.entangled.contact import Contact
from middleware.entangled.kademlia.distance import select_closest
from middleware.entangled.network.switchboard import LinkConditions
from middleware.entangled.record import Record
from sim.team.simulation import SwarmTeam

MAX_SHARE = 0.01
"""The maximum share of the directory at one node, for 10,000 devices."""
LINK = LinkConditions(delay_s=0.02, jitter_s=0.01)
SMALL_TEAM = 40
PAUSE_S = 0.05
"""Seconds between two joins."""
ALIVE_BYTES = 57
"""Size of the encrypted datagram of a keep-alive in bytes, as measured."""


class Model:
    """``n`` devices of a settled team with random ids; the share ``wrong`` has a depth that is wrong by one."""

    def __init__(self, n: int, seed: int, wrong: float = 0.0) -> None:
        rng = random.Random(f"{seed}/model")
        self.contacts = sorted(Ring(n, rng).contacts, key=lambda contact: contact.node_id)
        self._ids = [int.from_bytes(contact.node_id) for contact in self.contacts]
        self.depths: list[int] = []
        self.places: dict[bytes, list[Record]] = {}
        for contact in self.contacts:
            near = self.find_nearest(contact.node_id, K + 1)[1:]
            depth = choose_depth(n if n <= MAX_UNDIVIDED else estimate_size(contact.node_id, near))
            if rng.random() < wrong:
                depth = min(MAX_DEPTH, max(0, depth + rng.choice((-1, 1))))
            self.depths.append(depth)
            device = Device(contact.node_id.hex(), "d", depth=depth)
            for key in compute_places(contact.node_id, depth):
                record = Record(key, "d", contact.public, 1, "leased", 1.0, device.pack(), bytes(64))
                self.places.setdefault(key, []).append(record)
        self.held: Counter[bytes] = Counter()
        for key, records in self.places.items():
            self.held.update({holder.node_id: len(records) for holder in self.find_nearest(key, K)})

    def find_nearest(self, target: bytes, count: int) -> list[Contact]:
        """Return the ``count`` nodes closest to ``target``, from the narrowest id range with that many nodes."""
        number = int.from_bytes(target)
        for bit in range(BITS + 1):
            low = number >> bit << bit
            first, end = bisect_left(self._ids, low), bisect_left(self._ids, low + (1 << bit))
            if end - first >= min(count, len(self._ids)):
                return select_closest(self.contacts[first:end], target, count)
        return []

    def make_listing(self, reader: int) -> Listing:
        """Return the listing that the device with the index ``reader`` obtains."""
        listing = Listing(floor=max(0, self.depths[reader] - 1))
        while (place := listing.take_next()) is not None:
            listing.add_records(place, self.places.get(place.key, []))
        return listing


def make_model_row(n: int, seed: int, wrong: float) -> list[str]:
    """Return a row of the table for ``n`` devices."""
    model = Model(n, seed, wrong)
    loads = sorted(model.held.get(contact.node_id, 0) for contact in model.contacts)
    listing = model.make_listing(0)
    places = sum(map(len, model.places.values())) / n
    lease = sum(compute_lease(depth, 1.0) for depth in model.depths) / n
    signs = sum(
        len(compute_places(c.node_id, d)) * K * 3 / compute_lease(d, 1.0)
        for c, d in zip(model.contacts, model.depths, strict=True)
    )
    return [
        f"{n}",
        f"{wrong:.0%}",
        f"{min(model.depths)}-{max(model.depths)}",
        f"{places:.2f}",
        f"{sum(loads) / n:.1f}",
        f"{loads[-n // 100 - 1]}",
        f"{loads[-1]}",
        f"{loads[-1] / n:.2%}",
        f"{listing.reads}",
        f"{n - len(listing.records)}",
        f"{lease:.0f}",
        f"{signs / n * ALIVE_BYTES:.0f}",
    ]


MODEL_HEADER = [
    *(
        "devices",
        "wrong",
        "depths",
        "places",
        "held",
        "p99",
        "most",
        "share",
        "reads",
        "unseen",
        "lease s",
        "alive B/s",
    ),
]


class Team(SwarmTeam):
    """``n`` real nodes that join one after the other through the first, in virtual time."""

    def __init__(self, n: int, seed: int) -> None:
        super().__init__(n, seed, LINK, PAUSE_S)

    def count_held(self) -> list[int]:
        """Return the number of device records at each live node."""
        return [sum(parse_device(r) is not None for r in node.store.records()) for node in self.nodes if node.running]

    def make_listing(self, place: int) -> Listing:
        """Return the listing of one node, obtained within ten seconds."""
        work = self.nodes[place].list_devices()
        found: list[Listing] = []
        work.addCallback(found.append)
        self.clock.advance(10.0)
        return found[0] if found else Listing()

    def make_row(self, what: str) -> list[str]:
        """Return a row of the table for the present state of the team."""
        started_at, sent, at = time.process_time(), self.switchboard.counters["sent"], self.clock.seconds()
        self.clock.advance(20.0)
        running = [node for node in self.nodes if node.running]
        n, held = len(running), self.count_held()
        each = n * (self.clock.seconds() - at)
        cpu, datagrams = (time.process_time() - started_at) / each, (self.switchboard.counters["sent"] - sent) / each
        depths = [node.presence.device.depth for node in running]
        here = {node.uuid for node in running}
        unseen, strange, reads = 0, 0, 0
        for place in [place for place, node in enumerate(self.nodes) if node.running][:: max(1, n // 4)]:
            listing = self.make_listing(place)
            listed = {device.uuid for device, _ in listing.devices}
            unseen, strange = max(unseen, len(here - listed)), max(strange, len(listed - here))
            reads = max(reads, listing.reads)
        return [
            *(what, f"{n}", f"{min(depths)}-{max(depths)}", f"{sum(held) / n:.1f}", f"{max(held)}"),
            *(f"{max(held) / n:.0%}", f"{reads}", f"{unseen}", f"{strange}"),
            *(f"{datagrams:.1f}", f"{1000 * cpu:.1f}"),
        ]


TEAM_HEADER = [
    *("team", "nodes", "depths", "held", "most", "share", "reads", "unseen", "gone but listed"),
    *("datagrams/s", "CPU ms/s"),
]


def run_team(n: int, seed: int) -> Iterator[list[str]]:
    """Yield rows of a team of real nodes that settles, loses a quarter simultaneously, and shrinks gracefully to 40."""
    team = Team(n, seed)
    team.clock.advance(40.0)
    yield team.make_row("settled")
    rng = random.Random(f"{seed}/death")
    for node in rng.sample(team.nodes[1:], n // 4):
        node.stop_silently()
    yield team.make_row("quarter gone, 20 s")
    team.clock.advance(60.0)
    yield team.make_row("120 s and more")
    running = [node for node in team.nodes if node.running]
    for node in rng.sample(running[1:], max(0, len(running) - SMALL_TEAM)):
        node.stopService()
        team.clock.advance(PAUSE_S)
    team.clock.advance(80.0)
    yield team.make_row("40 stay")
    for node in team.nodes:
        if node.running:
            node.stopService()


MOST, UNSEEN = MODEL_HEADER.index("most"), MODEL_HEADER.index("unseen")


def format_table(rows: Sequence[Sequence[str]]) -> str:
    """Format rows in columns, each as wide as its widest entry."""
    widths = [max(len(row[n]) for row in rows) for n in range(len(rows[0]))]
    return "\n".join("  ".join(cell.rjust(width) for cell, width in zip(row, widths, strict=True)) for row in rows)


def main(arguments: Sequence[str]) -> int:
    """Print the tables; return 1 if a node stores more than its share, or a listing is incomplete."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.directory", description=__doc__)
    parser.add_argument(
        "--devices", type=int, nargs="+", default=[1000, 10_000], help="numbers of devices in the model"
    )
    parser.add_argument("--team", type=int, default=0, help="number of real nodes, in a second table")
    parser.add_argument("--seed", type=int, default=1)
    args = parser.parse_args(arguments)
    rows = [make_model_row(n, args.seed, wrong) for n in args.devices for wrong in (0.0, 0.2)]
    print(format_table([MODEL_HEADER, *rows]), flush=True)
    if args.team:
        for row in run_team(args.team, args.seed):  # each row takes minutes of processor time for large teams
            print(", ".join(f"{name} {cell}" for name, cell in zip(TEAM_HEADER, row, strict=True)), flush=True)
    # Check only rows with correct depths: with wrong depths, a listing may miss one device in some thousands.
    right = [row for row in rows if row[1] == "0%"]
    is_good = all(row[UNSEEN] == "0" for row in right)
    return 0 if is_good and all(int(row[MOST]) <= max(100, MAX_SHARE * int(row[0])) for row in right) else 1


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
