"""Run one node in one process; it executes orders in JSON lines, and measures its own operations.

Started as ``python -m benchmarks.dht.child NAME FOLDER``. The same code executes orders, measures times and generates
the load for every library, so differences between results come from the libraries.
"""

from __future__ import annotations

import json
import logging
import os
import random
import sys
import threading
import time
from collections.abc import Callable
from typing import Any, TextIO

from benchmarks.dht.library import LIBRARIES, LibraryNode
from benchmarks.dht.load import Load

Order = dict[str, Any]
RETRY_S = 0.01
TRY_LIMIT_S = 2.0


class OrderExecutor:
    """Execute orders on ``node``, and answer each on ``out`` by its id."""

    def __init__(self, node: LibraryNode, out: TextIO) -> None:
        self._node = node
        self._out = out
        self._lock = threading.Lock()
        self._notified: dict[str, list[float]] = {}
        self._profile: Any = None

    def begin(self) -> None:
        """Start to read orders."""
        threading.Thread(target=self._read, daemon=True).start()
        self._answer({"id": 0})

    def _read(self) -> None:
        for line in sys.stdin:
            self._node.call_soon(self._execute, json.loads(line))
        # The parent process has exited, perhaps without notice.
        os._exit(0)

    def _execute(self, order: Order) -> None:
        try:
            getattr(self, "_do_" + order["do"])(order)
        except NotImplementedError as error:
            self._answer(order, cannot=str(error))

    def _answer(self, order: Order, **fields: object) -> None:
        with self._lock:
            self._out.write(json.dumps({"id": order["id"], **fields}) + "\n")
            self._out.flush()

    # -- orders -----------------------------------------------------------------------------------------------------

    def _do_start(self, order: Order) -> None:
        """Join; if the order contains an existing key ``wanted``, measure the time until its value has been read."""
        started_at = time.monotonic()
        wanted = order.get("wanted")

        def ms() -> float:
            return (time.monotonic() - started_at) * 1000

        def joined() -> None:
            if wanted is None:
                self._answer(order, join_ms=ms())
            else:
                self._start_timing("get", wanted[0], bytes.fromhex(wanted[1]), TRY_LIMIT_S, read)

        def read(is_good: bool, _: float) -> None:
            if is_good or time.monotonic() - started_at > order["limit_s"]:
                self._answer(order, join_ms=ms() if is_good else None)
            else:
                self._node.call_later(RETRY_S, joined)

        self._node.start(order["port"], order["known"], joined)

    def _do_once(self, order: Order) -> None:
        """Execute one operation; ``moment`` is its start, on the clock that all processes of a machine share."""
        moment = time.monotonic()

        def done(is_good: bool, ms: float) -> None:
            self._answer(order, good=is_good, ms=ms, moment=moment)

        key, value = order["key"], order["value"]
        # A long value is represented by its length: reader and writer generate it from the key.
        data = random.Random(key).randbytes(value) if isinstance(value, int) else bytes.fromhex(value)
        self._start_timing(order["kind"], key, data, order["limit_s"], done)

    def _do_load(self, order: Order) -> None:
        """Run operations concurrently: each item ``once``, or all items repeatedly for ``seconds``."""
        Load(self._start_timing, self._node.call_later, order, lambda **fields: self._answer(order, **fields)).fill()

    def _do_space(self, order: Order) -> None:
        """Execute one operation on the tuple space; ``moments`` are its start and end."""
        started_at = time.monotonic()

        def done(is_good: bool) -> None:
            ended = time.monotonic()
            self._answer(order, good=is_good, ms=(ended - started_at) * 1000, moments=[started_at, ended])

        self._node.run_space_operation(order["verb"], order["fields"], order["limit_s"], done)

    def _do_watch(self, order: Order) -> None:
        """Record the time at which each value of a key arrives."""
        value = bytes.fromhex(order["value"])
        moments = self._notified.setdefault(order["key"], [])

        def heard(came: bytes | None) -> None:
            if came == value:
                moments.append(time.monotonic())

        self._node.watch(order["key"], heard, lambda: self._answer(order))

    def _do_heard(self, order: Order) -> None:
        self._answer(order, moments=self._notified.get(order["key"], []))

    def _do_holds(self, order: Order) -> None:
        self._answer(order, holds=self._node.list_held(order["keys"]))

    def _do_lose(self, order: Order) -> None:
        self._node.drop_datagrams(order["share"])
        self._answer(order)

    def _do_profile(self, order: Order) -> None:
        """Start a profile of the loop's thread, or stop it and write it to ``file``."""
        import cProfile

        if order["file"]:
            self._profile.disable()
            self._profile.dump_stats(order["file"])
        else:
            self._profile = cProfile.Profile()
            self._profile.enable()
        self._answer(order)

    def _start_timing(
        self, kind: str, key: str, value: bytes, limit_s: float, done: Callable[[bool, float], None]
    ) -> None:
        is_open = True
        started_at = time.monotonic()

        def finish(result: object) -> None:
            nonlocal is_open
            if is_open:
                is_open = False
                in_time()
                done(result == value if kind == "get" else bool(result), (time.monotonic() - started_at) * 1000)

        in_time = self._node.call_later(limit_s, finish, None)
        (self._node.get if kind == "get" else self._node.put)(key, value, finish)


def main(name: str, folder: str) -> None:
    """Run a node until the orders end."""
    logging.disable(logging.CRITICAL)
    # Only orders use the real stdout; output of libraries goes to stderr.
    out = os.fdopen(os.dup(1), "w")
    os.dup2(2, 1)
    node = LIBRARIES[name].make_node(folder)
    node.run(OrderExecutor(node, out).begin)


if __name__ == "__main__":
    main(*sys.argv[1:])
