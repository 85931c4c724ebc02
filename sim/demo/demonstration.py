"""The demonstration: three dogs, two web nodes and a robot simulator as six processes of this machine.

``python -m sim.demo`` runs the team until Ctrl-C.  With ``--headless`` it runs both experiments of the thesis, checks
them against the true positions of the dogs, and exits with 0 or 1.  The nodes make all decisions; this module starts
the nodes, observes them, places the target, and kills a node in experiment 2.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import time
from collections.abc import Awaitable, Callable, Sequence
from pathlib import Path
from typing import Any

from twisted.internet.base import ReactorBase
from twisted.internet.defer import Deferred
from twisted.internet.task import deferLater, react

from drivers.link import TcpConnector
from drivers.sim.client import SimulatorClient
from sim.demo.configuration import DOGS, JUDGE, SIMULATOR, Plan
from sim.demo.experiment import Experiment, format_table, make_report
from sim.demo.free_ports import PortBusy
from sim.demo.page_client import PageClient, PageError
from sim.demo.preparation import WEB_PORT, DemoError, has_tls, lock_run_dir, make_plan, print_line
from sim.demo.processes import RESTART_S, ProcessGroup
from sim.demo.robots import LOOPBACK, ROBOT_SETS
from sim.demo.state_changes import describe_changes, find_present

START_LIMIT_S = 40.0
SEARCH_S = 3.0
"""Seconds for which the dogs search before the target is placed."""
POLL_S = 0.05


class Demonstration:
    """The processes, a client of the page, and a connection to the simulator for the true positions."""

    def __init__(
        self, reactor: Any, plan: Plan, seed: int, say: Callable[[str], None], loses_link: bool = False
    ) -> None:
        self._reactor = reactor
        self._loses_link = loses_link
        self._plan = plan
        self._seed = seed
        self._say = say
        self._started_at = reactor.seconds()
        self._ended: set[str] = set()
        self._processes = ProcessGroup(reactor, plan.run_dir)
        here = plan.get_location(JUDGE)
        self._operator = SimulatorClient(TcpConnector(reactor), reactor, here.yard, plan.simulator_port, rate=20.0)
        host = here.entry if plan.web_host == "0.0.0.0" else plan.web_host
        self._page = PageClient(reactor, host, plan.web_port, self._on_state, plan.code)
        self.address = f"http://{host}:{plan.web_port}/#code={plan.code}"
        tls = plan.tls_ports[0]
        self.secure_address = f"https://{host}:{tls}/#code={plan.code}" if tls else ""
        """The address over TLS; empty without TLS."""

    async def start(self) -> None:
        """Start everything and wait until the page lists the three dogs."""
        # Create the team while the simulator starts.
        founding = [sys.executable, "-m", "swarmnode.team.init", *self._plan.make_init_arguments()]
        founder = subprocess.Popen(founding, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True)
        arguments = [
            "--host",
            self._plan.get_location(SIMULATOR).host,
            "--port",
            str(self._plan.simulator_port),
            "--seed",
            str(self._seed),
        ]
        if self._plan.emulated_robots:
            path = self._plan.run_dir / "robots.toml"
            path.write_text(self._plan.emulated_robots, encoding="utf-8")
            arguments += ["--robots", str(path)]
        self._processes.add(
            SIMULATOR, ["-m", "sim.robots.server", *arguments], self._plan.get_location(SIMULATOR).enter
        )
        self._processes.start()
        _, trouble = founder.communicate()
        if founder.returncode != 0:
            raise DemoError(f"cannot create the team: {trouble.strip()}")
        for name, text in self._plan.make_configs().items():
            path = self._plan.get_config_path(name)
            path.touch(mode=0o600)
            path.write_text(text, encoding="utf-8")
        twistd = str(Path(sys.executable).parent / "twistd")
        for name in self._plan.nodes:
            node = [twistd, "-n", "--pidfile=", "swarm-node", "--config", str(self._plan.get_config_path(name))]
            self._processes.add(name, node, self._plan.get_location(name).enter)
        self._operator.connect().addErrback(lambda _: None)
        self._page.follow()
        await self._wait_until(self._is_complete, START_LIMIT_S, "the page does not list all three dogs")

    def stop(self) -> Deferred[None]:
        """End all processes; fires when they have ended."""
        self._page.stop()
        self._operator.disconnect()
        return self._processes.stop()

    async def run_experiment(self, number: int) -> Experiment:
        """Run experiment 1 or 2 of the thesis to its end."""
        await self._wait_until(self._is_complete, START_LIMIT_S, "a dog is missing before the experiment")
        await self._operator.clear_target()
        await self._operator.scatter(self._seed + number)
        title = f"Experiment {number}: " + ("the nearest dog approaches", "the dog on its way is lost")[number - 1]
        self._say(title)
        answer = await self._page.post("/api/v1/demo")
        run = Experiment(title, str(answer.get("id", "")), number == 2, self._reactor.seconds())
        target_at = self._reactor.seconds() + SEARCH_S
        while not run.is_over:
            await self._pause(POLL_S)
            now = self._reactor.seconds()
            snapshot = self._operator.snapshot
            if target_at <= now and snapshot is not None:
                target_at = float("inf")
                # The web node may place the target itself; if so, it has done this by now.
                if snapshot["target"] is None:
                    await self._operator.place_target_at_random()
                    self._report("the red target is placed")
            still = run.takeover_s is None
            victim = run.update(now, self._page.state, snapshot)
            if still and run.takeover_s is not None:
                loss = "loss of the link" if self._loses_link else "kill"
                self._report(f"{run.takeover_s:.2f} s from the {loss} to the next dog moving")
            if victim:
                await self._inject_failure(victim)
            self._check_processes()
        if run.killed and self._loses_link:
            await self._operator.restore_robot_link(run.killed)
        return run

    async def _inject_failure(self, victim: str) -> None:
        """Make the approaching dog fail: kill its node, or break the link between its node and the robot."""
        if self._loses_link:
            self._report(f"{victim} has come nearer; the link between its node and the robot is lost")
            await self._operator.break_robot_link(victim)
        else:
            self._report(
                f"{victim} has come nearer; its node is killed (SIGKILL, process {self._processes.get_pid(victim)})"
            )
            self._ended.add(victim)
            self._processes.kill(victim)

    def watch_processes(self) -> None:
        """Report each process that ends; ``ProcessGroup`` restarts it."""
        missing = set(self._processes.list_ended())
        for name in sorted(missing - self._ended):
            log = self._plan.run_dir / f"{name}.log"
            self._report(f"the process of {name} ended; it starts again in {RESTART_S:g} s (see {log})")
        self._ended = missing
        self._reactor.callLater(1.0, self.watch_processes)

    def _is_complete(self) -> bool:
        return set(DOGS) <= set(find_present(self._page.state)) and self._operator.snapshot is not None

    def _on_state(self, before: dict[str, Any], after: dict[str, Any]) -> None:
        for line in describe_changes(before, after):
            self._report(line)

    def _report(self, line: str) -> None:
        self._say(f"{self._reactor.seconds() - self._started_at:7.2f} s  {line}")

    async def _wait_until(self, holds: Callable[[], bool], limit_s: float, problem: str) -> None:
        end = self._reactor.seconds() + limit_s
        while not holds():
            self._check_processes()
            if self._reactor.seconds() > end:
                raise DemoError(f"{problem} after {limit_s:g} s; see the logs in {self._plan.run_dir}/")
            await self._pause(POLL_S)

    async def _pause(self, seconds: float) -> None:
        await deferLater(self._reactor, seconds)

    def _check_processes(self) -> None:
        for name in self._processes.list_ended():
            if name not in self._ended:
                tail = "\n  ".join(self._processes.get_tail(name))
                raise DemoError(f"the process of {name} ended; its last lines:\n  {tail}")


async def run_experiments(
    demonstration: Demonstration, begun: Callable[[], Awaitable[None]], path: Path | None, say: Callable[[str], None]
) -> None:
    """Run both experiments after ``start`` and ``begun``, then end everything.

    The verdict is printed, and written to ``path`` as JSON; raises ``SystemExit`` with 1 if an experiment failed.
    """
    try:
        await demonstration.start()
        await begun()
        runs = [await demonstration.run_experiment(number) for number in (1, 2)]
    finally:
        await demonstration.stop()
    say(format_table(runs))
    if path is not None:
        path.write_text(json.dumps(make_report(runs), indent=1) + "\n", encoding="utf-8")
    if not all(run.has_passed for run in runs):
        raise SystemExit(1)


def make_parser(prog: str, description: str) -> argparse.ArgumentParser:
    """Return a parser with the common options of demonstrations on one machine and across several."""
    parser = argparse.ArgumentParser(prog=prog, description=description)
    parser.add_argument(
        "--robot",
        choices=sorted(ROBOT_SETS),
        default="aibo",
        help="kind of the three robots; mixed: an AIBO, a Create 2 and a Bittle (default %(default)s)",
    )
    parser.add_argument(
        "--lose",
        choices=("node", "link"),
        default="node",
        help="what fails in experiment 2: the approaching dog's node, or its link to the robot (default %(default)s)",
    )
    parser.add_argument("--seed", type=int, default=1, help="seed of the simulator (default 1)")
    parser.add_argument("--run-dir", type=Path, default=Path("run"), help="folder for logs, stores and configurations")
    parser.add_argument("--report", type=Path, help="write the verdict of both experiments to this file as JSON")
    return parser


def _parse_arguments(arguments: Sequence[str]) -> argparse.Namespace:
    parser = make_parser(
        "swarm demo",
        "Run three robots, a red target and the page on this machine, until Ctrl-C.  Example: swarm demo --robot sim",
    )
    parser.add_argument(
        "--headless",
        action="store_true",
        help="run both experiments, check them, and exit with 0 (passed) or 1 (failed)",
    )
    parser.add_argument("--web-host", default=LOOPBACK, help="address of the page; 0.0.0.0 opens it to the network")
    parser.add_argument(
        "--web-port",
        type=_parse_port,
        default=None,
        help=f"port of the page (default {WEB_PORT}, or a free one; 0: only free ports, for several demonstrations)",
    )
    parser.add_argument("--tls", action="store_true", help="also serve the page over TLS, on this machine only")
    args = parser.parse_args(arguments)
    if args.lose == "link" and args.robot == "sim":
        parser.error("--lose link: a simulated dog has no link; choose another --robot")
    if args.report is not None and not args.report.absolute().parent.is_dir():
        parser.error(f"--report {args.report}: no such folder; create it, or choose another file")
    return args


def _parse_port(word: str) -> int:
    """Parse a port number of the command line; 0 is any port."""
    if not (word.isdecimal() and len(word) <= 5 and int(word) <= 65535):
        raise argparse.ArgumentTypeError(f"must be 0 to 65535, is {word!r}")
    return int(word)


async def _run(reactor: Any, args: argparse.Namespace) -> None:
    try:
        with lock_run_dir(args.run_dir.absolute()):
            folder = args.run_dir.absolute()
            # Browsers trust plain http to this machine, so a page for this machine only needs no TLS.
            with_tls = args.tls or (has_tls() and not args.headless and args.web_host != LOOPBACK)
            if args.tls and not has_tls():
                raise DemoError("--tls needs libraries that are not installed; run: pip install 'swarm-node[tls]'")
            is_usual = not args.headless and args.web_port != 0
            plan = make_plan(folder, args.web_host, args.web_port, is_usual, print_line, with_tls, args.robot)
            demonstration = Demonstration(reactor, plan, args.seed, print_line, args.lose == "link")
            reactor.addSystemEventTrigger("before", "shutdown", demonstration.stop)

            async def begun() -> None:
                _print_addresses(demonstration, plan)
                if not args.headless:
                    demonstration.watch_processes()
                    await Deferred()

            await run_experiments(demonstration, begun, args.report, print_line)
    except (DemoError, PageError, PortBusy, OSError) as problem:
        sys.stderr.write(f"swarm demo: {problem}\n")
        raise SystemExit(2 if isinstance(problem, PortBusy) else 1) from None


def _print_addresses(demonstration: Demonstration, plan: Plan) -> None:
    print_line(f"The page: {demonstration.address}   (logs: {plan.run_dir}; end with Ctrl-C)")
    if demonstration.secure_address:
        print_line(
            f"Over TLS: {demonstration.secure_address}"
            "   (a browser warns until it trusts the team: docs/how-to/https.md)"
        )
    print_line("If its node fails, the page switches to another: end the process of vaio to see it.")
    if plan.web_host == LOOPBACK:
        print_line(
            "To open it on phones and tablets in the same network, then also over TLS: make demo WEB_HOST=0.0.0.0"
        )
    else:
        here, tls = os.uname().nodename, plan.tls_ports[0]
        also = f", https://{here}.local:{tls} (required for the camera of a phone)" if tls else ""
        print_line(f"In the same network: http://{here}.local:{plan.web_port}{also}, or this machine's address;")
        print_line(f"sign-in code: {plan.code}.  For phones the page shows a QR code: Invite")
        if not tls:
            print_line("The camera of a phone requires https, which is not installed: pip install 'swarm-node[tls]'")


def main(arguments: Sequence[str] = tuple(sys.argv[1:])) -> None:
    """Run the demonstration according to the command line."""
    args = _parse_arguments(arguments)
    # Twisted's timers use the wall clock; a step of that clock would delay or fire all of them.
    ReactorBase.seconds = staticmethod(time.monotonic)
    react(lambda reactor: Deferred.fromCoroutine(_run(reactor, args)))
