"""Tests of the settings of a node."""

from __future__ import annotations

import hashlib
import os
from pathlib import Path

from twisted.trial.unittest import SynchronousTestCase

from middleware.config.settings import Settings
from middleware.entangled.network.network import Address
from middleware.errors import BadSetting

WHOLE = """
[node]
name = "dog1"
kind = "ers7"
description = "a white dog"
host = "127.0.0.2"
port = 7001
known_nodes = ["10.0.0.7:7000", "vaio.local:7000", "[fe80::1]:7000", "10.0.0.7:7000"]
store = "dog1.db"
team_key = "correct horse"
roles = ["web", "edge"]
presence_lease = 2
position = { x = 1, y = 2.5, heading = 0 }
[node.capabilities.camera]
width = 208
lens = "wide"
[agent]
module = "search"
[driver]
kind = "sim"
options = { robot = "dog1", port = 7400 }
[[driver.parts]]
kind = "camera"
options = { source = 1 }
[[driver.parts]]
kind = "compass"
[web]
host = "::1"
port = 0
yard = "127.0.0.1:7400"
tls = "auto"
tls_port = 0
code = "quiet-otter"
password = "scrypt$1"
sign_in = false
[faults]
allow = true
"""


def settings(**node: object) -> Settings:
    return Settings.from_mapping({"node": {"name": "dog1", **node}}, "dog1.toml")


class SettingsTest(SynchronousTestCase):
    def file(self, text: str | bytes) -> str:
        path: str = self.mktemp()
        Path(path).write_bytes(text.encode() if isinstance(text, str) else text)
        return path

    def refusal(self, table: str, key: str, value: object) -> str:
        """Return the one-line error for a value, which must contain file, table and key, and the remedy."""
        mapping = {"node": {"name": "dog1"}}
        mapping.setdefault(table, {})[key] = value  # type: ignore[assignment]
        line: str = str(self.assertRaises(BadSetting, Settings.from_mapping, mapping, "dog1.toml"))
        self.assertEqual(line.splitlines(), [line])
        self.assertLess(len(line), 400)  # an error contains a long value in truncated form
        self.assertTrue(line.startswith(f"dog1.toml: [{table}] {key}: "), line)
        self.assertIn("; ", line)
        return line

    def test_whole_file(self) -> None:
        """Every key of a file is read, with the type that the program uses."""
        path = self.file(WHOLE)
        read = Settings.load(path)
        node = read.node
        self.assertEqual((node.name, node.kind, node.description), ("dog1", "ers7", "a white dog"))
        self.assertEqual((node.host, node.port, node.presence_lease), ("127.0.0.2", 7001, 2.0))
        self.assertEqual(
            node.known_nodes, (Address("10.0.0.7", 7000), Address("vaio.local", 7000), Address("fe80::1", 7000))
        )
        self.assertEqual(node.roles, ("edge", "web"))
        self.assertEqual(node.capabilities, {"camera": {"width": 208, "lens": "wide"}})
        self.assertEqual(read.agent.module, "search")
        self.assertEqual((read.driver.kind, read.driver.options), ("sim", {"robot": "dog1", "port": 7400}))
        self.assertEqual(read.driver.parts, (("camera", {"source": 1}), ("compass", {})))
        self.assertEqual((read.web.host, read.web.port, read.web.yard), ("::1", 0, Address("127.0.0.1", 7400)))
        self.assertEqual(node.position, {"x": 1.0, "y": 2.5, "heading": 0.0})
        web = read.web
        self.assertEqual(
            (web.tls, web.tls_port, web.code, web.password, web.sign_in), ("auto", 0, "quiet-otter", "scrypt$1", False)
        )
        self.assertTrue(read.faults.allow)
        self.assertNotIn("otter", repr(read))
        self.assertNotIn("scrypt", repr(read))
        self.assertEqual(read.origin, path)

    def test_defaults(self) -> None:
        """A node with only a name listens on loopback, stores in memory, and has no driver and no agent."""
        read = settings()
        self.assertEqual((read.node.host, read.node.port, read.node.store), ("127.0.0.1", 8484, ":memory:"))
        self.assertEqual((read.node.known_nodes, read.node.roles), ((), ("edge",)))
        self.assertEqual((read.agent.module, read.driver.kind, read.web.yard), ("", "", None))

    def test_store_beside_the_file(self) -> None:
        """A relative store path is resolved against the folder of the settings file; an absolute path is unchanged."""
        mapping = {"node": {"name": "a", "store": "a.db"}}
        self.assertEqual(Settings.from_mapping(mapping, "/etc/swarm/a.toml").node.store, "/etc/swarm/a.db")
        mapping["node"]["membership"] = "a.membership"
        self.assertEqual(Settings.from_mapping(mapping, "/etc/swarm/a.toml").node.membership, "/etc/swarm/a.membership")
        mapping["node"]["store"] = "/var/a.db"
        self.assertEqual(Settings.from_mapping(mapping, "/etc/swarm/a.toml").node.store, "/var/a.db")
        mapping["node"]["store"] = ":memory:"
        self.assertEqual(Settings.from_mapping(mapping, "/etc/swarm/a.toml").node.store, ":memory:")

    def test_team_key(self) -> None:
        """The team key is hashed to 32 bytes, is not part of ``repr``, and is empty by default."""
        self.assertEqual((settings().node.team_key, settings().node.membership), ("", ""))
        self.assertEqual(settings(team_key="horse").node.team_secret, hashlib.blake2s(b"horse").digest())
        self.assertNotEqual(settings(team_key="correct horse").node.team_secret, settings().node.team_secret)
        self.assertNotIn("correct horse", repr(settings(team_key="correct horse")))

    def test_examples_of_errors(self) -> None:
        """An error is one line with file, table, key, the problem without secrets, and the remedy."""
        problem, _, remedy = self.refusal("node", "port", "x").rpartition("; ")
        self.assertIn('is "x"', problem)
        self.assertIn("65535", remedy)
        self.assertIn("8484", remedy)
        problem, _, remedy = self.refusal("node", "roles", ["edge", "wep"]).rpartition("; ")
        self.assertIn('[1] is "wep"', problem)
        self.assertIn('nearest is "web"', remedy)
        self.assertNotIn("hunter2", self.refusal("node", "team_key", ["hunter2"]))
        self.assertIn('"camera.fps"', self.refusal("node", "capabilities", {"camera": {"fps": True}}))

    def test_wrong_values(self) -> None:
        """For every key a value of a wrong type or out of range raises an error."""
        wrong: dict[tuple[str, str], list[object]] = {
            ("node", "name"): ["", "x" * 41, "dog 1", "dög", 1, "dog\n"],
            ("node", "kind"): [1, "x" * 41, "two\nlines"],
            ("node", "description"): [["text"], "x" * 10_000],
            ("node", "host"): ["localhost", "", 7, "10.0.0.256", "0.0.0.0", "::"],
            ("node", "port"): [-1, 65536, 1.0, True, "7000"],
            ("node", "known_nodes"): [
                "10.0.0.7:7000",
                ["10.0.0.7"],
                ["10.0.0.7:0"],
                ["10.0.0.7:70000"],
                [":7000"],
                [7],
            ],
            ("node", "store"): ["", 1],
            ("node", "store_rows"): [0, 99, 1_000_001, 500.0, True, "500"],
            ("node", "durable"): ["", "disk", True, 1],
            ("node", "store_bytes"): [0, 99_999, 2**31 + 1, 1e6],
            ("node", "team_key"): ["", 1],
            ("node", "roles"): [[], "edge", [1], ["boss"]],
            ("node", "presence_lease"): [0, 0.05, 61, True, "1", float("nan"), float("inf")],
            ("node", "tunnels"): [
                *("wss://a", [1], ["https://a"], ["wss://"], ["wss://a:0"], ["auto", "none"]),
                [f"wss://a:{n}" for n in range(1, 10)],
            ],
            ("node", "tunnel_port"): [-1, 65536, "443"],
            ("node", "tunnel_tls"): ["no", 0],
            ("node", "capabilities"): [1, {"camera": 1}, {"camera": {"fps": [30]}}, {"camera": {"fps": float("nan")}}],
            ("agent", "module"): ["no such", "1st", ".search", 1],
            ("driver", "kind"): ["sim/", 1],
            ("driver", "options"): [[]],
            ("driver", "parts"): [
                *(5, {"kind": "camera"}, ["camera"], [{}], [{"kind": "no such"}], [{"kind": 7}]),
                *([{"kind": "camera", "url": "x"}], [{"kind": "camera", "options": 7}], [{"kind": "camera"}] * 9),
            ],
            ("web", "host"): ["page.local"],
            ("web", "port"): ["8080"],
            ("web", "yard"): ["127.0.0.1", 7400, None],
            ("web", "tls"): ["yes", True],
            ("web", "tls_port"): [-1],
            ("web", "code"): ["short", "Large", 5],
            ("web", "password"): [5, "x" * 201],
            ("web", "sign_in"): ["no"],
            ("faults", "allow"): [1],
            ("node", "position"): [5, {"x": 1.0}, {"x": 1, "y": "2", "heading": 0}, {"lat": 1, "lon": 2}],
            ("deployment", "allow"): [1, "true", None],
            ("deployment", "operators"): ["ab" * 32, ["ab"], ["AB" * 32], [7], [f"{n:064x}" for n in range(9)]],
            ("deployment", "modules"): ["best", ["../best"], ["Best"], [""], [f"m{n}" for n in range(9)]],
        }
        for (table, key), values in wrong.items():
            for value in values:
                self.refusal(table, key, value)

    def test_deployment_is_off_by_default(self) -> None:
        """Deployment is disabled by default, and can be enabled in the file and by command-line flags."""
        off = settings().deployment
        self.assertEqual((off.allow, off.operators, off.modules), (False, (), ()))
        table = {"allow": True, "operators": ["ab" * 32], "modules": ["best", "spin"]}
        on = Settings.from_mapping({"node": {"name": "a"}, "deployment": table}, "a.toml").deployment
        self.assertEqual((on.allow, on.operators, on.modules), (True, ("ab" * 32,), ("best", "spin")))
        flags = settings().with_flags(deployment_allow="true", deployment_modules="best, spin").deployment
        self.assertEqual((flags.allow, flags.modules), (True, ("best", "spin")))
        self.assertRaises(BadSetting, settings().with_flags, deployment_allow="yes")

    def test_tunnels(self) -> None:
        """By default the node uses a tunnel on port 443 to each remote known node; configured tunnels come first."""
        known = ["10.0.0.7:7000", "127.0.0.1:7000", "10.0.0.7:7001", "[fe80::1]:7000"]
        found = [str(url) for url in settings(known_nodes=known).node.tunnel_urls]
        self.assertEqual(found, ["wss://10.0.0.7/swarm", "wss://[fe80::1]/swarm"])
        named = settings(known_nodes=known, tunnels=["auto", "wss://b.example:8443/swarm"]).node.tunnel_urls
        self.assertEqual(str(named[0]), "wss://b.example:8443/swarm")
        self.assertEqual(len(named), 3)
        self.assertEqual(settings(known_nodes=known, tunnels=[]).node.tunnel_urls, ())
        self.assertEqual(settings().node.tunnel_urls, ())
        flags = settings().with_flags(tunnel_port="443", tunnels="wss://a", tunnel_tls="false").node
        self.assertEqual((flags.tunnel_port, flags.tunnels, flags.tunnel_tls), (443, ("wss://a",), False))

    def test_unknown_names(self) -> None:
        """A misspelt table or key, a missing name, and a value in place of a table raise an error with the remedy."""
        for mapping, meant in (
            ({"nod": {}}, "nearest table is [node]"),
            ({"store": "x"}, "store: is outside of any table; write it below [node]"),
            ({"prot": 7000}, "prot: is outside of any table; the nearest setting is port, below [node] or [web]"),
            ({"node": {"name": "a", "known_node": []}}, "nearest is known_nodes"),
            ({"node": {"name": "a"}, "web": {"prot": 1}}, "nearest is port"),
            ({"node": {"port": 1}}, "[node] name: is missing"),
            ({}, "[node] name: is missing"),
            ({"node": 3}, "[node]: must be a table, is 3"),
        ):
            error = self.assertRaises(BadSetting, Settings.from_mapping, mapping, "dog1.toml")
            self.assertIn(meant, str(error))

    def test_files_that_cannot_be_read(self) -> None:
        """A missing file, a folder, non-UTF-8 bytes and broken TOML each raise a one-line error with the reason."""
        folder = self.mktemp()
        os.mkdir(folder)
        for path, reason in (
            (self.mktemp(), "No such file"),
            (folder, "directory"),
            (self.file(b"\xff\xfe"), "not UTF-8"),
            (self.file("[node]\nname = dog1\n"), "line 2"),
            (self.file("[node]\nname = 'a'\nname = 'b'\n"), "line 3"),
        ):
            line = str(self.assertRaises(BadSetting, Settings.load, path))
            self.assertTrue(line.startswith(path + ": "), line)
            self.assertIn(reason, line)
            self.assertNotIn("\n", line)


class FlagsTest(SynchronousTestCase):
    def test_flags_win(self) -> None:
        """Flags override the file; all other values, and the original settings object, are unchanged."""
        before = settings(port=7001, kind="ers7")
        after = before.with_flags(port=7002, web_port="8081", agent_module="search", name=None)
        self.assertEqual((after.node.port, after.web.port, after.agent.module), (7002, 8081, "search"))
        self.assertEqual((after.node.name, after.node.kind), ("dog1", "ers7"))
        self.assertEqual(before.node.port, 7001)

    def test_text_of_the_command_line(self) -> None:
        """Numbers and lists are parsed from command-line text."""
        node = settings().with_flags(presence_lease="0.5", roles="web, edge", known_nodes="10.0.0.7:7000,").node
        self.assertEqual((node.presence_lease, node.roles), (0.5, ("edge", "web")))
        self.assertEqual(node.known_nodes, (Address("10.0.0.7", 7000),))

    def test_store_where_one_stands(self) -> None:
        """A store path on the command line is relative to the working directory."""
        self.assertEqual(settings(store="a.db").with_flags(store="b.db").node.store, "b.db")

    def test_bad_flags(self) -> None:
        """The error for an unknown flag suggests the most similar flag; the error for a bad value contains its flag."""
        for flags, line in (
            ({"prot": 1}, "command line: --prot: is not a setting; the nearest is --port"),
            ({"web_port": "many"}, 'command line: --web-port: is "many"; write a number from 0 to 65535'),
            (
                {"presence_lease": "long"},
                'command line: --presence-lease: is "long"; write a number from 0.1 to 60 seconds',
            ),
        ):
            error = self.assertRaises(BadSetting, settings().with_flags, **flags)
            self.assertTrue(str(error).startswith(line), str(error))
