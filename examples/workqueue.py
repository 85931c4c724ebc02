"""A work queue that tolerates the loss of workers: the job of a failed worker returns to the queue.

``python examples/workqueue.py --port 7000 boss 20`` puts twenty jobs and waits for their results.  Start workers in
other terminals with ``... --port 7001 --known 127.0.0.1:7000 worker ann --dies 0.2``.  ``--dies`` is the probability
that a worker fails during a job.
"""

from __future__ import annotations

import argparse
import os
import random
from typing import Any

from peer import joined
from twisted.internet import defer, task

from middleware.entangled.space.tuplespace import TupleSpace

WORK_S = 0.2
LEASE_S = 1.5
"""Longest duration of a job in seconds; the job of a failed worker returns to the queue after this time."""


async def boss(space: TupleSpace, jobs: int) -> None:
    """Put jobs and collect their results."""
    for number in range(jobs):
        await space.put(("job", number))
    print("jobs are put:", jobs, flush=True)
    done: dict[object, object] = {}
    while len(done) < jobs:
        _, number, worker, result = await space.get(("done", int, str, int))
        # If a worker fails after it put its result and before confirm(), another worker puts a second result.
        if number not in done:
            done[number] = result
            print(f"{number} squared is {result}, says {worker} ({len(done)} of {jobs})", flush=True)


async def work(reactor: Any, space: TupleSpace, name: str, dies: float) -> None:
    """Do jobs; exit during a job with the probability ``dies``, without confirming the job."""
    rng = random.SystemRandom()
    while True:
        claim = await space.claim(("job", int), lease=LEASE_S)
        number: Any = claim.fields[1]
        await task.deferLater(reactor, WORK_S)
        if rng.random() < dies:
            print(f"{name} dies over {number}", flush=True)
            os._exit(1)
        await space.put(("done", number, name, number * number))
        await claim.confirm()


async def main(reactor: Any, args: argparse.Namespace) -> None:
    """Run a boss or a worker."""
    node = await joined(reactor, args.port, args.known)
    space = TupleSpace(node, reactor, random.SystemRandom())
    await (boss(space, args.jobs) if args.role == "boss" else work(reactor, space, args.name, args.dies))
    space.stop()


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--port", type=int, default=0)
    parser.add_argument("--known", default="", metavar="HOST:PORT")
    roles = parser.add_subparsers(dest="role", required=True)
    roles.add_parser("boss").add_argument("jobs", type=int)
    worker = roles.add_parser("worker")
    worker.add_argument("name")
    worker.add_argument("--dies", type=float, default=0.0)
    args = parser.parse_args()
    task.react(lambda reactor: defer.ensureDeferred(main(reactor, args)))
