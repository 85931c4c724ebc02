"""Puppet: a program with one robot and nothing else of a node, for tests that freeze and kill it.

It is given a kind and its options (JSON); it reads ``walk SECONDS`` and says what becomes of that.
"""

from __future__ import annotations

import json
import sys
from typing import Any

from twisted.internet import reactor, stdio
from twisted.internet.defer import Deferred
from twisted.protocols.basic import LineReceiver

from drivers.base import BaseDriver
from drivers.deadman.keeper import Keeper
from drivers.driver import Permit
from drivers.registry import driver_for
from middleware.entangled.clock import use_monotonic_time

REACTOR: Any = reactor
SPEED = 0.1


class Puppet(LineReceiver):
    """What is said on the standard input, done."""

    delimiter = b"\n"

    def __init__(self, driver: BaseDriver) -> None:
        self._driver = driver

    def lineReceived(self, line: bytes) -> None:  # noqa: N802 (Twisted's)
        """Walk for so long, and say until when; or say how it stands with the switch."""
        word, *numbers = line.decode().split()
        if word == "walk":
            deadline = REACTOR.seconds() + float(numbers[0])
            self._driver.act({"base.vx": SPEED}, Permit(1, deadline))
            say("walking", deadline)
        elif word == "switch":
            say("switch", pid_of(self._driver), self._driver.diagnostics().get("halts", -1))


def pid_of(driver: BaseDriver) -> int:
    """The process of its dead man's switch; 0 for none."""
    keeper = driver._dead_man
    return keeper.pid or 0 if isinstance(keeper, Keeper) else 0


def say(*words: object) -> None:
    sys.stdout.write(" ".join(map(str, words)) + "\n")
    sys.stdout.flush()


async def run(kind: str, options: dict[str, Any]) -> None:
    driver = driver_for(kind, options, "puppet", REACTOR)
    assert isinstance(driver, BaseDriver)
    REACTOR.addSystemEventTrigger("before", "shutdown", driver.disconnect)
    await driver.connect()
    await driver.enable()
    stdio.StandardIO(Puppet(driver))
    say("ready", pid_of(driver))


if __name__ == "__main__":
    use_monotonic_time()
    REACTOR.callWhenRunning(lambda: Deferred.fromCoroutine(run(sys.argv[1], json.loads(sys.argv[2]))))
    REACTOR.run()
