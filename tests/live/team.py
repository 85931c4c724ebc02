"""A web node with three dogs that stand still: the server of the page's tests, run as a child process.

``python -m tests.live.team`` executes the commands on its input, and replies to each with a line. ``team PORT`` starts
a new team, in which vaio and pi accept each other's sessions; the reply contains the port, the join code, and an
operator's token and ticket. ``end`` closes the page of the team. The other commands change the team:

- ``gone NAME`` and ``back NAME`` let a device leave and return.
- ``status NAME STATUS`` changes the status of a device.
- ``name NAME`` changes the name of the node that serves the page.
- ``pages NODE=URL ...`` sets the web nodes, starting with this node.
- ``strange FILE`` creates devices and tasks with the texts of the JSON list in the file.
- ``session SECONDS`` sets the duration of a session.
- ``place NAME KEY=NUMBER ...`` sets the position that a device reports.
- ``outdoors`` removes the simulator.
- ``crowd COUNT`` creates devices until there are ``COUNT``, three of them with cameras.

The program ends at the end of its input.
"""

from __future__ import annotations

import json
import random
import time
from collections.abc import Iterable
from copy import deepcopy
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from twisted.internet import reactor as _reactor
from twisted.internet.defer import Deferred, maybeDeferred
from twisted.internet.stdio import StandardIO
from twisted.internet.threads import deferToThread
from twisted.protocols.basic import LineReceiver

from middleware.faults.kinds import KINDS
from swarmnode.gateway import check_picture
from tests.live.keys import GATEWAYS, key_of
from tests.webnode.memory import MemoryDiagnostics, MemoryFaults, MemoryPhones, MemoryStopControl, MemoryTeamControl
from webnode.audit import AuditLog
from webnode.auth import Token, User
from webnode.camera import OnFrame
from webnode.event_log import EventLog
from webnode.failover import Fallbacks, Page
from webnode.invite import Invites
from webnode.limits import AddressLimits
from webnode.password import hash_password, verify_password
from webnode.server import WebService
from webnode.services import Services
from webnode.session import ANONYMOUS, SignedSessions
from webnode.state import DepartedDevices, State, format_state

reactor: Any = _reactor
PASSWORD = hash_password("correct horse", bytes(16), 4)
FPS = 5
"""Frames per second of a camera: enough that the page shows motion."""
HUES = {"dog1": (70, 90, 150), "dog2": (70, 150, 90), "dog3": (150, 100, 70)}


def dog(number: int, status: str, task: str, started: float) -> dict[str, Any]:
    """Return the record of one dog."""
    return {
        "uuid": f"{number:02x}" * 16,
        "name": f"dog{number}",
        "kind": "aibo ers-7",
        "description": f"The dog with {number} yellow stripe{'s' if number > 1 else ''} on its head.",
        "capabilities": {
            "base2d": {"max_speed": 0.16, "max_turn": 2.03},
            "camera": {"width": 208, "height": 160, "fps": 30},
            "ranger": {"near": 0.5, "max": 1.5},
            "imu": {"axes": 3},
        },
        "address": f"192.168.0.{10 + number}:7000",
        "roles": ["edge"],
        "joined": number,
        "since": started - 60 * number,
        "task": task,
        "status": status,
        "messages": [[started - 30, "ready"], [started - 5, "red target seen at 0.62 m"]],
        "network": {"contacts": 3, "sent": 1204, "received": 1187, "dropped": 2},
    }


def why() -> dict[str, Any]:
    """Return two decisions: first a decision for dog3, then a decision for dog2 that dog3 has not received."""
    costs = {"dog2": 0.62, "dog1": 1.04, "dog3": 1.37}
    reports = [{"agent": f"0{name[-1]}" * 16, "name": name, "cost": cost, "more": ""} for name, cost in costs.items()]
    first = {
        "epoch": 1,
        "winner": "03" * 16,
        "chosen": "dog3",
        "agree": ["dog1", "dog3"],
        "of": 2,
        "differ": [],
        "rule": "nearest",
        "version": "1",
        "hysteresis": "no agent acted before",
        "standby": ["dog1"],
        "digest": "1a2b3c4d",
        "agreed": "",
        "token": 1,
        "reported": 2,
        "reports": [{**reports[2], "cost": 1.4}, {**reports[1], "cost": 1.6}],
        "silent": [],
    }
    second = {
        "epoch": 2,
        "winner": "02" * 16,
        "chosen": "dog2",
        "agree": ["dog1", "dog2"],
        "of": 3,
        "differ": [{"name": "dog3", "what": "names dog3; knew no report of dog2"}],
        "hysteresis": "dog2 is better by more than 10% than dog3, who acted",
        "standby": ["dog1", "dog3"],
        "token": 2,
        "reported": 3,
        "reports": reports,
    }
    return {"task": "t1", "epochs": [{**first, **second}, first]}


class Team:
    """The parts that a node normally provides to its page: the records, and generated camera frames."""

    def __init__(self) -> None:
        now = time.time()
        self.devices = [dog(1, "WAITING", "t1", now), dog(2, "EXECUTING", "t1", now), dog(3, "SEARCHING", "t1", now)]
        self.away: set[str] = set()
        self.node = "vaio"
        self.yard = deepcopy(YARD)
        self.stop_control = MemoryStopControl(*(f"{n:02x}" * 16 for n in (1, 2, 3)))
        self.batch = 0
        self.version = 0
        self._made: tuple[object, State] = (None, {})
        self._departed = DepartedDevices()
        self.tasks = [
            {
                "id": "t1",
                "kind": "search_and_approach",
                "title": "Find and touch the red target",
                "requirements": {"camera": {}, "base2d": {}},
                "created": now,
                "status": "EXECUTING",
                "note": "",
                "why": why(),
            },
            {
                "id": "t0",
                "title": "Carry the heavy box",
                "created": now - 100,
                "status": "FAILED",
                "note": "Nobody can take it.\ndog1: no gripper\ndog2: no gripper\ndog3: no gripper",
            },
        ]

    def read(self) -> State:
        """Return the state, which is updated every second and after each command."""
        now = self.version, int(time.time()), self.stop_control.is_halted()
        if self._made[0] != now:
            self._made = now, self._state()
        return self._made[1]

    def _state(self) -> State:
        here = [each for each in self.devices if each["name"] not in self.away]
        costs = {"dog1": 1.04, "dog2": 0.62, "dog3": 1.37}
        task = self.tasks[0]["id"]
        members = [
            {
                "uuid": each["uuid"],
                "name": each["name"],
                "status": each["status"],
                "state": f"WAITING({each['joined']})" if each["status"] == "WAITING" else each["status"],
                "cost": costs.get(each["name"], 1.0),
                "assigned": "02" * 16,
                "token": 1,
                "why": "the nearest of three" if each["name"] == "dog2" else "",
            }
            for each in here
            if each["task"]
        ]
        gone = self._departed.update(here, time.time())
        state = format_state(here, self.tasks, {str(task): members}, departed=gone, node=self.node)
        return {**state, "halted": self.stop_control.is_halted()}

    def be_strange(self, words: list[str]) -> None:
        """For each text in ``words``, create a device, a task and a decision with this text in every text field."""
        now = time.time()
        self.batch += 1
        self.devices, self.tasks = [], []
        for number, said in enumerate(words, 1):
            strange: dict[str, Any] = {
                "name": said,
                "kind": said,
                "description": said,
                "address": said,
                "messages": [[now, said]],
            }
            strange |= {"capabilities": {said: {said: said}}, "network": {said: 1}, "deployed": {said: said}}
            self.devices.append({**dog(number, said, said, now), **strange})
            explanation: dict[str, Any] = why()
            for epoch in explanation["epochs"]:
                epoch |= {"chosen": said, "rule": said, "hysteresis": said, "agree": [said], "standby": [said]}
                epoch["differ"] = [{"name": said, "what": said}]
                epoch["reports"] = [{"agent": said, "name": said, "cost": 1.0, "more": said}]
            task = {
                "id": f"s{self.batch}-{number}",
                "kind": said,
                "title": said,
                "created": now + number,
                "status": said,
            }
            self.tasks.append({**task, "note": said, "strategy": said, "why": explanation, "requirements": {said: {}}})
        self.yard["dogs"] = [{**YARD["dogs"][0], "name": said} for said in words[:20]]
        self._departed = DepartedDevices()

    def be_many(self, count: int) -> None:
        """Add idle dogs until there are ``count`` devices."""
        now = time.time()
        for number in range(len(self.devices) + 1, count + 1):
            more = {"name": f"unit{number}", "uuid": f"{number:032x}", "joined": number, "kind": "turtlebot"}
            able = {"base2d": {"max_speed": 0.2}, **({"gripper": {"width": 0.1}} if number % 50 == 0 else {})}
            self.devices.append({**dog(number % 250, "IDLE", "", now), **more, "capabilities": able})

    def watch(self, uuid: str, on_frame: OnFrame) -> Any:
        """Send ``FPS`` frames per second that show a floor, a wall and a rolling red ball."""
        number = int(uuid[:2], 16)
        seq = 0
        running = True

        def shoot() -> None:
            nonlocal seq
            if not running:
                return
            seq += 1
            picture = np.full((160, 208, 3), (205, 214, 220), np.uint8)
            picture[70:] = HUES[f"dog{1 + (number - 1) % 3}"]
            cv2.circle(picture, ((seq * 3 + 60 * number) % 240 - 16, 96), 8 + 6 * number, (44, 52, 212), -1)
            on_frame(seq, cv2.imencode(".jpg", picture)[1].tobytes(), 0.0)
            reactor.callLater(1 / FPS, shoot)

        def stop() -> None:
            nonlocal running
            running = False

        reactor.callLater(0, shoot)
        return stop


YARD: dict[str, Any] = {
    "walls": [3.0, 2.4],
    "dogs": [
        {"name": "dog1", "x": 0.6, "y": 0.6, "heading": 0.5, "stripes": 1},
        {"name": "dog2", "x": 1.4, "y": 1.2, "heading": 0.9, "stripes": 2},
        {"name": "dog3", "x": 2.5, "y": 0.7, "heading": 2.2, "stripes": 3},
    ],
    "target": {"x": 1.8, "y": 1.7, "radius": 0.08},
}
SETTINGS: list[list[Any]] = [
    ["description", "The dog with 1 yellow stripe on its head.", "A line about the device", "", None, 200],
    ["presence_lease", 1.0, "Time until other nodes consider a silent device lost", "s", 0.1, 60.0],
    [
        "capabilities",
        {"gripper": {"width": 0.1}},
        "Capabilities of the device in addition to its driver's",
        "",
        None,
        None,
    ],
]
CATALOGUE = [
    {"name": "search", "title": "Find and touch the red target", "requirements": {}},
    {"name": "patrol", "title": "Patrol the yard", "requirements": {}},
]


class Orders(LineReceiver):
    """Executes the test's commands on the standard input."""

    delimiter = b"\n"

    _team: Team
    _web: WebService
    _sessions: SignedSessions
    _desk: MemoryTeamControl
    _pages: list[Page]

    def lineReceived(self, line: bytes) -> None:
        """Execute one command and reply, so the test knows when the command has been executed."""
        verb, *rest = line.decode().split()
        if verb == "team":
            self._begin(int(rest[0]))
        elif verb == "end":
            maybeDeferred(self._web.stopService).addCallback(lambda _: self.sendLine(line))
        else:
            self._change(verb, rest)
            self._team.version += 1
            self.sendLine(line)

    def _begin(self, port: int) -> None:
        """Serve a new team; reply with its port and credentials."""
        self._team = team = Team()
        pages = Fallbacks()
        self._pages = pages.pages
        served = replace(make_services(team), fallbacks=pages)
        assert isinstance(served.sessions, SignedSessions) and isinstance(served.control, MemoryTeamControl)
        self._sessions, self._control = served.sessions, served.control
        self._web = WebService(reactor, "127.0.0.1", port, team.read, served, time.time, ("vaio.local",))
        pages_here = ["http://192.168.0.7:8080", "https://192.168.0.7:8443", f"http://127.0.0.1:{port}"]
        served.invites = Invites(lambda: pages_here, b"PEM", "AB:CD:" * 10, reactor, reactor.getThreadPool())
        self._web.startService()
        token = self._sessions.issue_guest_token(ANONYMOUS, "operator", "operator", time.time(), 3600.0)
        self.sendLine(f"{self._web.port} {self._sessions.code} {token.text} {token.ticket}".encode())

    def _change(self, verb: str, rest: list[str]) -> None:
        if verb == "gone":
            self._team.away.add(rest[0])
        elif verb == "back":
            self._team.away.discard(rest[0])
        elif verb == "status":
            next(each for each in self._team.devices if each["name"] == rest[0])["status"] = rest[1]
        elif verb == "name":
            self._team.node = rest[0]
            self._sessions.key = key_of(rest[0])
        elif verb == "pages":
            named = [each.split("=") for each in rest]
            uuids = [key_of(node).node_id.hex() for node, _ in named]
            self._pages[:] = [Page(uuids[place], url, is_self=place == 0) for place, (_, url) in enumerate(named)]
        elif verb == "place":
            numbers = {key: float(number) for key, _, number in (each.partition("=") for each in rest[1:])}
            next(each for each in self._team.devices if each["name"] == rest[0])["position"] = numbers
        elif verb == "crowd":
            self._team.be_many(int(rest[0]))
        elif verb == "outdoors":
            self._control.map = None
        elif verb == "session":
            self._sessions.session_s = float(rest[0])
        elif verb == "strange":
            self._team.be_strange(json.loads(Path(rest[0]).read_text(encoding="utf-8")))

    def connectionLost(self, reason: Any = None) -> None:
        """Exit when the test closes the input."""
        if reactor.running:
            reactor.stop()


def make_services(team: Team) -> Services:
    """Return the page's services: fakes in memory that accept every request."""
    control = MemoryTeamControl(CATALOGUE, team.yard)
    able = [{"uuid": f"{n:02x}" * 16, "name": f"dog{n}", "busy": "Patrol the yard" * (n == 2)} for n in (1, 2)]
    control.frames = team
    control.previews["search"] = {"able": able, "refused": {"dog3": ["no gripper", "no lift"]}, "likely": None}
    control.together["yard"] = [{"id": "t1", "title": "Find and touch the red target"}]
    gateways = {key_of(name).public for name in GATEWAYS}
    sessions = TeamSessions(key_of(team.node), gateways.__contains__, "quiet-otter", PASSWORD, random.Random(), checked)
    control.settings[able[0]["uuid"]] = SETTINGS
    diagnostics = MemoryDiagnostics(network(), {f"0{n}" * 16: inventory() for n in (1, 2)}, links(), membership())
    parts: dict[str, Any] = {"stop_control": team.stop_control, "diagnostics": diagnostics, "event_log": EventLog()}
    parts["faults"], parts["phones"] = MemoryFaults(*KINDS), MemoryPhones(check=check_picture)
    return Services(control, sessions, AuditLog(wall=time.time), limits=AddressLimits(), **parts)


class TeamSessions(SignedSessions):
    """Sessions that issue tokens for gateways only."""

    def issue_peer_tokens(self, user: User, nodes: Iterable[str], now: float) -> dict[str, Token]:
        """Return the tokens for gateways."""
        gateways = {key_of(name).node_id.hex() for name in GATEWAYS}
        return super().issue_peer_tokens(user, [node for node in nodes if node in gateways], now)


def checked(text: str, password: str) -> Deferred[Any]:
    """Check a password on a worker thread."""
    return deferToThread(verify_password, text, password)


def network() -> Any:
    """Return the view of a network in which two nodes know each other, and a third node does not reply."""
    uuids = {n: f"0{n}" * 16 for n in (1, 2, 3)}

    def view(others: tuple[int, ...], lookups: list[Any]) -> dict[str, Any]:
        contacts = [{"uuid": uuids[n], "name": f"dog{n}", "rtt_ms": 1.8 * n, "heard_s": 0.2} for n in others]
        return {
            "contacts": contacts,
            "known": len(others),
            "sent": 1204,
            "received": 1187,
            "lost": 2,
            "lookups": lookups,
        }

    lookup = {"key": "3fa2" * 10, "asked": 5, "hops": 2, "found": 8, "ms": 12.4}
    return {"devices": {uuids[1]: view((2, 3), [lookup]), uuids[2]: view((1,), [])}, "silent": [uuids[3]]}


def links() -> Any:
    """Return the links of the page's node: paths of three kinds, a revoked member and a rejected join code."""
    vaio, uuids = "0a" * 16, {n: f"0{n}" * 16 for n in (1, 2, 3)}

    def make_link(n: int, kind: str, score: int | None, rtt: float | None = None, by: str = "") -> dict[str, Any]:
        loss = None if score is None else 0.0 if score > 90 else 0.2
        link = {"uuid": uuids[n], "name": f"dog{n}", "way": kind, "by": by, "address": "192.0.2.1:8484"}
        return link | {
            "for_s": None if kind == "none" else 150.0,
            "score": score,
            "loss": loss,
            "rtt_ms": rtt,
            "jitter_ms": rtt and rtt / 10,
        }

    def refusal(side: str, node: str, code: str, why: str, remedy: str, times: int = 1) -> dict[str, Any]:
        row = {"who": node, "at": "192.0.2.66:8484", "side": side, "code": code, "why": why, "remedy": remedy}
        return row | {"ago_s": 200.0, "count": times}

    out = refusal(
        "we", "dog9", "revoked", "the operator revoked the certificate", "only a new invitation lets it in", 3
    )
    own = [make_link(1, "lan", 98, 1.8), make_link(2, "punched", 63, 42.0), make_link(3, "carried", 24, 110.0, "dog1")]
    code = refusal("code", "", "used", "this code was used as often as it may be", "ask the operator for another one")
    devices = {
        vaio: {"links": own, "refusals": [out, code]},
        uuids[1]: {"links": [make_link(2, "tunnel", 88, 12.0)], "refusals": [out]},
        uuids[2]: {"links": [make_link(1, "tunnel", 70, 14.0), make_link(3, "none", None)], "refusals": []},
    }
    return {"here": vaio, "devices": devices, "silent": [uuids[3]]}


def membership() -> Any:
    """Return a closed team; the certificate of one member expires soon."""
    now = time.time()
    members = [
        {
            "uuid": f"0{n}" * 16,
            "name": f"dog{n}",
            "roles": ["device"] + ["bootstrap"] * (n == 1),
            "until": int(now + days * 86_400 + 3600),
            "is_renewable": days > 14,
            "is_ending": days < 14,
        }
        for n, days in ((2, 9), (1, 365), (7, 365))
    ]
    team = {"kind": "closed", "name": "yard", "fingerprint": "1a2b3c4d5e6f7081", "me": "0a" * 16}
    return team | {"until": int(now + 4e7), "is_renewable": True, "is_ending": False, "known": 3, "members": members}


def inventory() -> Any:
    """Return an inventory of a few records."""
    newest = [["devices", "dog1", 540, "leased"], ["tasks", "t1", 310, "team"]]
    return {
        "records": 9,
        "deleted": 1,
        "bytes": 4120,
        "most_bytes": 2**23,
        "kinds": {"devices": 4, "tasks": 2},
        "newest": newest,
    }


def main() -> None:
    """Serve until the input ends."""
    reactor.callWhenRunning(lambda: StandardIO(Orders()))
    reactor.run()


if __name__ == "__main__":
    main()
