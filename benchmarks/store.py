"""Check the guarantees of the data store: rows survive ``kill -9``, restarts are fast, commits block no reactor."""

from __future__ import annotations

import argparse
import hashlib
import os
import random
import signal
import sqlite3
import subprocess
import sys
import tempfile
import time
from contextlib import closing
from dataclasses import dataclass, field
from pathlib import Path
from typing import cast

from twisted.internet.interfaces import IReactorFromThreads

from benchmarks.measure import MIB, percentile, read_memory_bytes
from middleware.entangled.data.sqlite import SqliteStore
from middleware.entangled.record import MAX_VALUE_BYTES, Record, hash_key

ROOT = Path(__file__).resolve().parents[1]
KEY = hash_key("kills")
OWNER = bytes(range(32))
SLOTS = 3000
TTL_S = 1e6
RESTART_LIMIT_S = 2.0
STALL_LIMIT_S = 0.05
"""Maximum delay of the reactor (99th percentile) while the store writes, in addition to the delay when idle."""


def make_record(number: int) -> Record:
    """Return the record with the index ``number``; all of it follows from the number.

    Large values reuse the same slots, so the owner never reaches its storage limit, however fast the writer is.
    """
    rng = random.Random(number)
    size = 60_000 if number % SLOTS % 97 == 0 else rng.randrange(300)
    value = None if number % 7 == 0 else rng.randbytes(size)
    signature = hashlib.blake2b(str(number).encode()).digest()
    return Record(KEY, str(number % SLOTS), OWNER, number, "team", TTL_S, value, signature)


def _print_line(*words: object) -> None:
    sys.stdout.write(" ".join(map(str, words)) + "\n")
    sys.stdout.flush()


# -- kills ------------------------------------------------------------------------------------------------------------


def write_until_killed(path: str, first: int) -> None:
    """Write records from ``first`` on, in groups; after each group print the number of the last safe record."""
    _print_line("opening")
    store = SqliteStore.open(path, 0.0)
    number = first
    while True:
        for _ in range(random.Random(number).choice((1, 1, 3, 20, 50))):
            store.put(make_record(number), TTL_S)
            number += 1
        store.flush(60.0)
        _print_line(number - 1)


@dataclass
class KillResults:
    """The results of a number of kills."""

    kills: int = 0
    acknowledged: int = 0
    early: int = 0
    lost: list[str] = field(default_factory=list)
    damaged: list[str] = field(default_factory=list)

    def is_clean(self) -> bool:
        """Return whether nothing was lost or damaged."""
        return not self.lost and not self.damaged


def run_kills(path: str, count: int, seed: int) -> KillResults:
    """Kill a process that writes to the store ``path``, ``count`` times, and check the file after each kill."""
    rng = random.Random(seed)
    seen = KillResults()
    safe = 0
    for kill in range(1, count + 1):
        first = _highest_number(path) + 1
        command = [sys.executable, "-m", "benchmarks.store", "--child", path, str(first)]
        child = subprocess.Popen(command, cwd=ROOT, stdout=subprocess.PIPE, text=True)
        assert child.stdout is not None
        with closing(child.stdout):
            child.stdout.readline()
            # Some kills happen while the process opens the file.
            time.sleep(rng.choice((rng.uniform(0.0, 0.03), rng.uniform(0.0, 0.3))))
            child.send_signal(signal.SIGKILL)
            lines = [line for line in child.stdout.read().splitlines(keepends=True) if line.endswith("\n")]
            child.wait()
        if child.returncode != -signal.SIGKILL:
            seen.damaged.append(f"kill {kill}: the writer ended by itself with {child.returncode}")
            return seen
        seen.kills = kill
        seen.early += not lines
        last = int(lines[-1]) if lines else safe
        seen.acknowledged += last - first + 1 if lines else 0
        safe = max(safe, last)
        _check_file(path, safe, kill, seen)
    return seen


def _highest_number(path: str) -> int:
    if not os.path.exists(path):
        return 0
    with closing(SqliteStore.open(path, 0.0)) as store:
        return max((record.sequence for record in store.records()), default=0)


def _check_file(path: str, safe: int, kill: int, seen: KillResults) -> None:
    with closing(sqlite3.connect(path)) as connection:
        (verdict,) = connection.execute("PRAGMA integrity_check").fetchone()
        if verdict != "ok":
            seen.damaged.append(f"kill {kill}: {verdict}")
    with closing(SqliteStore.open(path, 0.0)) as store:
        if (kill > 1 and store.origin != "kept") or store.corrupt_rows:
            seen.damaged.append(f"kill {kill}: the store is {store.origin}, {store.corrupt_rows} rows are rotten")
        held = {record.name: record for record in store.records()}
        for number in range(max(1, safe - SLOTS + 1), safe + 1):
            record = held.get(str(number % SLOTS))
            if record is None or record.sequence < number or record != make_record(record.sequence):
                seen.lost.append(f"kill {kill}: row {number}")


# -- restart ----------------------------------------------------------------------------------------------------------


def serve(path: str) -> None:
    """Run a complete node on the store ``path``; print when it serves, its number of rows, and its memory."""
    from swarmnode.memory_savings import block_tls_import

    block_tls_import()
    from twisted.internet import reactor

    from middleware.config.settings import Settings
    from swarmnode.environment import make_dependencies
    from swarmnode.service import NodeService

    settings = Settings.from_mapping({"node": {"name": "bench", "host": "127.0.0.1", "port": 0}}, "benchmark")
    settings = settings.with_flags(store=path, team_key="of the benchmark, and of nobody else")
    dependencies = make_dependencies(settings, reactor)
    service = NodeService(settings, dependencies)

    def serving() -> None:
        service.startService()
        _print_line(len(dependencies.store), read_memory_bytes(), read_memory_bytes("VmHWM"))

    reactor.callWhenRunning(serving)
    reactor.run()


def check_restarts(folder: str, rows: int, times: int = 5) -> bool:
    """Print the time until a node with ``rows`` rows serves; return False if it is too long."""
    _print_line(f"{'rows':>8} {'file MiB':>9} {'serving after s':>16} {'worst s':>8} {'RSS MiB':>8} {'peak MiB':>9}")
    held = True
    for count in (0, rows):
        path = os.path.join(folder, f"{count}.sqlite")
        with closing(SqliteStore.open(path, 0.0, max_rows=max(1, 4 * count))) as store:
            rng = random.Random(count)
            for number in range(count):
                value, signature = rng.randbytes(200), rng.randbytes(64)
                name, owner = str(number), rng.choice((OWNER, OWNER[::-1]))
                store.put(Record(rng.randbytes(20), name, owner, 1, "team", TTL_S, value, signature), TTL_S)
        took, numbers = [], [0, 0, 0]
        for _ in range(times):
            started = time.monotonic()
            child = subprocess.Popen(
                [sys.executable, "-m", "benchmarks.store", "--serve", path], cwd=ROOT, stdout=subprocess.PIPE, text=True
            )
            assert child.stdout is not None
            with closing(child.stdout):
                numbers = [int(word) for word in child.stdout.readline().split()]
                took.append(time.monotonic() - started)
                child.terminate()
                child.wait()
        assert numbers and numbers[0] >= count
        size = os.path.getsize(path) / MIB
        median = sorted(took)[times // 2]
        _print_line(
            f"{count:8} {size:9.1f} {median:16.2f} {max(took):8.2f} {numbers[1] / MIB:8.1f} {numbers[2] / MIB:9.1f}"
        )
        held = held and max(took) <= RESTART_LIMIT_S
    _print_line(f"target: at most {RESTART_LIMIT_S:g} s, the worst of {times}: {'held' if held else 'MISSED'}")
    return held


# -- rate -------------------------------------------------------------------------------------------------------------


class PutRate:
    """Run puts that wait for their commit, ``in_flight`` at a time, and measure the delay of the reactor."""

    TICK_S = 0.002

    def __init__(self, store: SqliteStore, size: int, count: int, in_flight: int, base: int) -> None:
        self._store = store
        self._size = size
        self._count = count
        self._in_flight = in_flight
        self._base = base
        self.latencies: list[float] = []
        self.late: list[float] = []
        self._left = 0

    async def run(self) -> float:
        """Return the duration in seconds; without puts, one second."""
        from twisted.internet import reactor, task
        from twisted.internet.defer import Deferred, gatherResults

        running = True

        def tick(due: float) -> None:
            now = time.monotonic()
            self.late.append(now - due)
            if running:
                reactor.callLater(self.TICK_S, tick, now + self.TICK_S)

        tick(time.monotonic())
        self._left = self._count
        started = time.monotonic()
        if not self._count:
            await task.deferLater(reactor, 1.0)
        await gatherResults([Deferred.fromCoroutine(self._put_next()) for _ in range(self._in_flight)])
        running = False
        return time.monotonic() - started

    async def _put_next(self) -> None:
        while self._left:
            self._left -= 1
            number = self._base + self._left
            rng = random.Random(number)
            record = Record(
                rng.randbytes(20), str(number), OWNER, 1, "team", TTL_S, rng.randbytes(self._size), bytes(64)
            )
            started = time.monotonic()
            self._store.put(record, TTL_S)
            await self._store.wait_for_write()
            self.latencies.append(time.monotonic() - started)


async def _measure_rates(folder: str, outcome: list[bool]) -> None:
    from twisted.internet import reactor

    deliver = cast(IReactorFromThreads, reactor).callFromThread
    _print_line(f"disk: {_measure_sync_s(folder) * 1000:.2f} ms for a write and fsync of 4 KiB (median of 100)")
    _print_line(
        f"{'value':>9} {'in flight':>10} {'puts/s':>8} {'safe after p50':>15} {'p99 ms':>8} {'max ms':>8}"
        f" {'late p99 ms':>12} {'max ms':>8} {'gets/s':>9} {'RSS MiB':>8}"
    )
    base = 0
    with closing(SqliteStore.open(os.path.join(folder, "idle.sqlite"), 0.0, deliver=deliver)) as store:
        idle = PutRate(store, 0, 0, 0, 0)
        await idle.run()
    usual = percentile(idle.late, 0.99)
    _print_line(f"{'idle':>9} {'':61} {usual * 1000:12.2f} {max(idle.late) * 1000:8.2f}")
    for size, count, in_flight in ((200, 1500, 1), (200, 6000, 64), (10_000, 400, 16), (MIB, 24, 4)):
        if size > MAX_VALUE_BYTES and size > 10_000:
            _print_line(f"{size:9} (a record carries at most {MAX_VALUE_BYTES} bytes)")
        path = os.path.join(folder, f"rate-{size}-{in_flight}.sqlite")
        with closing(SqliteStore.open(path, 0.0, max_bytes=64 * MIB, deliver=deliver)) as store:
            rate = PutRate(store, size, count, in_flight, base)
            seconds = await rate.run()
            base += count
            keys = list({record.key for record in store.records()})
            started = time.perf_counter()
            for key in keys * max(1, 20_000 // len(keys)):
                store.get(key)
            gets = len(keys) * max(1, 20_000 // len(keys)) / (time.perf_counter() - started)
        late = percentile(rate.late, 0.99)
        outcome.append(late <= usual + STALL_LIMIT_S)
        _print_line(
            f"{size:9} {in_flight:10} {count / seconds:8.0f} {percentile(rate.latencies, 0.5) * 1000:15.2f}"
            f" {percentile(rate.latencies, 0.99) * 1000:8.2f} {max(rate.latencies) * 1000:8.2f}"
            f" {late * 1000:12.2f} {max(rate.late) * 1000:8.2f} {gets:9.0f} {read_memory_bytes() / MIB:8.1f}"
        )


def _measure_sync_s(folder: str) -> float:
    took = []
    with open(os.path.join(folder, "sync"), "wb", buffering=0) as file:
        for _ in range(100):
            started = time.perf_counter()
            file.write(bytes(4096))
            os.fsync(file.fileno())
            took.append(time.perf_counter() - started)
    return percentile(took, 0.5)


def check_rates(folder: str) -> bool:
    """Print the operations per second of the store; return False if the reactor was delayed too much."""
    from twisted.internet import task

    outcome: list[bool] = []
    try:
        from twisted.internet.defer import Deferred

        task.react(lambda reactor: Deferred.fromCoroutine(_measure_rates(folder, outcome)))
    except SystemExit as ended:
        outcome.append(not ended.code)
    held = all(outcome)
    _print_line(
        f"target: the reactor at most {STALL_LIMIT_S * 1000:g} ms later than an idle one at p99:"
        f" {'held' if held else 'MISSED'}"
    )
    return held


def main() -> int:
    """Run the command."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.store", description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--kills", type=int, default=0, metavar="N", help="kill a writer N times")
    parser.add_argument("--restart", type=int, default=0, metavar="ROWS", help="start a node with that many rows")
    parser.add_argument("--rate", action="store_true", help="measure puts and gets per second, and their durations")
    parser.add_argument("--seed", type=int, default=1, help="seed of the times of the kills")
    parser.add_argument("--folder", default=None, help="folder of the stores, to choose the disk")
    parser.add_argument("--child", nargs=2, metavar=("PATH", "FIRST"), help=argparse.SUPPRESS)
    parser.add_argument("--serve", metavar="PATH", help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.child:
        write_until_killed(options.child[0], int(options.child[1]))
    if options.serve:
        serve(options.serve)
        return 0
    if not (options.kills or options.restart or options.rate):
        parser.error("nothing to do; give --kills, --restart or --rate")
    held = True
    with tempfile.TemporaryDirectory(dir=options.folder) as folder:
        if options.kills:
            started = time.monotonic()
            seen = run_kills(os.path.join(folder, "kills.sqlite"), options.kills, options.seed)
            _print_line(
                f"{'kills':>6} {'before any':>14} {'acknowledged':>13} {'lost':>5} {'damaged':>8} {'seconds':>8}"
            )
            _print_line(
                f"{seen.kills:6} {seen.early:14} {seen.acknowledged:13} {len(seen.lost):5} {len(seen.damaged):8}"
                f" {time.monotonic() - started:8.0f}"
            )
            for line in seen.lost[:10] + seen.damaged[:10]:
                _print_line(line)
            held = seen.is_clean() and held
        if options.restart:
            held = check_restarts(folder, options.restart) and held
        if options.rate:
            held = check_rates(folder) and held
    return 0 if held else 1


if __name__ == "__main__":
    raise SystemExit(main())
