"""Run a function for many seeds, on all cores of this machine or on several machines; results keep their order.

Several machines are connected by Dask (the extra ``[sweep]``): run ``dask scheduler`` on one machine, and ``dask
worker ADDRESS --nworkers auto`` on each, in the same version of the source tree as here. The versions are compared
before the run.
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
PACKAGES = ("formats", "middleware", "agents", "drivers", "sim", "benchmarks", "tests")
"""The packages that affect a run; other files of the source trees may differ."""
QUEUED_PER_WORKER = 4
"""Number of runs submitted in advance per worker, so that no worker is idle."""

_run_lock = threading.Lock()
_is_collector_set: list[bool] = []


def run_seeds(seeds: Sequence[int], one: Callable[[int], T], jobs: int, scheduler: str = "") -> Iterator[T]:
    """Yield the result of ``one`` for each seed, with ``jobs`` processes or with the workers of a ``scheduler``.

    Raises ``BadSetting`` if the scheduler cannot be used.
    """
    if scheduler:
        yield from _run_on_scheduler(seeds, one, scheduler)
    elif jobs == 1 or len(seeds) == 1:
        limit_garbage_collection()
        yield from map(one, seeds)
    else:
        # The workers are spawned, not forked: a fork would inherit threads and a reactor's signal handlers.
        with multiprocessing.get_context("spawn").Pool(jobs, _init_worker) as pool:
            yield from pool.imap(one, seeds)


def limit_garbage_collection() -> None:
    """Collect garbage rarely, because most objects of a run live until its end."""
    gc.freeze()
    gc.set_threshold(200_000, 20, 20)


def hash_sources() -> str:
    """Return a hash of the sources that affect a run, and the version of Python."""
    hashed = hashlib.blake2b(digest_size=8)
    for path in sorted(path for room in PACKAGES for path in (ROOT / room).rglob("*.py")):
        hashed.update(str(path.relative_to(ROOT)).encode() + path.read_bytes())
    return f"{hashed.hexdigest()} on Python {platform.python_version()}"


def _init_worker() -> None:
    """Initialize a worker process: it ignores Ctrl-C, because its parent process ends it."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    limit_garbage_collection()


def _run_exclusively(one: Callable[[int], T], seed: int) -> T:
    """Run ``one``, never twice at the same time in this process, because runs modify shared state."""
    with _run_lock:
        if not _is_collector_set:
            limit_garbage_collection()
            _is_collector_set.append(True)
        return one(seed)


def _run_on_scheduler(seeds: Sequence[int], one: Callable[[int], T], address: str) -> Iterator[T]:
    try:
        from distributed import Client
    except ImportError:
        raise _make_error("Dask is not installed here", "pip install 'swarm-node[sweep]'") from None
    try:
        client: Any = Client(address, timeout="10s", set_as_default=False)
    except (OSError, ValueError, TypeError) as error:
        raise _make_error(f"no scheduler answers at {address} ({error})", "start one: dask scheduler") from None
    with client:
        prints: dict[str, str] = client.run(hash_sources)
        if not prints:
            raise _make_error(
                f"{address} has no workers", f"start some: dask worker {address} --nworkers auto --nthreads 1"
            )
        here = hash_sources()
        if others := sorted(worker for worker, known in prints.items() if known != here):
            raise _make_error(f"the source trees of {', '.join(others)} differ from this one", "update them")
        ahead: deque[Any] = deque()
        for seed in seeds:
            ahead.append(client.submit(partial(_run_exclusively, one), seed, pure=False))
            if len(ahead) >= QUEUED_PER_WORKER * len(prints):
                yield ahead.popleft().result()
        while ahead:
            yield ahead.popleft().result()


def _make_error(problem: str, remedy: str) -> BadSetting:
    return BadSetting("", "--scheduler", problem, remedy)
