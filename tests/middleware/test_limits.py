"""Tests that docs/reference/limits.md matches the code and that invented identities cannot exceed the limits."""

from __future__ import annotations

import importlib
import random
import re
from collections import deque
from pathlib import Path
from typing import Any

from middleware.entangled.identity import Identity
from middleware.entangled.kademlia import overlay
from middleware.entangled.nat import (
    external_address,
    introducer,
    introducer_selector,
    known_peers,
    path_tracker,
    relay_client,
    upgrade,
)
from middleware.entangled.record import Record, hash_key
from middleware.entangled.replication import comparison, replica
from middleware.entangled.wire import admission_check, dispatcher, method, peer
from middleware.entangled.wire.endpoint import Endpoint
from tests.fleet import TEAM_KEY, FleetCase

PAGE = Path(__file__).resolve().parents[2] / "docs" / "reference" / "limits.md"
ROW = re.compile(r"([\d]+)[^`\d]*`([\w/]+\.py)::([A-Z_]+)`")
SMALL = 24
CROWD = 60
PATCHED = (
    *((dispatcher, "MAX_REQUESTERS"), (method, "MAX_REQUESTERS"), (overlay, "MAX_RECORDED"), (comparison, "MAX_PEERS")),
    *(
        (replica, "MAX_MISMATCHED"),
        (known_peers, "MAX_PEERS"),
        (admission_check, "MAX_IDENTITIES"),
        (peer, "MAX_PEERS"),
    ),
    *(
        (module, "MAX_KNOWN")
        for module in (introducer_selector, relay_client, introducer, external_address, upgrade, path_tracker)
    ),
)

# These tables have separate limits, which are larger than ``CROWD``.
OTHERS: tuple[str, ...] = ("_members", "_listed_at", "_requests", "_peers", "sessions", "_responses", "_unconfirmed")
OTHERS += ("_contacts", "_store", "_entries", "_live", "_absent")
OTHERS += ("_switchboard._names", "_switchboard._untraced")  # These tables belong to the simulation, not to a node.


class PageTests(FleetCase):
    def test_figures(self) -> None:
        """Each limit on the page equals the constant in the code."""
        rows = ROW.findall(PAGE.read_text(encoding="utf-8"))
        self.assertGreater(len(rows), 60)
        for figure, place, name in rows:
            module = importlib.import_module(place.removesuffix(".py").replace("/", "."))
            self.assertEqual(getattr(module, name), float(figure), f"{place}::{name}")


class CrowdTests(FleetCase):
    """An open team with a member that invents identities."""

    def test_tables_stay_small(self) -> None:
        """If a member invents identities and sends all types of request, no table of a node exceeds its limit."""
        for module, name in PATCHED:
            self.patch(module, name, SMALL)
        team = self.swarm(1)
        node = team.nodes[0]
        _ = node.entangled.take_acceptor, node.council_manager, node.auction_service
        for number in range(CROWD):
            self.visit(team, node, number)
        team.run(5.0)
        sizes: dict[str, int] = {}
        walk(node, "node", sizes, set())
        over = {
            path: size
            for path, size in sizes.items()
            if size > 2 * SMALL and not path.startswith(("node.store", "node.clock")) and not path.endswith(OTHERS)
        }
        self.assertEqual(over, {})
        self.assertGreater(max(sizes.values()), SMALL)

    def visit(self, team: Any, node: Any, number: int) -> None:
        """Send each type of request once as an invented identity, then stop this identity's endpoint."""
        own = Identity(random.Random(f"crowd {number}").randbytes(32))
        network = team.switchboard.make_network(f"10.9.{number}.1", 7)
        crowd = Endpoint(own, TEAM_KEY, network, team.clock, random.Random(number))
        crowd.start()
        crowd.expose("ping", lambda peer, digest: bytes(8), changes=True)
        key = hash_key(f"{number}")
        record = Record(key, "x", own.public, 1, "leased", 60.0, b"v").sign(own)
        questions: tuple[tuple[Any, ...], ...] = (
            ("ping", bytes(8)),
            ("store", [record.pack()]),
            ("watch", key, bytes(8)),
            ("alive", 60.0, bytes(8)),
            ("digests", 3, 1),
            ("members", b""),
            ("settled",),
            ("missing", [bytes(8)]),
            ("places", 0, []),
            ("stream.open", "camera"),
            ("reach.meet", own.public, [["10.0.0.77", 9]], 0),
            ("reach.introduce", bytes(20), [], 0),
            ("lease.prepare", f"t{number}", 1, 1, 5.0),
        )
        for name, *arguments in questions:
            asked = crowd.ask(node.entangled.contact, name, *arguments, changes=True)
            asked.addErrback(lambda failure: None)
            team.run(0.01)
        team.run(0.05)
        crowd.stop()


def walk(thing: Any, path: str, sizes: dict[str, int], seen: set[int]) -> None:
    """Record the size of every table that can be reached through the attributes of a node."""
    if id(thing) in seen or isinstance(thing, str | bytes | int | float | random.Random | type):
        return
    seen.add(id(thing))
    if isinstance(thing, dict | list | set | deque | tuple | frozenset):
        sizes[path] = max(sizes.get(path, 0), len(thing))
        for each in [*thing.values(), *thing] if isinstance(thing, dict) else list(thing):
            walk(each, path + "[]", sizes, seen)
    elif type(thing).__module__.startswith("middleware."):
        names = [*getattr(thing, "__dict__", ())]
        names += [name for kind in type(thing).__mro__ for name in getattr(kind, "__slots__", ())]
        for name in names:
            if hasattr(thing, name):
                walk(getattr(thing, name), f"{path}.{name}", sizes, seen)
