"""Tests of ``control.command``: command lines, requests, and replies as text and JSON."""

from __future__ import annotations

import contextlib
import io
import json
import os
import shutil
import socket
import tempfile
import threading
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from twisted.trial.unittest import SynchronousTestCase

from middleware.entangled.control.command import main, send_request
from middleware.entangled.control.socket_path import NoControl, prepare_path

RECORD = {"owner": "ab" * 32, "name": "", "sequence": 1, "lifetime": "team", "value": "red"}


class CommandTests(SynchronousTestCase):
    def setUp(self) -> None:
        # The folders of trial are too long for the path of a Unix socket.
        runtime = Path(tempfile.mkdtemp())
        self.addCleanup(shutil.rmtree, runtime)
        self.patch(os, "environ", {**os.environ, "XDG_RUNTIME_DIR": str(runtime)})
        prepare_path("a").touch()
        self.requests: list[dict[str, Any]] = []
        self.replies: list[dict[str, Any]] = [{"answer": None}]
        self.said = ""

    def ask(self, path: Path, request: dict[str, Any]) -> Iterator[dict[str, Any]]:
        self.requests.append(request)
        yield from self.replies

    def run_command(self, line: str, *replies: dict[str, Any]) -> tuple[int, str]:
        """Return the exit code and the output of ``swarm LINE`` if the node sends these replies."""
        self.replies = list(replies) or [{"answer": None}]
        group, *words = line.split()
        output, complaint = io.StringIO(), io.StringIO()
        with contextlib.redirect_stderr(complaint):
            code = main(group, words, output, self.ask)
        self.said = complaint.getvalue()
        return code, output.getvalue()

    def request(self, line: str) -> dict[str, Any]:
        self.run_command(line)
        return self.requests[-1]

    def test_requests(self) -> None:
        """Each command line sends the corresponding request."""
        for line, verb, given in (
            ("dht get a", "dht get", {"key": "a", "concern": "majority"}),
            ("dht find id:00 --node a", "dht find", {"key": "id:00"}),
            ("dht remove a --name n", "dht remove", {"key": "a", "name": "n"}),
            ("keyword search red target", "keyword search", {"words": "red target"}),
            ("tuple put job 7 true", "tuple put", {"fields": ["job", 7, True]}),
            ("tuple get job ?int --wait 2", "tuple get", {"template": ["job", {"kind": "int"}], "wait": 2.0}),
            ("tuple read _ --all", "tuple read", {"template": [{"any": True}], "all": True}),
            ("rpc h:1 add 2 [3]", "rpc", {"node": "h:1", "method": "add", "arguments": [2, [3]]}),
        ):
            request = self.request(line)
            self.assertEqual(request["verb"], verb)
            self.assertEqual({k: v for k, v in request["with"].items() if v is not False}, given)
        put = self.request("dht put a red --lifetime leased --concern all --expect 3")["with"]
        self.assertEqual((put["lifetime"], put["concern"], put["expect"], put["value"]), ("leased", "all", 3, "red"))

    def test_value_from_a_file(self) -> None:
        """``@FILE`` sends the content of a file; a missing file gives exit code 2."""
        path = Path(self.mktemp())
        path.write_bytes(b"\xff")
        self.assertEqual(self.request(f"dht put a @{path}")["with"]["value"], {"base64": "/w=="})
        self.assertEqual(self.run_command("dht put a @/nowhere/at/all")[0], 2)
        self.assertEqual(self.said, "swarm dht: /nowhere/at/all cannot be read: No such file or directory\n")

    def test_answers_for_people_and_programs(self) -> None:
        """A reply is printed as lines of text, or as one line of JSON with ``--json``."""
        self.assertEqual(self.run_command("dht get a", {"answer": [RECORD]}), (0, "ababababab  -  red\n"))
        code, output = self.run_command("dht get a --json", {"answer": [RECORD]})
        self.assertEqual((code, json.loads(output)), (0, [RECORD]))
        for line, answer, shown in (
            ("dht find a", [{"id": "00ff", "host": "h", "port": 7}], "00ff  h:7\n"),
            ("dht put a b", {"replicas": 3}, "stored at 3 replicas\n"),
            ("tuple get _", ["job", 7], '"job" 7\n'),
            ("tuple read _ --all", [["a"], [1]], '"a"\n1\n'),
            ("tuple put a", None, ""),
            ("rpc h:1 ping", "pong", '"pong"\n'),
        ):
            self.assertEqual(self.run_command(line, {"answer": answer}), (0, shown))

    def test_words_of_others_cannot_move_the_cursor(self) -> None:
        """Control characters in names, values, fields and errors of other nodes are not printed."""
        evil = "red\x1b[2J\x9b2J\n\u202e"
        record = {**RECORD, "name": evil, "value": evil}
        for line, answer in (
            ("dht get a", [record]),
            ("dht watch a", [record]),
            ("dht find a", [{"id": "00ff", "host": evil, "port": 7}]),
            ("keyword search a", [record]),
            ("tuple get _", [evil]),
            ("tuple read _ --all", [[evil]]),
            ("rpc h:1 name", {evil: evil}),
        ):
            for each in (line, f"{line} --json"):
                _, output = self.run_command(each, {"answer": answer})
                self.assertTrue(output.removesuffix("\n").rstrip("\n").isprintable(), (each, output))
            self.assertEqual(json.loads(output), answer)
        for line in ("rpc h:1 name", "rpc h:1 name --json"):
            _, output = self.run_command(line, {"error": "Refused", "text": evil})
            self.assertTrue((output + self.said).replace("\n", "").isprintable())
            self.assertEqual(self.said.count("\n"), 1)

    def test_events_are_printed_as_they_come(self) -> None:
        """A watch prints each change when it arrives, followed by a blank line."""
        code, output = self.run_command("dht watch a", {"event": [RECORD]}, {"event": []}, {"answer": None})
        self.assertEqual((code, output), (0, "ababababab  -  red\n\n\n"))

    def test_exit_codes(self) -> None:
        """Exit code 1 means not found or rejected, and 2 an invalid command line; the reason is one line."""
        self.assertEqual(self.run_command("dht get a", {"answer": []})[0], 1)
        self.assertEqual(self.run_command("tuple get _", {"answer": None})[0], 1)
        self.assertEqual(self.run_command("dht put a b", {"error": "Unavailable", "text": "1 of 3 answered"})[0], 1)
        self.assertEqual(self.said, "swarm dht: 1 of 3 answered\n")
        code, output = self.run_command("dht put a b --json", {"error": "Unavailable", "text": "x"})
        self.assertEqual((code, json.loads(output)["error"]), (1, "Unavailable"))
        self.assertEqual(self.run_command("dht get a", {"error": "BadRequest", "text": "x"})[0], 2)
        self.assertEqual(self.run_command("dht get a --node b")[0], 2)
        self.assertIn("run: a", self.said)
        self.assertEqual(self.run_command("tuple get ?number")[0], 2)
        self.assertEqual(self.run_command("dht get a", {"event": []})[0], 1)

    def test_wrong_command_lines(self) -> None:
        """An invalid command line gives exit code 2, and no request is sent."""
        complaint = io.StringIO()
        for line in ("dht", "dht fly", "dht get", "dht put a", "tuple get", "dht put a b --expect x", "rpc h:1"):
            group, *words = line.split()
            with contextlib.redirect_stderr(complaint):
                caught = self.assertRaises(SystemExit, main, group, words, io.StringIO(), self.ask)
            self.assertEqual(caught.code, 2)
        self.assertEqual(self.requests, [])
        self.assertTrue(complaint.getvalue().endswith("the following arguments are required: method\n"))

    def test_node_that_does_not_answer(self) -> None:
        """A socket without a server, and a server with another protocol, give an error with the cause."""
        path = prepare_path("gone")
        said = str(self.assertRaises(NoControl, list, send_request(path, {})))
        self.assertIn("does not answer (No such file or directory); start the node, or remove this file", said)
        server = socket.socket(socket.AF_UNIX)
        self.addCleanup(server.close)
        server.bind(str(path))
        server.listen(1)

        def speak() -> None:
            connection, _ = server.accept()
            connection.recv(100)
            connection.sendall(b"hello\n")
            connection.close()

        thread = threading.Thread(target=speak)
        thread.start()
        self.assertIn("does not answer", str(self.assertRaises(NoControl, list, send_request(path, {}))))
        thread.join()
