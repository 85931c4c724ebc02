"""Sweep: the same run with many seeds, on all cores of this machine or on several machines; results in their order.

Several machines are joined by Dask (the extra ``[sweep]``): ``dask scheduler`` on one, ``dask worker ADDRESS --nworkers
auto`` on each, started in a tree that is the same as here, which is checked before anything is run.
"""

from __future__ import annotations

import gc
import hashlib
import multiprocessing
import platform
import signal
import threading
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from functools import partial
from pathlib import Path
from typing import Any, TypeVar

from middleware.errors import BadSetting

T = TypeVar("T")

ROOT = Path(__file__).resolve().parents[2]
ROOMS = ("formats", "middleware", "agents", "drivers", "sim", "benchmarks", "tests")
"""What a run is made of; other trees may differ in the rest."""
AHEAD = 4
"""So many runs are given out for each worker, that none has to wait for its next one."""

_one_at_a_time = threading.Lock()
_is_spared: list[bool] = []


def sweep(seeds: Sequence[int], one: Callable[[int], T], jobs: int, scheduler: str = "") -> Iterator[T]:
    """What ``one`` gives for each seed, ``jobs`` at a time, or as many as the workers of a ``scheduler`` can.

    Raises ``BadSetting`` where the scheduler cannot be used.
    """
    if scheduler:
        yield from _on_machines(seeds, one, scheduler)
    elif jobs == 1 or len(seeds) == 1:
        spare_the_collector()
        yield from map(one, seeds)
    else:
        # Not by forking: this may run in a process that has threads and a reactor's signal handlers, which a fork
        # inherits.
        with multiprocessing.get_context("spawn").Pool(jobs, _begin) as pool:
            yield from pool.imap(one, seeds)


def spare_the_collector() -> None:
    """Look for garbage rarely: a run makes much that lives as long as it."""
    gc.freeze()
    gc.set_threshold(200_000, 20, 20)


def fingerprint() -> str:
    """What the runs of this tree are made of: a hash over its sources, and the version of Python."""
    hashed = hashlib.blake2b(digest_size=8)
    for path in sorted(path for room in ROOMS for path in (ROOT / room).rglob("*.py")):
        hashed.update(str(path.relative_to(ROOT)).encode() + path.read_bytes())
    return f"{hashed.hexdigest()} on Python {platform.python_version()}"


def _begin() -> None:
    """Begin in a process of its own: whoever gave the order ends it, not the keyboard."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    spare_the_collector()


def _alone(one: Callable[[int], T], seed: int) -> T:
    """Run one, and no other beside it in this process: runs change what they share there."""
    with _one_at_a_time:
        if not _is_spared:
            spare_the_collector()
            _is_spared.append(True)
        return one(seed)


def _on_machines(seeds: Sequence[int], one: Callable[[int], T], address: str) -> Iterator[T]:
    try:
        from distributed import Client
    except ImportError:
        raise _bad("Dask is not installed here", "pip install 'swarm-node[sweep]'") from None
    try:
        client: Any = Client(address, timeout="10s", set_as_default=False)
    except (OSError, ValueError, TypeError) as error:
        raise _bad(f"nobody answers at {address} ({error})", "start one: dask scheduler") from None
    with client:
        prints: dict[str, str] = client.run(fingerprint)
        if not prints:
            raise _bad(f"{address} has no workers", f"start some: dask worker {address} --nworkers auto --nthreads 1")
        here = fingerprint()
        if others := sorted(worker for worker, known in prints.items() if known != here):
            raise _bad(f"{', '.join(others)} would run another tree than this one", "update the tree there")
        ahead: deque[Any] = deque()
        for seed in seeds:
            ahead.append(client.submit(partial(_alone, one), seed, pure=False))
            if len(ahead) >= AHEAD * len(prints):
                yield ahead.popleft().result()
        while ahead:
            yield ahead.popleft().result()


def _bad(problem: str, remedy: str) -> BadSetting:
    return BadSetting("", "--scheduler", problem, remedy)
