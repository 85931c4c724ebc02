"""Send forged datagrams to a node: ``python -m benchmarks.flood``.

Two nodes of a closed team, each a process, call each other over loopback. Meanwhile a third process sends 20,000 forged
datagrams a second to one of them from a thousand addresses. These are random bytes, well-formed handshakes without a
valid mac, datagrams for a real session, recordings, DISCOVERY, PROBE and JOIN_REQUEST messages, and a mix of all. The
program prints the share of answered calls, the delay of heartbeats, the bytes that the node sent to the attacker, its
memory, and the processor time per forged datagram. It exits with 1 if a target is missed. Linux only, because it uses
addresses of 127.0.0.0/8 and ``/proc``.
"""

from __future__ import annotations

import argparse
import json
import os
import random
import resource
import socket
import sys
import tempfile
import time
from collections.abc import Callable, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any

from benchmarks.measure import ChildProcess, percentile
from middleware.admission import join_codec, membership_file
from middleware.admission.operator import create_operator
from middleware.entangled.identity import Identity
from middleware.entangled.wire import discovery, probe, session

RATE_PER_S = 20_000
DURATION_S = 20.0
SOURCES = 1000
PAUSE_S = 0.002
WARM_UP_S = 4.0
"""Seconds without a flood, for the reference values."""
KINDS = ("random", "init", "data", "replay", "who", "hail", "knock", "mixed")
TARGETS = {"good": 0.99, "late_ms": 100.0, "amplification": 1.0, "growth_mib": 16.0, "cost_us": 25.0, "rate": 0.9}
"""Minimum share of good calls; maximum delay of heartbeats (p99); maximum bytes out per byte in; maximum memory growth;
maximum processor time of the node per forged datagram, including the kernel; minimum share of the requested rate."""
CAPS = {"responses": 512, "unconfirmed": 512, "peers": 4096, "sessions": 4096, "led": 1024, "seen": 1024}


def main(arguments: Sequence[str] | None = None) -> int:
    """Measure and print; return 1 if a target is missed."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.flood", description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--seconds", type=float, default=DURATION_S, help="duration of the flood (default %(default)s)")
    parser.add_argument("--rate", type=int, default=RATE_PER_S, help="datagrams a second (default %(default)s)")
    parser.add_argument("--out", type=Path, help="write the figures to this file, as JSON")
    parser.add_argument("--fire", help=argparse.SUPPRESS)
    args = parser.parse_args(arguments)
    if args.fire:
        return _send_flood(json.loads(sys.stdin.readline()))
    if args.seconds < len(KINDS) or not 0 < args.rate <= 100_000:
        parser.error(f"--seconds must be {len(KINDS)} or more, --rate 1 to 100000")
    found = _measure(args.seconds, args.rate)
    missed = _print_table(found)
    if args.out:
        args.out.parent.mkdir(parents=True, exist_ok=True)
        args.out.write_text(json.dumps({**found, "missed": missed}, indent=1) + "\n")
    return 1 if missed else 0


# -- the attacker --------------------------------------------------------------------------------------------------


def make_generators(order: dict[str, Any]) -> dict[str, Callable[[], bytes]]:
    """Return a generator of datagrams for each kind, from the knowledge of an eavesdropper."""
    rng = random.Random(7)
    rubbish = rng.randbytes(1 << 20)
    recorded = [bytes.fromhex(each) for each in order["recorded"]]
    indexes = [index.to_bytes(4, "little") for index in order["index"]] or [bytes(4)]
    number = 0

    def some(size: int) -> bytes:
        start = rng.randrange(len(rubbish) - size)
        return rubbish[start : start + size]

    def data() -> bytes:
        nonlocal number
        number += 1
        head = bytes([session.DATA]) + rng.choice(indexes)
        return bytes(head) + (1_000_000 + number).to_bytes(8, "little") + some(60)

    single: dict[str, Callable[[], bytes]] = {
        "random": lambda: some(rng.randrange(1, 1400)),
        # The length and padding are those of a real INIT. The mac, which needs the team's secret, is zeros, and there
        # is no payment.
        "init": lambda: bytes([session.INIT]) + some(1283) + bytes(16),
        "data": data,
        "replay": lambda: rng.choice(recorded),
        "who": lambda: bytes([discovery.DISCOVERY]) + some(discovery.DISCOVERY_BYTES - 1),
        "hail": lambda: probe.pack_probe(some(probe.TOKEN_BYTES)),
        "knock": lambda: bytes([join_codec.JOIN_REQUEST]) + some(join_codec.JOIN_REQUEST_BYTES - 1),
    }
    return {**single, "mixed": lambda: rng.choice(list(single.values()))()}


def _send_flood(order: dict[str, Any]) -> int:
    """Send the requested datagrams, and print their number at the end."""
    resource.setrlimit(resource.RLIMIT_NOFILE, (min(4096, resource.getrlimit(resource.RLIMIT_NOFILE)[1]),) * 2)
    senders = []
    for number in range(SOURCES):
        sender = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        sender.bind((f"127.66.{number // 250}.{1 + number % 250}", 0))
        sender.setblocking(False)
        senders.append(sender)
    to = ("127.0.0.1", order["port"])
    made = make_generators(order)
    fired = {}
    for kind, seconds in order["kinds"]:
        made_one = made[kind]
        started_at, count = time.monotonic(), 0
        while (now := time.monotonic()) < started_at + seconds:
            due = int((now - started_at) * order["rate"])
            while count < due:
                with suppress(BlockingIOError):
                    senders[count % SOURCES].sendto(made_one(), to)
                count += 1
            time.sleep(PAUSE_S)
        fired[kind] = count
        sys.stdout.write(json.dumps({"kind": kind, "fired": count}) + "\n")
        sys.stdout.flush()
        sys.stdin.readline()  # until the measuring process is ready for the next kind
    return 0


# -- the measuring process -----------------------------------------------------------------------------------------


def _measure(seconds: float, rate: int) -> dict[str, Any]:
    rng = random.SystemRandom()
    operator = create_operator("flooded", rng)
    first = operator.create_membership("target", ("device", "bootstrap", "gateway"), time.time(), rng)
    second = operator.create_membership("friend", ("device", "gateway"), time.time(), rng, first.secrets[0][1])
    children: list[ChildProcess] = []
    with tempfile.TemporaryDirectory(prefix="flood") as folder:
        paths = [Path(folder) / name for name in ("target", "friend")]
        for path, paper in zip(paths, (first, second), strict=True):
            membership_file.create_membership_file(path, paper)
        keys = [Identity(paper.seed).public.hex() for paper in (first, second)]
        try:
            children.append(ChildProcess("benchmarks.flood_node", str(paths[0]), "", keys[1]))
            port = children[0].read()["ready"]
            children.append(ChildProcess("benchmarks.flood_node", str(paths[1]), f"127.0.0.1:{port}", keys[0]))
            children[1].read()
            return _measure_kinds(children, port, seconds, rate)
        finally:
            for child in children:
                child.end()


def _measure_kinds(children: list[ChildProcess], port: int, seconds: float, rate: int) -> dict[str, Any]:
    target, friend = children[:2]
    time.sleep(1.5)
    begun = [target.request_report(), friend.request_report()]
    time.sleep(WARM_UP_S)
    quiet = [target.request_report(), friend.request_report()]
    sender = ChildProcess("benchmarks.flood", "--fire", "yes")
    children.append(sender)
    each = seconds / len(KINDS)
    order = {"port": port, "rate": rate, "kinds": [(kind, each) for kind in KINDS]}
    sender.write(json.dumps({**order, "recorded": quiet[0]["recorded"], "index": quiet[0]["index"]}))
    idle = _measure_core_share(begun[0], quiet[0])
    before, found = quiet[0], []
    calls, gaps, lags, trips = _sum_calls(()), [], [], []
    peak = quiet[0]["rss"]
    for kind in KINDS:
        fired = sender.read()
        time.sleep(0.05)  # wait for datagrams in the socket buffer
        now, other = target.request_report(), friend.request_report()
        calls = _sum_calls((calls, now["calls"], other["calls"]))
        gaps += now["gaps"] + other["gaps"]
        lags += now["lags"]
        trips += other["trips"]
        peak = max(peak, now["rss"])
        found.append({"kind": kind, "fired": fired["fired"], **_compare(before, now, idle)})
        before = now
        sender.write()
    return {
        "seconds": seconds,
        "rate": rate,
        "quiet": {"cpu": idle, "late_ms": _p99_ms(quiet[0]["gaps"] + quiet[1]["gaps"]), "calls": quiet[1]["calls"]},
        "kinds": found,
        "good": calls["good"] / max(1, calls["good"] + calls["bad"]),
        "calls": calls,
        "late_ms": _p99_ms(gaps),
        "lag_ms": _p99_ms(lags),
        "trip_ms": _p99_ms(trips),
        "bytes": before["bytes"],
        "amplification": before["bytes"]["out"] / max(1, before["bytes"]["in"]),
        "growth_mib": (peak - quiet[0]["rss"]) / 2**20,
        "rss_mib": peak / 2**20,
        "cost_us": max(each["cost_us"] for each in found),
        "rate_reached": sum(each["received"] for each in found) / (rate * seconds),
        "tables": before["tables"],
        "counters": before["counters"],
        "cores": os.cpu_count(),
    }


def _sum_calls(several: Sequence[dict[str, int]]) -> dict[str, int]:
    return {name: sum(each[name] for each in several) for name in ("good", "bad")}


def _measure_core_share(one: dict[str, Any], other: dict[str, Any]) -> float:
    """Return the share of a core between two reports."""
    return float((other["cpu"] - one["cpu"]) / (other["at"] - one["at"]))


def _compare(before: dict[str, Any], now: dict[str, Any], idle: float) -> dict[str, Any]:
    count = now["bytes"]["count"] - before["bytes"]["count"]
    spent = now["cpu"] - before["cpu"] - idle * (now["at"] - before["at"])
    bytes_in = now["bytes"]["in"] - before["bytes"]["in"]
    bytes_out = now["bytes"]["out"] - before["bytes"]["out"]
    return {
        "received": count,
        "cost_us": 1e6 * spent / max(1, count),
        "core": _measure_core_share(before, now),
        "in": bytes_in,
        "out": bytes_out,
        "late_ms": _p99_ms(now["gaps"]),
        "good": now["calls"]["good"] / max(1, sum(now["calls"].values())),
    }


def _p99_ms(seconds: Sequence[float]) -> float:
    """Return the 99th percentile in milliseconds."""
    return 1000.0 * percentile(seconds, 0.99)


def _print_table(found: dict[str, Any]) -> list[str]:
    """Print the table; return the names of the missed targets."""
    head = f"{'kind':8}{'fired':>9}{'received':>10}{'us each':>9}{'core':>7}{'bytes in':>12}{'out':>9}{'late ms':>9}"
    lines = [head + f"{'good':>8}"]
    for each in found["kinds"]:
        lines.append(
            f"{each['kind']:8}{each['fired']:9}{each['received']:10}{each['cost_us']:9.1f}{each['core']:7.0%}"
            f"{each['in']:12}{each['out']:9}{each['late_ms']:9.1f}{each['good']:8.1%}"
        )
    verdicts = {
        "good": ("calls good", found["good"], found["good"] >= TARGETS["good"], ".4f"),
        "late_ms": ("heartbeats late, ms (p99)", found["late_ms"], found["late_ms"] <= TARGETS["late_ms"], ".1f"),
        "amplification": (
            *("bytes out for each byte in", found["amplification"]),
            *(found["amplification"] <= TARGETS["amplification"], ".4f"),
        ),
        "growth_mib": ("memory grown, MiB", found["growth_mib"], found["growth_mib"] <= TARGETS["growth_mib"], ".1f"),
        "cost_us": ("us of processor, most expensive", found["cost_us"], found["cost_us"] <= TARGETS["cost_us"], ".1f"),
        "rate": ("share of the rate received", found["rate_reached"], found["rate_reached"] >= TARGETS["rate"], ".3f"),
    }
    missed = [name for name, (_, _, is_met, _) in verdicts.items() if not is_met]
    lines.append("")
    for name, (text, value, is_met, form) in verdicts.items():
        lines.append(f"{text:32}{value:10{form}}   target {TARGETS[name]:g}{'' if is_met else '   MISSED'}")
    over = [name for name, most in CAPS.items() if found["tables"][name] > most]
    missed += [f"cap of {name}" for name in over]
    lines.append(f"{'tables':32}{' '.join(f'{name} {size}' for name, size in found['tables'].items())}")
    lines.append(
        f"{'without a flood':32}heartbeats late {found['quiet']['late_ms']:.1f} ms, core {found['quiet']['cpu']:.1%}"
    )
    sys.stdout.write("\n".join(lines) + "\n")
    return missed


if __name__ == "__main__":
    sys.exit(main())
