"""Simulated dogs that emulate other kinds of robot, each with the protocol of that kind.

A robot is described by the settings of its driver (``kind``, ``options``, ``parts``): the emulator listens at the
addresses to which that driver connects. For the kind "aibo", ``dialect`` is the version of Tekkotsu, "T4" or "T2".
"""

from __future__ import annotations

import random
from collections.abc import Mapping
from importlib import import_module
from importlib.util import find_spec
from typing import Any

from twisted.internet.defer import Deferred, gatherResults
from twisted.internet.error import CannotListenError

from drivers.errors import UsageError
from drivers.registry import describe, list_built_in_kinds
from sim.robots.emulator.simulated_robot import SimulatedRobot
from sim.robots.emulator.transport import EmulatorServer, ServeFunction, Table
from sim.robots.simulator import RobotSimulator
from sim.robots.world import NotPossible

DIALECTS = ("T4", "T2")
ROBOT_KEYS = ("kind", "options", "parts", "dialect")


def emulated_kinds() -> list[str]:
    """Return the kinds of robot that have an emulator: a module of the kind's name in ``sim.robots.emulator``."""
    return [kind for kind in list_built_in_kinds() if find_spec(f"sim.robots.emulator.{kind}") is not None]


class EmulatedRobots:
    """The emulated robots of ``table``, which maps names of dogs to settings of drivers.

    Raises ``UsageError`` if the simulator does not have a dog of that name, or an emulator for that kind of robot.
    """

    def __init__(self, reactor: Any, rng: random.Random, simulator: RobotSimulator, table: Mapping[str, Table]) -> None:
        self._servers: dict[str, list[EmulatorServer]] = {}
        for name, robot in table.items():
            (kind, options), *parts = _check_robot(name, robot)
            try:
                simulated_robot = simulator.reserve_for_emulator(name, describe(kind, options, name, parts).limits)
                own = random.Random(rng.getrandbits(64))
                self._servers[name] = [
                    _make_server(reactor, simulated_robot, own, kind, options, str(robot.get("dialect", "T4")))
                ]
                self._servers[name] += [_make_server(reactor, simulated_robot, own, *part) for part in parts]
            except UsageError as error:
                raise UsageError(f"[{name}] {error}") from None
        simulator.add_order("unplug", self.unplug, (str,))
        simulator.add_order("plug", self.plug, (str,))

    def start(self) -> None:
        """Start all servers; raise ``UsageError`` with the robot's name if an address is not available."""
        for name, transports in self._servers.items():
            for transport in transports:
                try:
                    transport.start()
                except FileExistsError as error:
                    raise UsageError(
                        f"[{name}] {error.filename2} already exists; end its program, or choose another port"
                    ) from None
                except (CannotListenError, OSError) as error:
                    raise UsageError(f"[{name}] the emulator cannot listen: {error}; choose another address") from None

    def stop(self) -> Deferred[Any]:
        """Stop all servers; fires when every address is free."""
        return gatherResults([transport.stop() for transport in self._all_servers])

    def unplug(self, name: str) -> None:
        """Break the links to this robot: no data passes, and no connection is closed."""
        self._set_silent(name, True)

    def plug(self, name: str) -> None:
        """Restore the links to this robot."""
        self._set_silent(name, False)

    @property
    def _all_servers(self) -> list[EmulatorServer]:
        return [transport for transports in self._servers.values() for transport in transports]

    def _set_silent(self, name: str, is_silent: bool) -> None:
        if name not in self._servers:
            raise NotPossible(f"{name!r} does not emulate a robot; the emulating dogs are {', '.join(self._servers)}")
        for transport in self._servers[name]:
            transport.faults.half_open = is_silent


def _check_robot(name: str, robot: Any) -> list[tuple[str, Table]]:
    """Return kind and options of the robot and of each of its parts; raise ``UsageError`` if ``robot`` is invalid."""
    if not isinstance(robot, Mapping) or not isinstance(robot.get("kind"), str):
        raise UsageError(f'[{name}] must have a kind, as in kind = "aibo"')
    for key in robot:
        if key not in ROBOT_KEYS:
            raise UsageError(f"[{name}] has an unknown key {key!r}; known are {', '.join(ROBOT_KEYS)}")
    parts = robot.get("parts", [])
    if not isinstance(parts, list) or not all(isinstance(one, Mapping) and "kind" in one for one in parts):
        raise UsageError(f'[{name}] parts must be tables with a kind, as in [[{name}.parts]] kind = "compass"')
    for one in (robot, *parts):
        if not isinstance(one.get("options", {}), Mapping):
            raise UsageError(f'[{name}] options must be a table, as in options = {{host = "127.0.0.1"}}')
    return [(str(one["kind"]), one.get("options", {})) for one in (robot, *parts)]


def _make_server(
    reactor: Any, simulated_robot: SimulatedRobot, rng: random.Random, kind: str, options: Table, dialect: str = "T4"
) -> EmulatorServer:
    if kind not in emulated_kinds():
        raise UsageError(f"the simulator has no robot of kind {kind!r}; it has {', '.join(emulated_kinds())}")
    if dialect not in DIALECTS:
        raise UsageError(f"dialect is {dialect!r}, but must be one of {', '.join(DIALECTS)}")
    # Import only the emulators that are used.
    serve: ServeFunction = import_module(f"sim.robots.emulator.{kind}").serve
    return serve(reactor, simulated_robot, rng, options, dialect)
