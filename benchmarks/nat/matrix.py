"""Run trials with real nodes for every pair of NAT kinds, many at a time in one test network."""

from __future__ import annotations

import asyncio
import itertools
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from random import Random
from typing import Any

from benchmarks.nat.hosts import Hosts
from benchmarks.nat.outcome import ALONE, FORGOTTEN, HOME, IDLE, LEAKY, LOSS, MATRIX, MOVED, PLAIN, RENUMBERED, Outcome
from benchmarks.remote import OrderFailed
from middleware.entangled.identity import Identity
from sim.namespaces.internet import PUBLIC_ADDRESSES, PUBLIC_HOST, Internet, Site
from sim.namespaces.nat import NatKind

JOIN_S, LOSSY_JOIN_S = 6.0, 20.0
MEET_S, LOSSY_MEET_S = 6.0, 10.0
BACK_S = 12.0
LATE_MS = 500.0
"""Delay in ms of the bootstrap node's messages to the late node of a pair."""
LOST_PERCENT = 30.0
SHORT_S = 20
HOMES = (NatKind.FULL, NatKind.PORT, NatKind.SYM)
"""Kinds with two hosts behind one router."""


@dataclass(frozen=True)
class Pair:
    """Two hosts to connect; ``a`` and ``b`` are their kinds in the table."""

    part: str
    a: str
    b: str
    host_a: str
    host_b: str
    note: str = ""


def list_sites() -> list[Site]:
    """Return all sites of a run: two of each kind, and the sites of the special cases."""
    both = [
        Site(f"{kind.value}{side}", kind, 2 if side == "a" and kind in HOMES else 1)
        for kind in (*MATRIX, NatKind.LEAKY)
        for side in ("a", "b")
    ]
    late = [Site("lateleaky", NatKind.LEAKY), Site("lateport", NatKind.PORT)]
    return [
        *both,
        *late,
        Site("short", NatKind.PORT),
        Site("wifi", NatKind.PORT, len(ROAMERS)),
        Site("phone", NatKind.SYM),
    ]


def list_plain_pairs(part: str) -> list[Pair]:
    """Return every pair of the matrix once."""
    pairs = itertools.combinations_with_replacement(MATRIX, 2)
    return [Pair(part, a.value, b.value, f"{a.value}a1", f"{b.value}b1") for a, b in pairs]


def list_special_pairs() -> list[Pair]:
    """Return pairs behind one router, and pairs with routers without a firewall, some of them with one late node."""
    homes = [Pair(HOME, k.value, k.value, f"{k.value}a1", f"{k.value}a2") for k in HOMES]
    leaky = [
        Pair(LEAKY, "leaky", "leaky", "leakya1", "leakyb1"),
        Pair(LEAKY, "port", "leaky", "porta1", "leakyb1"),
        Pair(LEAKY, "leaky", "leaky", "lateleaky1", "leakyb1", "the first is late"),
        Pair(LEAKY, "leaky", "port", "lateleaky1", "portb1", "the first is late"),
        Pair(LEAKY, "port", "leaky", "lateport1", "leakyb1", "the first is late"),
    ]
    return [*homes, *leaky]


def list_roaming_pairs() -> list[Pair]:
    """Return pairs whose first host will move to another network."""
    return [Pair(MOVED, "port", to, roamer, f"{to}b1", NOTE_MOVED) for roamer, to in ROAMERS.items()]


NOTE_MOVED = "the first moves from Wi-Fi (port) to a phone network (sym)"
ROAMERS = {"wifi1": "none", "wifi2": "port", "wifi3": "full"}
"""Hosts that move, and the kind of the peer that they are connected to."""
IDLE_PAIR = Pair(IDLE, "port", "port", "short1", "portb1", "mappings of the first live for 20 s")


class Trial:
    """A team of three: a bootstrap node on the public host, and the two nodes of a pair."""

    def __init__(self, hosts: Hosts, pair: Pair, number: int, rng: Random) -> None:
        self.pair = pair
        self._hosts = hosts
        self._name = f"t{number}"
        self._number = number
        self._key = rng.randbytes(16).hex()
        self._seeds = {host: rng.randbytes(32) for host in (PUBLIC_HOST, pair.host_a, pair.host_b)}
        self._publics = {host: Identity(seed).public.hex() for host, seed in self._seeds.items()}
        self._is_swapped = rng.random() < 0.5
        self.outcome = Outcome(pair.part, pair.a, pair.b, [None, None], note=pair.note)

    @property
    def join_order(self) -> tuple[str, str]:
        """The two hosts, in the order of joining."""
        both = (self.pair.host_a, self.pair.host_b)
        return (both[1], both[0]) if self._is_swapped and not self.pair.note else both

    async def run(self, join_s: float, meet_s: float) -> None:
        """Let the two nodes join, one after the other, and measure the time until they are connected."""
        try:
            port = (await self._start(PUBLIC_HOST, [], join_s))["port"]
            for host in self.join_order:
                answer = await self._start(host, [f"{PUBLIC_ADDRESSES[0]}:{port}"], join_s)
                if answer["joined_s"] is None:
                    raise OrderFailed(f"{host} did not join within {join_s:g} s")
                self.outcome.joined_s.append(answer["joined_s"])
            met = await asyncio.gather(*(self._send_order("meet", host, meet_s) for host in self.join_order))
            self.outcome.took_s = [answer["took_s"] for answer in met]
            self.outcome.path = await self._find_worse_path([answer["path"] for answer in met])
        except OrderFailed as error:
            self.outcome.trouble = str(error)

    async def measure_reconnection(self, part: str, first: int) -> Outcome:
        """Measure the time until one side of a connected pair reaches the other again."""
        host = self.join_order[first]
        outcome = Outcome(part, self.pair.a, self.pair.b, [None], note=self.pair.note)
        try:
            answer = await self._send_order("call", host, BACK_S)
            outcome.took_s = [answer["took_s"]]
            outcome.path = await self._find_worse_path([answer["path"]])
        except OrderFailed as error:
            outcome.trouble = str(error)
        return outcome

    async def record_path(self) -> None:
        """Record the present path between the two nodes."""
        try:
            self.outcome.later = await self._find_worse_path(
                [await self._read_path(host, self._peer_of(host)) for host in self.join_order]
            )
        except OrderFailed as error:
            self.outcome.trouble = str(error)

    async def end(self) -> None:
        """Stop its nodes."""
        for host in self._seeds:
            await self._hosts[host].run_order("stop", trials=[self._name])

    def _peer_of(self, host: str) -> str:
        return next(public for other, public in self._publics.items() if other not in (host, PUBLIC_HOST))

    async def _send_order(self, do: str, host: str, limit_s: float) -> dict[str, Any]:
        return await self._hosts[host].run_order(do, limit_s, trial=self._name, peer=self._peer_of(host))

    async def _read_path(self, host: str, peer: str) -> str:
        return str((await self._hosts[host].run_order("path", trial=self._name, peer=peer))["path"])

    async def _find_worse_path(self, between: Sequence[str]) -> str:
        """Return the worse path of the two directions; a relayed path that begins with a tunnel counts as a tunnel."""
        to_bootstrap = [await self._read_path(host, self._publics[PUBLIC_HOST]) for host in self.join_order]
        if "" in between:
            return ""  # one node never received an answer
        if any(path != "direct" for path in between):
            return "tunnel" if "tunnel" in (*between, *to_bootstrap) else "relayed"
        return "direct"

    async def _start(self, host: str, known: list[str], limit_s: float) -> dict[str, Any]:
        tunnel_port = 4430 + self._number
        # A node that will move listens at all addresses of its host.
        address = "*" if host in ROAMERS else self._hosts.net.address(host)
        node: dict[str, Any] = {"name": self._name, "host": address, "port": 0, "team_key": self._key}
        node |= {"known_nodes": known, "lan": False}
        if host == PUBLIC_HOST:
            node |= {"roles": ["bootstrap"], "tunnel_port": tunnel_port}
        else:
            node |= {"tunnels": [f"wss://{PUBLIC_ADDRESSES[0]}:{tunnel_port}"]}
        sought = [self._peer_of(host)] if known else []
        order = {"trial": self._name, "node": node, "seed": self._seeds[host].hex(), "sought": sought}
        return await self._hosts[host].run_order("start", limit_s, **order)


class Matrix:
    """A run: ``count`` rounds of every pair, ``lossy`` rounds with loss; ``say`` receives progress messages."""

    def __init__(self, net: Internet, hosts: Hosts, seed: int, say: Callable[[str], None]) -> None:
        self.outcomes: list[Outcome] = []
        self._net = net
        self._hosts = hosts
        self._rng = Random(seed)
        self._say = say
        self._numbers = itertools.count(1)
        self._started_at = time.monotonic()

    async def run(self, count: int, lossy: int) -> None:
        """Run all parts."""
        self._net.set_mapping_timeout("short", SHORT_S)
        for site in ("lateleaky", "lateport"):
            self._net.impair(PUBLIC_HOST, to=f"{site}-gw", delay=LATE_MS)
        (idle,) = await self._run_wave([IDLE_PAIR], JOIN_S, MEET_S)
        started_at = time.monotonic()
        pairs = [*list_plain_pairs(PLAIN), *list_special_pairs()]
        for number in range(count):
            trials = await self._run_wave(pairs, JOIN_S, MEET_S)
            self.outcomes += [trial.outcome for trial in trials]
            if number < count - 1:
                await self._end(trials)
        if count:
            await self._reset_mappings([trial for trial in trials if trial.pair.part == PLAIN])
            await self._end(trials)
            await self._move_hosts()
        for name in self._net.sites:
            self._net.impair(name, loss=LOST_PERCENT)
        for _ in range(lossy):
            trials = await self._run_wave(list_plain_pairs(LOSS), LOSSY_JOIN_S, LOSSY_MEET_S)
            self.outcomes += [trial.outcome for trial in trials]
            await self._end(trials)
        for name in self._net.sites:
            self._net.heal(name)
        if count and lossy:
            self._report(f"{time.monotonic() - started_at:.0f} s without a call between the two of the idle pair")
            self.outcomes.append(await idle.measure_reconnection(IDLE, 1))

    async def _run_wave(self, pairs: Sequence[Pair], join_s: float, meet_s: float) -> list[Trial]:
        """Run trials for all pairs at the same time."""
        trials = [Trial(self._hosts, pair, next(self._numbers), self._rng) for pair in pairs]
        await asyncio.gather(*(trial.run(join_s, meet_s) for trial in trials))
        await asyncio.gather(*(trial.record_path() for trial in trials if not trial.outcome.trouble))
        there = [trial.outcome for trial in trials if not trial.outcome.trouble]
        self._report(f"{pairs[0].part}: {_count_answered(there)} of {len(trials)} pairs have met")
        return trials

    async def _reset_mappings(self, trials: Sequence[Trial]) -> None:
        """Cut the bootstrap node off, then reset the mappings and change the external addresses; record recoveries."""
        met = [trial for trial in trials if None not in trial.outcome.took_s]
        self._net.cut(PUBLIC_HOST)
        direct = [trial for trial in met if trial.outcome.later == "direct"]
        found = await asyncio.gather(*(trial.measure_reconnection(ALONE, 0) for trial in direct))
        self._net.heal(PUBLIC_HOST)
        self.outcomes += found
        self._report(f"{ALONE}: {_count_answered(found)} of {len(direct)} direct pairs go on")
        routers = [name for name, site in self._net.sites.items() if site.kind is not NatKind.NONE and name != "short"]
        for part, first, change in ((FORGOTTEN, 0, self._net.reset_mappings), (RENUMBERED, 1, self._net.renumber)):
            for name in routers:
                change(name)
            found = await asyncio.gather(*(trial.measure_reconnection(part, first) for trial in met))
            self.outcomes += found
            self._report(f"{part}: {_count_answered(found)} of {len(found)} pairs are back")

    async def _move_hosts(self) -> None:
        """Move hosts to another network; record whether both sides reach each other again."""
        trials = await self._run_wave(list_roaming_pairs(), JOIN_S, MEET_S)
        for trial in trials:
            self._net.move(trial.pair.host_a, "phone")
        both = [trial.measure_reconnection(MOVED, first) for trial in trials for first in (0, 1)]
        found = await asyncio.gather(*both)
        self.outcomes += found
        self._report(f"{MOVED}: {_count_answered(found)} of {len(found)} sides are back")
        await self._end(trials)

    async def _end(self, trials: Sequence[Trial]) -> None:
        await asyncio.gather(*(trial.end() for trial in trials))

    def _report(self, line: str) -> None:
        self._say(f"{time.monotonic() - self._started_at:6.1f} s  {line}")


def _count_answered(outcomes: Sequence[Outcome]) -> int:
    """Return the number of trials in which both sides got an answer."""
    return sum(None not in one.took_s for one in outcomes)
