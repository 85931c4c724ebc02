"""Tests of ``control.server`` and ``control.request_handler``.

The tests send requests as lines of JSON to a simulated team.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from twisted.internet.error import CannotListenError
from twisted.internet.testing import StringTransport
from twisted.trial.unittest import SynchronousTestCase

from middleware.entangled.control.request_handler import RequestHandler
from middleware.entangled.control.server import MAX_CONNECTIONS, MAX_REQUEST_BYTES, ControlProtocol, ControlServer
from tests.fleet import EntangledTeam


class Listener:
    def __init__(self, refuses: bool = False) -> None:
        self.refuses = refuses
        self.listening: list[str] = []
        self.factory: Any = None

    def listenUNIX(self, path: str, factory: Any, mode: int, wantPID: bool) -> Listener:  # noqa: N802, N803
        """Listen, or raise the same error as for a path that is in use."""
        if self.refuses:
            raise CannotListenError("unix", path, OSError("in use"))
        self.listening.append(path)
        self.factory = factory
        return self

    def stopListening(self) -> None:
        self.listening.clear()


class ControlTests(SynchronousTestCase):
    def setUp(self) -> None:
        self.fleet = EntangledTeam(4)
        self.fleet.run(1.0)
        self.made = 0
        self.listener = Listener()
        self.port = ControlServer(self.listener, Path("/run/a.control"), self.verbs)
        self.port.startService()
        self.addCleanup(self.port.stopService)

    def verbs(self) -> RequestHandler:
        self.made += 1
        return RequestHandler.create(self.fleet.nodes[0], self.fleet.clock, self.fleet.make_life_rng(0))

    def opened(self) -> tuple[ControlProtocol, StringTransport]:
        connection, transport = self.listener.factory.buildProtocol(None), StringTransport()
        connection.makeConnection(transport)
        return connection, transport

    def lines(self, transport: StringTransport) -> list[dict[str, Any]]:
        return [json.loads(line) for line in transport.value().splitlines()]

    def ask(self, verb: object, **given: Any) -> dict[str, Any]:
        connection, transport = self.opened()
        connection.dataReceived(json.dumps({"verb": verb, "with": given}).encode() + b"\n")
        self.fleet.run(3.0)
        lines = self.lines(transport)
        self.assertTrue(transport.disconnecting, lines)
        self.assertEqual(len(lines), 1)
        return lines[0]

    def answer(self, verb: str, **given: Any) -> Any:
        line = self.ask(verb, **given)
        self.assertIn("answer", line)
        return line["answer"]

    def refusal(self, verb: object, **given: Any) -> str:
        """Return the error message for one invalid request."""
        line = self.ask(verb, **given)
        self.assertEqual(line.get("error"), "BadRequest", line)
        return str(line["text"])

    def test_dht(self) -> None:
        """Put, get, find and remove work for text and bytes."""
        self.assertGreaterEqual(self.answer("dht put", key="a", value="red")["replicas"], 3)
        self.answer("dht put", key="a", value={"base64": "/wA="}, name="other")
        (other, red) = sorted(self.answer("dht get", key="a"), key=lambda r: str(r["value"]), reverse=True)
        self.assertEqual((red["value"], red["name"], red["lifetime"]), ("red", "", "team"))
        self.assertEqual((other["value"], other["name"]), ({"base64": "/wA="}, "other"))
        self.assertEqual(red["owner"], self.fleet.nodes[0].identity.public.hex())
        self.assertEqual(len(self.answer("dht find", key="a")), 3)
        self.answer("dht remove", key="a", name="other")
        self.assertEqual([r["value"] for r in self.answer("dht get", key="a", concern="fast")], ["red"])
        key = self.fleet.nodes[0].identity.node_id.hex()
        self.assertEqual(self.answer("dht get", key=f"id:{key}"), [])

    def test_compare_and_set(self) -> None:
        """A put fails with ``Conflict`` if the sequence number that it expects is not the current one."""
        self.answer("dht put", key="a", value="1", expect=0)
        self.assertEqual(self.ask("dht put", key="a", value="2", expect=0)["error"], "Conflict")

    def test_watch_tells_until_it_is_closed(self) -> None:
        """A watch sends each change as an event until the connection closes."""
        connection, transport = self.opened()
        connection.dataReceived(b'{"verb": "dht watch", "with": {"key": "a"}}\n')
        self.fleet.run(1.0)
        self.answer("dht put", key="a", value="red")
        events = [[r["value"] for r in line["event"]] for line in self.lines(transport)]
        self.assertEqual(events[-1], ["red"])
        self.assertFalse(transport.disconnecting)
        connection.connectionLost()
        told = len(self.lines(transport))
        self.answer("dht put", key="a", value="blue")
        self.assertEqual(len(self.lines(transport)), told)

    def test_keywords(self) -> None:
        """A published name is found by each of its words until it is removed."""
        self.answer("keyword publish", name="red_target-3.jpg", value="here")
        self.assertEqual([m["value"] for m in self.answer("keyword search", words="target red")], ["here"])
        self.assertEqual(self.answer("keyword search", words="target blue"), [])
        self.answer("keyword remove", name="red_target-3.jpg")
        self.assertEqual(self.answer("keyword search", words="target"), [])

    def test_tuples(self) -> None:
        """A tuple can be read repeatedly, matched by a template, and taken once."""
        for number in (1, 2):
            self.answer("tuple put", fields=["job", number, {"base64": "/w=="}])
        every = [{"any": True}] * 3
        self.assertEqual(len(self.answer("tuple read", template=every, all=True)), 2)
        template = ["job", {"operator": ">", "operand": 1}, {"kind": "bytes"}]
        self.assertEqual(self.answer("tuple read", template=template), ["job", 2, {"base64": "/w=="}])
        self.assertEqual(self.answer("tuple get", template=template), ["job", 2, {"base64": "/w=="}])
        self.assertIsNone(self.answer("tuple get", template=template))
        self.assertEqual(self.answer("tuple get", template=every, wait=1)[1], 1)
        self.assertEqual(self.ask("tuple read", template=every, wait=1)["error"], "NoTuple")

    def test_rpc(self) -> None:
        """A method is called at the peer with this address or id prefix; an error states the cause."""
        peer = self.fleet.nodes[2]
        peer.endpoint.expose("add", lambda _, a, b: [a + b, b"\xff"])
        where = f"{peer.contact.address.host}:{peer.contact.address.port}"
        for node in (where, peer.identity.node_id.hex()[:12]):
            self.assertEqual(self.answer("rpc", node=node, method="add", arguments=[2, 3]), [5, {"base64": "/w=="}])
        self.assertNotIn("answer", self.ask("rpc", node=where, method="subtract", arguments=[]))
        self.assertIn("begin with", self.refusal("rpc", node="", method="add", arguments=[]).replace("begins", "begin"))
        self.assertIn("no known node", self.refusal("rpc", node="zz", method="add", arguments=[]))
        for port in ("0", "65536", "9" * 5000):
            told = self.refusal("rpc", node=f"10.0.0.1:{port}", method="add", arguments=[])
            self.assertTrue(told.endswith(": the port must be from 1 to 65535"), told)

    def test_wrong_requests(self) -> None:
        """An invalid request is rejected, and the error contains the name of the invalid argument."""
        for verb, given, said in (
            ("dht fly", {}, "dht get"),
            (None, {}, "no verb"),
            ("dht get", {}, "key is missing"),
            ("dht get", {"key": 7}, "key must be a string"),
            ("dht get", {"key": "id:12"}, "40"),
            ("dht get", {"key": "id:xy"}, "40"),
            ("dht get", {"key": "a", "concern": "some"}, "concern"),
            ("dht put", {"key": "a"}, "value"),
            ("dht put", {"key": "a", "value": {"base64": "!"}}, "value"),
            ("dht put", {"key": "a", "value": "", "expect": -1}, "expect"),
            ("tuple put", {"fields": "job"}, "fields"),
            ("tuple put", {"fields": [{"base64": 1}]}, "fields"),
            ("tuple get", {"template": 1}, "template"),
            ("tuple get", {"template": [{"kind": "number"}]}, "template"),
            ("tuple get", {"template": [1], "wait": "long"}, "wait"),
            ("tuple put", {"fields": [1], "ttl": -1}, "above 0 and at most 86400"),
        ):
            self.assertIn(said, self.refusal(verb, **given))
        self.assertEqual(self.ask("tuple put", fields=[[1]])["error"], "BadTuple")
        self.assertEqual(self.ask("tuple get", template=[{"operator": "~", "operand": 1}])["error"], "BadTuple")
        self.assertEqual(self.ask("keyword search", words="")["error"], "BadName")

    def test_lines_that_are_no_request(self) -> None:
        """A line that is too long or not a JSON object is rejected; bytes after a request are ignored."""
        for line in (b"\xff\n", b"[]\n", b"nonsense\n", b"[" * 100_000 + b"\n", b'{"verb": "dht get", "with": []}\n'):
            connection, transport = self.opened()
            connection.dataReceived(line)
            self.assertEqual([each["error"] for each in self.lines(transport)], ["BadRequest"])
            connection.dataReceived(line)
            self.assertEqual(len(self.lines(transport)), 1)
        connection, transport = self.opened()
        connection.dataReceived(b"x" * (MAX_REQUEST_BYTES + 1))
        self.assertEqual([each["error"] for each in self.lines(transport)], ["BadRequest"])

    def test_request_in_pieces(self) -> None:
        """A request may arrive in any number of segments."""
        connection, transport = self.opened()
        for byte in b'{"verb": "dht find", "with": {"key": "a"}}\n':
            connection.dataReceived(bytes([byte]))
        self.fleet.run(1.0)
        self.assertEqual(len(self.lines(transport)[0]["answer"]), 3)

    def test_connections_are_bounded(self) -> None:
        """A connection beyond the limit gets the error ``Busy``; after one is closed, the next one is accepted."""
        connections = [self.opened() for _ in range(MAX_CONNECTIONS)]
        _, transport = self.opened()
        self.assertEqual(self.lines(transport)[0]["error"], "Busy")
        for connection, _ in connections:
            connection.connectionLost()
        self.assertEqual(len(self.answer("dht find", key="a")), 3)

    def test_verbs_are_made_when_somebody_asks(self) -> None:
        """The verbs are created with the first request, and only once."""
        self.assertEqual(self.made, 0)
        self.answer("dht find", key="a")
        self.answer("dht find", key="b")
        self.assertEqual(self.made, 1)

    def test_node_lives_without_a_socket(self) -> None:
        """If the path is in use, the node logs this and continues to run.

        When the control service stops, it closes all its connections.
        """
        port = ControlServer(Listener(refuses=True), Path("/run/a.control"), self.verbs)
        port.startService()
        self.successResultOf(port.stopService())
        connection, transport = self.opened()
        connection.dataReceived(b'{"verb": "dht watch", "with": {"key": "a"}}\n')
        self.successResultOf(self.port.stopService())
        self.assertTrue(transport.disconnecting)
        self.assertEqual(self.listener.listening, [])
