"""A web node with three dogs that stand still: the server of the page's tests, run as a child process.

``python -m tests.live.team`` prints the port in its first line.  Lines on its input change the team: ``gone NAME``,
``back NAME``, ``status NAME STATUS``, ``freeze SECONDS`` (the whole process stands); it ends when its input does.
"""

from __future__ import annotations

import sys
import time
from typing import Any

import cv2
import numpy as np
from twisted.internet import reactor as _reactor
from twisted.internet.stdio import StandardIO
from twisted.protocols.basic import LineReceiver

from middleware.fault import KINDS
from webnode.board import Board, MemoryFaults, OpenSessions
from webnode.camera import OnFrame
from webnode.desk import MemoryDesk
from webnode.server import WebService, web_service
from webnode.state import Departed, State, state_of

reactor: Any = _reactor
HUES = {"dog1": (70, 90, 150), "dog2": (70, 150, 90), "dog3": (150, 100, 70)}


def dog(number: int, status: str, task: str, started: float) -> dict[str, Any]:
    """The record of one dog."""
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
    """Two decisions: dog3's was overtaken when dog2 came near, and dog3 knew nothing of it."""
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
        "hysteresis": "nobody acted before",
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
    """What the front door would hand in: the records, and pictures from nowhere."""

    def __init__(self) -> None:
        now = time.time()
        self.devices = [dog(1, "WAITING", "t1", now), dog(2, "EXECUTING", "t1", now), dog(3, "SEARCHING", "t1", now)]
        self.away: set[str] = set()
        self._departed = Departed()
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
        """The state as it is now."""
        here = [each for each in self.devices if each["name"] not in self.away]
        costs = {"dog1": 1.04, "dog2": 0.62, "dog3": 1.37}
        members = [
            {
                "uuid": each["uuid"],
                "name": each["name"],
                "status": each["status"],
                "cost": costs[each["name"]],
                "assigned": "02" * 16,
                "token": 1,
                "why": "the nearest of three" if each["name"] == "dog2" else "",
            }
            for each in here
        ]
        gone = self._departed.of(here, time.time())
        return state_of(here, self.tasks, {"t1": members}, departed=gone, node="vaio")

    def watch(self, uuid: str, on_frame: OnFrame) -> Any:
        """Pictures of a floor, a wall and a red ball that rolls, 15 a second."""
        number = int(uuid[:2], 16)
        seq = 0
        running = True

        def shoot() -> None:
            nonlocal seq
            if not running:
                return
            seq += 1
            picture = np.full((160, 208, 3), (205, 214, 220), np.uint8)
            picture[70:] = HUES[f"dog{number}"]
            cv2.circle(picture, ((seq * 3 + 60 * number) % 240 - 16, 96), 8 + 6 * number, (44, 52, 212), -1)
            on_frame(seq, cv2.imencode(".jpg", picture)[1].tobytes())
            reactor.callLater(1 / 15, shoot)

        def stop() -> None:
            nonlocal running
            running = False

        reactor.callLater(0, shoot)
        return stop


YARD = {
    "walls": [3.0, 2.4],
    "dogs": [
        {"name": "dog1", "x": 0.6, "y": 0.6, "heading": 0.5, "stripes": 1},
        {"name": "dog2", "x": 1.4, "y": 1.2, "heading": 0.9, "stripes": 2},
        {"name": "dog3", "x": 2.5, "y": 0.7, "heading": 2.2, "stripes": 3},
    ],
    "target": {"x": 1.8, "y": 1.7, "radius": 0.08},
}
CATALOGUE = [
    {"name": "search", "title": "Find and touch the red target", "requirements": {}},
    {"name": "patrol", "title": "Patrol the yard", "requirements": {}},
]


class Orders(LineReceiver):
    """What the test writes on the child's input."""

    delimiter = b"\n"

    def __init__(self, team: Team, web: WebService) -> None:
        self._team = team
        self._web = web

    def connectionMade(self) -> None:
        """Say the port."""
        self.sendLine(str(self._web.port).encode())

    def lineReceived(self, line: bytes) -> None:
        """Do one order and repeat it, so that the test knows that it was done."""
        verb, *rest = line.decode().split()
        if verb == "gone":
            self._team.away.add(rest[0])
        elif verb == "back":
            self._team.away.discard(rest[0])
        elif verb == "status":
            next(each for each in self._team.devices if each["name"] == rest[0])["status"] = rest[1]
        elif verb == "freeze":
            time.sleep(float(rest[0]))
        self.sendLine(line)

    def connectionLost(self, reason: Any = None) -> None:
        """End with the test."""
        if reactor.running:
            reactor.stop()


def board() -> Board:
    """What the page can ask for: twins in memory, so that every order is taken and none does harm."""
    return Board(MemoryDesk(CATALOGUE, YARD), OpenSessions(), faults=MemoryFaults(*KINDS))


def main() -> None:
    """Serve until the input ends."""
    team = Team()
    port = int(sys.argv[1]) if len(sys.argv) > 1 else 0
    web = web_service(reactor, "127.0.0.1", port, team.read, board(), team, time.time)
    web.startService()
    reactor.addSystemEventTrigger("before", "shutdown", web.stopService)
    reactor.callWhenRunning(lambda: StandardIO(Orders(team, web)))
    reactor.run()


if __name__ == "__main__":
    main()
