"""Tests of the rosbridge driver over real TCP.

The driver is also tested with another WebSocket server than its emulator, and the emulator with the client roslibpy.
"""

from __future__ import annotations

import json
import subprocess
import sys
from importlib.util import find_spec
from random import Random
from typing import Any

from twisted.internet import reactor as running
from twisted.internet.threads import deferToThread
from twisted.trial.unittest import TestCase

from drivers.driver import Permit
from drivers.link import TcpConnector, TcpLinkFactory
from drivers.rosbridge.driver import RosbridgeDriver
from sim.robots.emulator.rosbridge import RosbridgeRobot
from sim.robots.emulator.simulated_robot import MemoryRobot
from tests.live.waiting import until

reactor: Any = running
MISSING = "NOTHING IS HELD AGAINST THE ROSBRIDGE OF OTHERS: install the extra ros"
OTHERS = """
import json, sys, threading, time
import roslibpy
ros = roslibpy.Ros("127.0.0.1", int(sys.argv[1]))
ros.run(timeout=10)
seen = []
odom = roslibpy.Topic(ros, "/odom", "nav_msgs/Odometry", throttle_rate=50)
heard = threading.Event()
odom.subscribe(lambda told: (seen.append(told), heard.set()))
wheels = roslibpy.Topic(ros, "/cmd_vel", "geometry_msgs/Twist")
wheels.advertise()
found = roslibpy.Service(ros, "/rosapi/topic_type", "rosapi/TopicType")
kind = found.call(roslibpy.ServiceRequest({"topic": "/cmd_vel"}), timeout=5)["type"]
end = time.monotonic() + 5
while time.monotonic() < end and not (seen and seen[-1]["twist"]["twist"]["linear"]["x"] == 0.125):
    wheels.publish(roslibpy.Message({"linear": {"x": 0.125, "y": 0, "z": 0}, "angular": {"x": 0, "y": 0, "z": 0}}))
    heard.wait(0.5)
    heard.clear()
missing = ""
try:
    roslibpy.Service(ros, "/none", "x/Y").call(roslibpy.ServiceRequest({}), timeout=5)
except Exception as error:
    missing = str(error)
print(json.dumps({"kind": kind, "speed": seen[-1]["twist"]["twist"]["linear"]["x"], "missing": missing}))
ros.terminate()
"""


class LiveRosbridgeTests(TestCase):
    """Tests of driver and emulator over real sockets on this machine."""

    timeout = 60

    def setUp(self) -> None:
        """Start an emulated robot that listens on a free port."""
        self.body = MemoryRobot(values={"power.level": 0.8, "range.near": 0.5})
        self.robot = RosbridgeRobot(reactor, self.body, Random(1))
        self.robot.start()
        port = reactor.listenTCP(0, TcpLinkFactory(self.robot.accept), interface="127.0.0.1")
        self.port: int = port.getHost().port
        self.addCleanup(port.stopListening)
        self.addCleanup(self.robot.stop)

    async def test_drives_over_tcp(self) -> None:
        """Over TCP the robot drives, stops at the deadline, and is connected again after a reboot."""
        driver = RosbridgeDriver({"port": self.port}, TcpConnector(reactor), reactor)
        await driver.connect()
        self.addCleanup(driver.disconnect)
        await driver.enable()
        driver.act({"base.vx": 0.2}, Permit(1, reactor.seconds() + 0.4))
        await until(lambda: self.body.motion[0] == 0.2)
        await until(lambda: self.body.motion[0] == 0.0)
        self.robot.reboot()
        await until(lambda: driver.state == "stale")
        await until(lambda: driver.state == "ready")
        self.assertEqual(driver.diagnostics()["reconnects"], 1.0)
        self.assertEqual(driver.diagnostics()["bad_frames"], 0)

    async def test_other_client_takes_it_for_a_robot(self) -> None:
        """The client roslibpy can subscribe, publish and call services; calling a missing service gives an error."""

        def run() -> subprocess.CompletedProcess[str]:
            command = [sys.executable, "-c", OTHERS, str(self.port)]
            return subprocess.run(command, capture_output=True, text=True, timeout=40, check=False)

        done = await deferToThread(run)
        self.assertEqual(done.returncode, 0, done.stderr[-2000:])
        said = json.loads(done.stdout.splitlines()[-1])
        self.assertEqual((said["kind"], said["speed"]), ("geometry_msgs/msg/Twist", 0.125))
        self.assertIn("does not exist", said["missing"])
        self.assertEqual(self.robot.ignored_count, 0)

    async def test_other_server_takes_it_for_a_client(self) -> None:
        """The driver communicates with autobahn's WebSocket server in small, medium and large messages."""
        from autobahn.twisted.websocket import WebSocketServerFactory, WebSocketServerProtocol

        heard: list[dict[str, Any]] = []
        large = {"pad": "x" * 100_000}

        class Server(WebSocketServerProtocol):  # type: ignore[misc]
            def onMessage(self, payload: bytes, isBinary: bool) -> None:  # noqa: N802, N803 (autobahn's)
                said = json.loads(payload)
                heard.append(said)
                if said["op"] == "call_service":
                    found = {"type": "geometry_msgs/msg/TwistStamped"}
                    answer = {"op": "service_response", "id": said["id"], "values": found, "result": True}
                    self.sendMessage(json.dumps(answer).encode())
                    self.sendPing(b"are you there")
                    self.odometry()

            def onPong(self, payload: bytes) -> None:  # noqa: N802 (autobahn's)
                heard.append({"op": "pong", "payload": payload})

            def odometry(self) -> None:
                if self.state == self.STATE_OPEN:
                    ahead = {"x": 0.0, "y": 0.0, "z": 0.0}
                    pose = {"position": ahead, "orientation": {**ahead, "w": 1.0}}
                    said = {"pose": {"pose": pose}, "twist": {"twist": {"linear": ahead, "angular": ahead}}}
                    for more in ({}, large):
                        whole = {"op": "publish", "topic": "/odom", "msg": {**said, **more}}
                        self.sendMessage(json.dumps(whole).encode(), fragmentSize=700)
                    self.next = reactor.callLater(0.05, self.odometry)

            def onClose(self, wasClean: bool, code: int, reason: str) -> None:  # noqa: N802, N803 (autobahn's)
                self.next.cancel()
                heard.append({"op": "gone", "code": code})

        factory = WebSocketServerFactory()
        factory.protocol = Server
        port = reactor.listenTCP(0, factory, interface="127.0.0.1")
        self.addCleanup(port.stopListening)
        driver = RosbridgeDriver({"port": port.getHost().port}, TcpConnector(reactor), reactor)
        await driver.connect()
        await driver.enable()
        driver.act({"base.vx": 0.2}, Permit(1, reactor.seconds() + 5.0))
        await until(lambda: any(one["op"] == "publish" and one["msg"]["twist"]["linear"]["x"] for one in heard))
        await until(lambda: {"op": "pong", "payload": b"are you there"} in heard)
        await until(lambda: driver.diagnostics()["bytes"] > 300_000)
        self.assertEqual((driver.diagnostics()["bad_frames"], driver.diagnostics()["faults"]), (0, 0))
        await driver.disconnect()
        await until(lambda: heard[-1]["op"] == "gone")
        self.assertEqual(heard[-1]["code"], 1000)
        self.assertEqual(heard[-2]["msg"]["twist"]["linear"]["x"], 0.0)

    if find_spec("roslibpy") is None:
        test_other_client_takes_it_for_a_robot.skip = MISSING  # type: ignore[attr-defined]
    if find_spec("autobahn") is None:
        test_other_server_takes_it_for_a_client.skip = MISSING  # type: ignore[attr-defined]
