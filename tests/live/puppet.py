"""A program that contains only a robot's driver, for tests that freeze and kill the program.

The arguments are a driver's kind and options (JSON). The program executes commands from its input and prints the
results.
"""

from __future__ import annotations

import json
import sys
from typing import Any

from twisted.internet import reactor, stdio
from twisted.internet.defer import Deferred
from twisted.protocols.basic import LineReceiver

from drivers.base import BaseDriver
from drivers.deadman.supervisor import Supervisor
from drivers.driver import Permit
from drivers.registry import create_driver
from middleware.entangled.clock import use_monotonic_time

REACTOR: Any = reactor
SPEED = 0.1


class Puppet(LineReceiver):
    """Executes the commands on the standard input."""

    delimiter = b"\n"

    def __init__(self, driver: BaseDriver) -> None:
        self._driver = driver

    def lineReceived(self, line: bytes) -> None:  # noqa: N802 (Twisted's)
        """Walk for some seconds and print the deadline, or print the state of the dead man's switch."""
        word, *numbers = line.decode().split()
        if word == "walk":
            deadline = REACTOR.seconds() + float(numbers[0])
            self._driver.act({"base.vx": SPEED}, Permit(1, deadline))
            say("walking", deadline)
        elif word == "switch":
            say("switch", pid_of(self._driver), self._driver.diagnostics().get("halts", -1))


def pid_of(driver: BaseDriver) -> int:
    """Return the process id of the dead man's switch, or 0 if there is no switch."""
    keeper = driver._dead_man
    return keeper.pid or 0 if isinstance(keeper, Supervisor) else 0


def say(*words: object) -> None:
    sys.stdout.write(" ".join(map(str, words)) + "\n")
    sys.stdout.flush()


async def run(kind: str, options: dict[str, Any]) -> None:
    driver = create_driver(kind, options, "puppet", REACTOR)
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
