"""One failure with real processes, each node in a separate network namespace (``lan``)."""

from __future__ import annotations

import http.client
import json
import os
import random
import signal
import sqlite3
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

from twisted.internet.defer import Deferred
from twisted.internet.task import deferLater

from benchmarks.takeover.cause import PHASE_S, POLL_S, WEB, WITNESSES, Cause, TakeoverObserver, Trial
from benchmarks.takeover.lan import PORT, Lan
from drivers.link import TcpConnector
from drivers.sim.client import SimulatorClient
from middleware.entangled.data.sqlite import read_records
from middleware.entangled.errors import EntangledError
from middleware.tasks.task import TASKS, find_outcome, group_key, parse_tasks
from sim.demo.configuration import BOOTSTRAP, DOGS, encode_toml
from sim.demo.processes import make_child_command

YARD_PORT, WEB_PORT = 7400, 8080
START_S, LIMIT_S = 60.0, 30.0
CODE, SESSION = "take-over", "/api/v1/session"
RATE_HZ = 31.0


class TrialTimeout(Exception):
    """An event did not happen in time; the message names it."""


class Team:
    """The processes of one trial: a simulator on the router, and the nodes; ``reactor`` is the clock."""

    def __init__(self, reactor: Any, others: tuple[str, ...], folder: Path, seed: int) -> None:
        self.web = WEB if WEB in others else BOOTSTRAP
        self._reactor = reactor
        self._folder = folder
        self._names = (BOOTSTRAP, *others, *DOGS)
        self._lan = Lan(self._names)
        self._processes: dict[str, subprocess.Popen[bytes]] = {}
        self._token = ""
        key = random.Random(seed).randbytes(32).hex()
        yard = make_child_command(
            ["-m", "sim.robots.server", "--host", "0.0.0.0", "--port", str(YARD_PORT), "--seed", str(seed)]
        )
        self._start("yard", yard)
        twistd = str(Path(sys.executable).parent / "twistd")
        for name in self._names:
            file = folder / f"{name}.toml"
            file.write_text(self._make_configuration(name, key), encoding="utf-8")
            node = make_child_command([twistd, "-n", "--pidfile=", "swarm-node", "--config", str(file)])
            self._start(name, self._lan.command(name, node))
        self.operator = SimulatorClient(TcpConnector(reactor), reactor, "127.0.0.1", YARD_PORT, rate=RATE_HZ)
        self.operator.connect().addErrback(lambda _: None)

    def request_page(self, path: str, body: object = None) -> Any:
        """Send a request to the page, or (with a ``body``) an order."""
        if not self._token and path != SESSION:
            self._token = self.request_page(SESSION, {"code": CODE})["token"]
        connection = http.client.HTTPConnection(self._lan.get_address(self.web), WEB_PORT, timeout=2.0)
        try:
            headers = {"Authorization": f"Bearer {self._token}", "Content-Type": "application/json"}
            if body is None:
                connection.request("GET", path, headers=headers)
            else:
                connection.request("POST", path, json.dumps(body), headers)
            return json.loads(connection.getresponse().read())
        finally:
            connection.close()

    def is_complete(self) -> bool:
        """Return whether the page lists the robots."""
        try:
            here = {device["name"] for device in self.request_page("/api/v1/state")["devices"]}
        except (OSError, http.client.HTTPException, ValueError):
            return False
        return here >= set(self._names) and self.operator.snapshot is not None

    def list_moving(self) -> list[str]:
        """Return the moving robots."""
        snapshot = self.operator.snapshot or {"dogs": ()}
        return [dog["name"] for dog in snapshot["dogs"] if dog["moving"]]

    def find_outcome(self, task_id: str, lost: str) -> Any:
        """Return the result of the task from the store of a remaining robot; None while the task is open."""
        for name in DOGS:
            if name != lost:
                try:
                    file = self._folder / f"{name}.sqlite"
                    task = parse_tasks(read_records(file, TASKS)).get(task_id)
                    outcome = None if task is None else find_outcome(task, read_records(file, group_key(task_id)))
                except (EntangledError, sqlite3.Error):
                    continue
                if outcome is not None:
                    return outcome
        return None

    def inject_fault(self, cause: Cause, name: str) -> None:
        """Inject the fault into the robot ``name``."""
        match cause:
            case Cause.CRASH:
                self._processes[name].kill()
            case Cause.FREEZE:
                os.kill(self._processes[name].pid, signal.SIGSTOP)
            case Cause.LOST_RADIO:
                self._lan.silence(name)
            case Cause.ONE_WAY_RADIO:
                self._lan.silence(name, one_way=True)
            case Cause.LOST_LINK:
                raise ValueError(f"{cause.value} is available in virtual time only")
            case Cause.POLITE_LEAVE:
                self._processes[name].terminate()
            case Cause.TRIPLE_KILL:
                for each in (name, BOOTSTRAP, WEB):
                    self._processes[each].kill()

    def thaw(self, name: str) -> None:
        """Continue a frozen node."""
        os.kill(self._processes[name].pid, signal.SIGCONT)

    def stop(self) -> None:
        """Stop all processes of this team."""
        self.operator.disconnect()
        for process in self._processes.values():
            process.kill()
            process.wait()
        self._lan.close()

    def _start(self, name: str, command: list[str]) -> None:
        log = (self._folder / f"{name}.log").open("ab")
        self._processes[name] = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=log, stderr=log)
        log.close()

    def _make_configuration(self, name: str, key: str) -> str:
        node: dict[str, object] = {
            "name": name,
            "host": self._lan.get_address(name),
            "port": PORT,
            "known_nodes": [] if name == BOOTSTRAP else [f"{self._lan.get_address(BOOTSTRAP)}:{PORT}"],
            "store": str(self._folder / f"{name}.sqlite"),
            "team_key": key,
        }
        tables: dict[str, Any] = {"node": node}
        if name == self.web:
            node["roles"] = ["edge", "web"]
            tables["web"] = {"host": self._lan.get_address(name), "port": WEB_PORT, "code": CODE}
        if name in DOGS:
            options = {"host": self._lan.get_router_address(name), "port": YARD_PORT, "robot": name, "camera_fps": 0.1}
            tables["agent"] = {"module": "search"}
            tables["driver"] = {"kind": "sim", "options": options}
        return encode_toml(tables)


async def run_trial(reactor: Any, cause: Cause, seed: int) -> Trial:
    """Inject a fault into the acting robot of a team of real processes, and observe the other robots."""
    rng = random.Random(f"takeover/real/{cause.value}/{seed}")
    with tempfile.TemporaryDirectory(prefix="takeover-") as folder:
        team = Team(reactor, (WEB, *WITNESSES) if cause is Cause.TRIPLE_KILL else (), Path(folder), seed)
        try:
            return await _run_trial(reactor, cause, seed, team, rng)
        finally:
            team.stop()


async def _run_trial(reactor: Any, cause: Cause, seed: int, team: Team, rng: random.Random) -> Trial:
    await _wait_until(reactor, team.is_complete, "the page does not list all devices", 0.2)
    task_id = str(
        team.request_page(
            "/api/v1/tasks", {"name": "turn-around", "tolerates": 3 if cause is Cause.TRIPLE_KILL else 1}
        )["id"]
    )
    await _wait_until(reactor, lambda: bool(team.list_moving()), "no dog goes", POLL_S)
    lost = team.list_moving()[0]
    await deferLater(reactor, rng.uniform(*PHASE_S))
    started_at = time.monotonic()
    team.inject_fault(cause, lost)
    observer = TakeoverObserver(cause, seed, lost, started_at, rng, LIMIT_S)
    while not observer.is_over(time.monotonic()):
        await deferLater(reactor, POLL_S)
        now = time.monotonic()
        if observer.take_thaw(now):
            team.thaw(lost)
        is_sought = observer.takeover is not None and observer.result is None  # the files are read from disk
        observer.record(now, team.list_moving(), team.find_outcome(task_id, lost) if is_sought else None)
    return observer.make_trial()


async def _wait_until(reactor: Any, holds: Any, problem: str, pause: float) -> None:
    end = time.monotonic() + START_S
    while not holds():
        if time.monotonic() > end:
            raise TrialTimeout(f"{problem} after {START_S:g} s")
        pausing: Deferred[None] = deferLater(reactor, pause)
        await pausing
