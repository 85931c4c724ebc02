"""The demonstration across an emulated internet: ``make demo NAT=1``, or ``python -m sim.namespaces.demo``.

The computers of two dogs are each behind a NAT router; one of these routers is symmetric. The computer of the third
dog is on the LAN of the bootstrap and web node, whose router forwards two ports. The browser is behind a fourth
router. Each robot is connected to its computer by a separate link to the robot simulator. Both experiments of the
thesis run as in the demonstration on one machine.
"""

from __future__ import annotations

import argparse
import json
import signal
import subprocess
import sys
import time
from collections.abc import Sequence
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

from sim.demo.configuration import BOOTSTRAP, DOGS, JUDGE, RESERVE, SIMULATOR, Location, Plan
from sim.demo.demonstration import Demonstration, make_parser, run_experiments
from sim.demo.page_client import PageError
from sim.demo.preparation import DemoError, lock_run_dir, print_line
from sim.demo.robots import LOOPBACK, MAX_PORTS, Robot, make_robots
from sim.namespaces.internet import Internet, Site
from sim.namespaces.namespace import find_unavailable_reason
from sim.namespaces.nat import NatKind

NODE_PORT, WEB_PORT, YARD_PORT, ROBOT_PORT = 7000, 8080, 7400, 7500
HOME, KINDS = "home", (NatKind.PORT, NatKind.SYM)
HOSTS = {BOOTSTRAP: "home1", RESERVE: "home2", DOGS[2]: "home3", DOGS[0]: "far1", DOGS[1]: "farther1", JUDGE: "cafe1"}
"""The host of each process, by the name of the process."""
SITES = (
    Site(HOME, NatKind.PORT, 3),
    Site("far", KINDS[0]),
    Site("farther", KINDS[1]),
    Site("cafe", NatKind.PORT),
)


def connect_robots(net: Internet) -> dict[str, Location]:
    """Connect the robots to their computers and forward ports of the home's router; return each process's location."""
    net.add_isolated_host(SIMULATOR)
    cables = {name: net.connect_cable(host, SIMULATOR)[1] for name, host in HOSTS.items()}
    inside = net.address(HOSTS[BOOTSTRAP])
    net.forward_ports(HOME, HOSTS[BOOTSTRAP], ("udp", NODE_PORT), ("tcp", WEB_PORT))
    places = {SIMULATOR: Location(host="0.0.0.0", enter=net.get_namespace(SIMULATOR).inner_entry_command)}
    for name, host in HOSTS.items():
        entry = inside if host.startswith(HOME) else net.get_external_address(HOME)
        places[name] = Location(net.address(host), entry, cables[name], net.get_namespace(host).inner_entry_command)
    return places


def make_namespace_plan(run_dir: Path, robot: str, places: dict[str, Location], code: str) -> Plan:
    """Return the plan of the demonstration at ``places``."""
    ports = iter(range(ROBOT_PORT, ROBOT_PORT + MAX_PORTS * len(DOGS)))
    robots = {
        name: _with_cable_address(each, places[name].yard)
        for name, each in make_robots(robot, DOGS, run_dir, ports, YARD_PORT).items()
    }
    nodes = dict.fromkeys((BOOTSTRAP, RESERVE, *DOGS), NODE_PORT)
    return Plan(run_dir, "0.0.0.0", WEB_PORT, YARD_PORT, nodes, code, WEB_PORT, robots=robots, locations=places)


def _with_cable_address(robot: Robot, simulator_host: str) -> Robot:
    """Return ``robot`` with the address of the simulator's end of the robot's cable."""
    there = json.loads(json.dumps({"options": robot.options, "parts": robot.parts}).replace(LOOPBACK, simulator_host))
    return replace(robot, options=there["options"], parts=tuple(there["parts"]))


def run_inside(args: argparse.Namespace) -> None:
    """Run and check both experiments; called on the host of the browser."""
    from twisted.internet.base import ReactorBase
    from twisted.internet.defer import Deferred
    from twisted.internet.task import react

    ReactorBase.seconds = staticmethod(time.monotonic)
    folder = args.run_dir.absolute()

    async def run(reactor: Any) -> None:
        try:
            with lock_run_dir(folder):
                given_places = json.loads(sys.stdin.readline())
                places = {
                    name: Location(**{**each, "enter": tuple(each["enter"])}) for name, each in given_places.items()
                }
                plan = make_namespace_plan(folder, args.robot, places, "over-there")
                demonstration = Demonstration(reactor, plan, args.seed, print_line, args.lose == "link")
                reactor.addSystemEventTrigger("before", "shutdown", demonstration.stop)

                async def begun() -> None:
                    print_line(
                        f"{time.monotonic() - started_at:7.2f} s  the page lists all dogs: {demonstration.address}"
                    )

                await run_experiments(demonstration, begun, args.report, print_line)
        except (DemoError, PageError, OSError) as problem:
            sys.stderr.write(f"demo across namespaces: {problem}\n")
            raise SystemExit(1) from None

    started_at = time.monotonic()
    react(lambda reactor: Deferred.fromCoroutine(run(reactor)))


def main(arguments: Sequence[str] = tuple(sys.argv[1:])) -> int:
    """Run the command line; returns 0 if both experiments passed, 2 if namespaces are not available."""
    parser = make_parser("python -m sim.namespaces.demo", "Run both experiments behind NAT routers.")
    parser.add_argument("--loss", type=float, default=0.0, help="percent of datagrams lost on every link (%(default)s)")
    parser.add_argument("--record", type=Path, default=None, help="write every frame of the wide area to this file")
    for ignored in ("--web-host", "--web-port"):
        parser.add_argument(ignored, help=argparse.SUPPRESS)
    for ignored in ("--headless", "--tls"):
        parser.add_argument(ignored, action="store_true", help=argparse.SUPPRESS)
    parser.add_argument("--inside", action="store_true", help=argparse.SUPPRESS)
    args = parser.parse_args(list(arguments))
    if args.inside:
        run_inside(args)
    why = find_unavailable_reason()
    if why:
        sys.stderr.write(f"!!!\n!!! NO DEMONSTRATION ACROSS NAMESPACES HERE: {why}\n!!!\n")
        return 2
    # The namespaces are removed at the end of the ``with`` block, so signals must end the block.
    for number in (signal.SIGTERM, signal.SIGINT):
        signal.signal(number, lambda *_: sys.exit(130))
    with Internet(SITES, args.seed) as net:
        places = connect_robots(net)
        for site in net.sites:
            net.impair(site, loss=args.loss)
        net.record_frames(args.record)
        print_line(
            f"dog1 behind a router ({KINDS[0].description}), dog2 behind another ({KINDS[1].description}), dog3 at home"
        )
        command = [sys.executable, "-m", "sim.namespaces.demo", "--inside", *arguments]
        process = net.start(HOSTS[JUDGE], command, stdin=subprocess.PIPE, cwd=Path.cwd(), text=True)
        assert process.stdin is not None
        process.stdin.write(json.dumps({name: asdict(place) for name, place in places.items()}) + "\n")
        process.stdin.flush()
        return int(process.wait())


if __name__ == "__main__":
    sys.exit(main())
