"""Tests of ``swarmnode.plugin``: options, and what each bad input says."""

from __future__ import annotations

import contextlib
import io
import socket
import sqlite3
from pathlib import Path
from typing import Any

from twisted.trial.unittest import SynchronousTestCase

from drivers.registry import kinds
from middleware.config.settings import Settings
from middleware.entangled.errors import BadStore, PortInUse, TunnelPortInUse
from middleware.entangled.network.network import Address
from middleware.errors import BadSetting, UnknownAgent
from swarmnode.plugin import Options, makeService, told
from swarmnode.world import resolved

ROOT = Path(__file__).resolve().parents[2]


class RefusalTests(SynchronousTestCase):
    """What each bad input says."""

    def setUp(self) -> None:
        self.folder = Path(self.mktemp())
        self.folder.mkdir()

    def file(self, text: str) -> str:
        """A settings file."""
        path = self.folder / "node.toml"
        path.write_text(text, encoding="utf-8")
        return str(path)

    def refusal(self, *arguments: str, is_made: bool = False) -> str:
        """The one line that the command line is refused with."""
        errors = io.StringIO()
        with contextlib.redirect_stderr(errors), self.assertRaises(SystemExit) as caught:
            options = Options()
            options.parseOptions(list(arguments))
            self.assertTrue(is_made, "refused only when the node is made")
            makeService(options)
        self.assertEqual(caught.exception.code, 2)
        self.assertEqual(errors.getvalue().count("\n"), 1, errors.getvalue())
        return errors.getvalue().strip()

    def assert_says(self, line: str, *parts: str) -> None:
        """The line has each part."""
        for part in ("swarm-node: ", *parts):
            self.assertIn(part, line)

    def test_refuse_unknown_key(self) -> None:
        """An unknown key is refused with file, key and the nearest lawful one."""
        path = self.file('[node]\nname = "a"\nteam_key = "t"\nprot = 7\n')
        self.assert_says(self.refusal("--config", path), path, "[node] prot", "the nearest is port")

    def test_refuse_wrong_type(self) -> None:
        """A value of the wrong type is refused with file, key and what to write."""
        path = self.file('[node]\nname = "a"\nteam_key = "t"\nport = "high"\n')
        self.assert_says(self.refusal("--config", path), path, "[node] port", "such as 8484")

    def test_refuse_missing_file(self) -> None:
        """A settings file that is not there is named."""
        path = str(self.folder / "nowhere.toml")
        self.assert_says(self.refusal("--config", path), path, "cannot be read", "name a settings file")

    def test_refuse_missing_name(self) -> None:
        """Without a file the name has to be said, and the line says how."""
        self.assert_says(self.refusal("--port", "0"), "--name", "is missing")

    def test_refuse_wrong_flags(self) -> None:
        """A flag with a wrong value is refused under its own name."""
        self.assert_says(self.refusal("--name", "a b"), "command line: --name")
        self.assert_says(self.refusal("--name", "a", "--port", "70000"), "command line: --port", "65535")
        self.assert_says(self.refusal("--name", "a", "--known-nodes", "here"), "--known-nodes", "host:port")

    def test_refuse_unknown_agent(self) -> None:
        """An agent that does not exist is refused with those that do."""
        path = self.file('[node]\nname = "a"\nteam_key = "t"\n[driver]\nkind = "sim"\n[agent]\nmodule = "serch"\n')
        self.assert_says(self.refusal("--config", path, is_made=True), path, "[agent] module", "'serch'", "search")

    def test_refuse_agent_without_robot(self) -> None:
        """An agent that has no robot to act with is refused, and not left out in silence."""
        path = self.file('[node]\nname = "a"\nteam_key = "t"\n[agent]\nmodule = "search"\n')
        self.assert_says(self.refusal("--config", path, is_made=True), path, "[agent] module", "name its [driver] kind")

    def test_refuse_agent_that_cannot_be_imported(self) -> None:
        """An agent of one's own that cannot be loaded says why."""
        path = self.file(
            '[node]\nname = "a"\nteam_key = "t"\n[driver]\nkind = "sim"\n[agent]\nmodule = "no_such_module:Mind"\n'
        )
        line = self.refusal("--config", path, is_made=True)
        self.assert_says(line, "[agent] module", "no_such_module")

    def test_refuse_unknown_driver(self) -> None:
        """A kind of robot that there is no driver for is refused with those that there are."""
        path = self.file('[node]\nname = "a"\nteam_key = "t"\n[driver]\nkind = "simm"\n')
        known = "known are " + ", ".join(kinds())
        self.assert_says(self.refusal("--config", path, is_made=True), path, "[driver]", "'simm'", known)

    def test_refuse_wrong_driver_option(self) -> None:
        """A driver's option with a wrong value is refused with the option and what to write."""
        path = self.file('[node]\nname = "a"\nteam_key = "t"\n[driver]\nkind = "sim"\noptions = { port = "x" }\n')
        self.assert_says(self.refusal("--config", path, is_made=True), path, "[driver]", "port", "7400")

    def test_refuse_foreign_store(self) -> None:
        """A SQLite file of another program is refused, named, and left as it was."""
        foreign = self.folder / "foreign.sqlite"
        with contextlib.closing(sqlite3.connect(foreign)) as connection:
            connection.execute("CREATE TABLE birds(name TEXT)")
        before = foreign.read_bytes()
        path = self.file('[node]\nname = "a"\nteam_key = "t"\nstore = "foreign.sqlite"\n')
        self.assert_says(self.refusal("--config", path, is_made=True), path, "[node] store", "foreign.sqlite")
        self.assertEqual(foreign.read_bytes(), before)

    def test_refuse_unreadable_store(self) -> None:
        """A store that is no SQLite file, or lies in no folder, is refused and named."""
        (self.folder / "text.sqlite").write_text("this is a letter " * 99, encoding="utf-8")
        for name in ("text.sqlite", "no/such/folder.sqlite"):
            path = self.file(f'[node]\nname = "a"\nteam_key = "t"\nstore = "{name}"\n')
            self.assert_says(self.refusal("--config", path, is_made=True), path, "[node] store", name)

    def test_refuse_name_without_address(self) -> None:
        """A known node whose name has no address is refused with the key and the name."""

        def nothing(*_: object, **__: object) -> Any:
            raise socket.gaierror(socket.EAI_NONAME, "Name or service not known")

        node = {"name": "a", "known_nodes": ["no-such-host.invalid:7000"]}
        settings = Settings.from_mapping({"node": node}, "x.toml")
        error = self.assertRaises(BadSetting, resolved, settings, nothing)
        self.assertEqual(
            told(error, "x.toml"),
            "x.toml: [node] known_nodes: no address is known for 'no-such-host.invalid' (Name or service not known); "
            "mend the name, or write the address in figures",
        )

    def test_say_which_setting_to_mend(self) -> None:
        """A fault that knows no file gets the file and the key in front of it, on one line."""
        self.assertEqual(told(PortInUse("UDP 1:2: taken"), "a.toml"), "a.toml: [node] port: UDP 1:2: taken")
        self.assertEqual(
            told(TunnelPortInUse("TCP 1:2: taken"), "a.toml"), "a.toml: [node] tunnel_port: TCP 1:2: taken"
        )
        self.assertEqual(told(BadStore("two\nlines"), "a.toml"), "a.toml: [node] store: two lines")
        self.assertEqual(told(UnknownAgent("x"), ""), "[agent] module: x")


class OptionsTests(SynchronousTestCase):
    def test_flags_win_over_the_file(self) -> None:
        """A flag replaces what the file says, and leaves everything else."""
        path = Path(self.mktemp())
        path.write_text('[node]\nname = "a"\nteam_key = "t"\nport = 7001\nkind = "dog"\n', encoding="utf-8")
        options = Options()
        options.parseOptions(["--config", str(path), "--port", "7002", "--roles", "edge,bootstrap"])
        node = options.settings.node
        self.assertEqual((node.name, node.port, node.kind, node.roles), ("a", 7002, "dog", ("edge", "bootstrap")))

    def test_flags_alone_are_enough(self) -> None:
        """A node can be described by flags alone."""
        options = Options()
        options.parseOptions(["--name", "b", "--known-nodes", "10.0.0.1:7000,10.0.0.2:7000", "--web-port", "0"])
        settings = options.settings
        self.assertEqual((settings.node.name, settings.web.port), ("b", 0))
        self.assertEqual(settings.node.known_nodes, (Address("10.0.0.1", 7000), Address("10.0.0.2", 7000)))

    def key_file(self) -> str:
        """A file that holds a team's secret."""
        path = Path(self.mktemp())
        path.touch(mode=0o600)
        path.write_text("t\n", encoding="utf-8")
        return str(path)

    def test_every_setting_of_a_flag_exists(self) -> None:
        """Each flag but the file's is a setting: all of them at once are accepted."""
        values = {
            "name": "a", "kind": "k", "host": "127.0.0.1", "port": "0", "known-nodes": "10.0.0.1:1",
            "store": "s.sqlite", "membership": "m", "team-key-file": self.key_file(), "roles": "edge",
            "agent-module": "search", "driver-kind": "sim", "web-host": "127.0.0.1", "web-port": "0", "web-tls": "auto",
            "web-tls-port": "0", "web-yard": "10.0.0.1:1", "tunnels": "wss://a", "tunnel-port": "443", "lan": "false",
        }  # fmt: skip
        self.assertEqual(set(values), {str(row[0]) for row in Options.optParameters} - {"config"})
        Options().parseOptions([word for name, value in values.items() for word in (f"--{name}", value)])

    def test_names_become_addresses_once(self) -> None:
        """Host names of known nodes and of the yard are looked up at the start, in the family of the own port."""
        asked: list[tuple[str, int]] = []

        def look_up(host: str, port: int, family: int, type: int) -> Any:  # noqa: A002
            asked.append((host, family))
            return [(family, type, 17, "", ("10.9.8.7", port))]

        mapping = {
            "node": {"name": "a", "known_nodes": ["laptop.local:7000"], "roles": ["web"]},
            "web": {"yard": "yard.local:7400"},
        }
        settings = resolved(Settings.from_mapping(mapping, "x.toml"), look_up)
        self.assertEqual(settings.node.known_nodes, (Address("10.9.8.7", 7000),))
        self.assertEqual(settings.web.yard, Address("10.9.8.7", 7400))
        self.assertEqual(asked, [("laptop.local", socket.AF_INET), ("yard.local", socket.AF_UNSPEC)])
