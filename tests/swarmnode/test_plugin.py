"""Tests of ``swarmnode.plugin``: options and error messages."""

from __future__ import annotations

import contextlib
import io
import socket
import sqlite3
from pathlib import Path
from typing import Any

from twisted.trial.unittest import SynchronousTestCase

from drivers.registry import list_kinds
from middleware.config.settings import NODE_PORT, Settings
from middleware.entangled.errors import BadStore, PortInUse, TunnelPortInUse
from middleware.entangled.network.network import Address
from middleware.errors import BadSetting, UnknownAgent
from swarmnode import plugin
from swarmnode.environment import resolve_hosts
from swarmnode.plugin import CheckedService, Options, format_error, makeService
from swarmnode.ports import replace_busy_ports
from tests.swarmnode.team import KEY, MemoryTeam

ROOT = Path(__file__).resolve().parents[2]


class RefusalTests(SynchronousTestCase):
    """The error messages for invalid input."""

    def setUp(self) -> None:
        self.folder = Path(self.mktemp())
        self.folder.mkdir()

    def file(self, text: str) -> str:
        """Write a settings file."""
        path = self.folder / "node.toml"
        path.write_text(text, encoding="utf-8")
        return str(path)

    def refusal(self, *arguments: str, is_made: bool = False) -> str:
        """Return the line with which the arguments are rejected."""
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
        """Check that the error line contains each part."""
        for part in ("swarm-node: ", *parts):
            self.assertIn(part, line)

    def test_refuse_before_the_start(self) -> None:
        """Invalid files and flags are rejected; the error contains location, problem and remedy."""
        node = '[node]\nname = "a"\nteam_key = "t"\n'
        texts: tuple[tuple[str, tuple[str, ...]], ...] = (
            (f"{node}prot = 7\n", ("[node] prot", "the nearest is port")),
            (f'{node}port = "high"\n', ("[node] port", "such as 8484")),
        )
        for text, parts in texts:
            path = self.file(text)
            self.assert_says(self.refusal("--config", path), path, *parts)
        missing = str(self.folder / "nowhere.toml")
        flags: tuple[tuple[tuple[str, ...], tuple[str, ...]], ...] = (
            (("--config", missing), (missing, "cannot be read", "use a settings file")),
            (("--port", "0"), ("--name", "is missing")),
            (("--name", "a b"), ("command line: --name",)),
            (("--name", "a", "--port", "70000"), ("command line: --port", "65535")),
            (("--name", "a", "--known-nodes", "here"), ("--known-nodes", "host:port")),
        )
        for words, parts in flags:
            self.assert_says(self.refusal(*words), *parts)

    def test_refuse_what_cannot_be_made(self) -> None:
        """Unknown agents, drivers and stores, and invalid combinations, are rejected.

        The error lists the valid values.
        """
        known = "known are " + ", ".join(list_kinds())
        (self.folder / "text.sqlite").write_text("this is a letter " * 99, encoding="utf-8")
        driver = '[driver]\nkind = "sim"\n'
        for text, parts in (
            (f'{driver}[agent]\nmodule = "serch"\n', ("[agent] module", "'serch'", "search")),
            ('[agent]\nmodule = "search"\n', ("[agent] module", "set [driver] kind")),
            (f'{driver}[agent]\nmodule = "no_such_module:Mind"\n', ("[agent] module", "no_such_module")),
            ('[driver]\nkind = "simm"\n', ("[driver]", "'simm'", known)),
            (f'{driver}options = {{ port = "x" }}\n', ("[driver]", "port", "7400")),
            ('store = "text.sqlite"\n', ("[node] store", "text.sqlite")),
            ('store = "no/such/folder.sqlite"\n', ("[node] store", "no/such/folder.sqlite")),
        ):
            path = self.file(f'[node]\nname = "a"\nteam_key = "t"\n{text}')
            self.assert_says(self.refusal("--config", path, is_made=True), path, *parts)

    def test_refuse_foreign_store(self) -> None:
        """An SQLite file of another program is rejected and not changed; the error contains its name."""
        foreign = self.folder / "foreign.sqlite"
        with contextlib.closing(sqlite3.connect(foreign)) as connection:
            connection.execute("CREATE TABLE birds(name TEXT)")
        before = foreign.read_bytes()
        path = self.file('[node]\nname = "a"\nteam_key = "t"\nstore = "foreign.sqlite"\n')
        self.assert_says(self.refusal("--config", path, is_made=True), path, "[node] store", "foreign.sqlite")
        self.assertEqual(foreign.read_bytes(), before)

    def test_refuse_name_without_address(self) -> None:
        """The error for a known node without an address contains the key and the name."""

        def nothing(*_: object, **__: object) -> Any:
            raise socket.gaierror(socket.EAI_NONAME, "Name or service not known")

        node = {"name": "a", "known_nodes": ["no-such-host.invalid:7000"]}
        settings = Settings.from_mapping({"node": node}, "x.toml")
        error = self.assertRaises(BadSetting, resolve_hosts, settings, nothing)
        self.assertEqual(
            format_error(error, "x.toml"),
            "x.toml: [node] known_nodes: no address is known for 'no-such-host.invalid' (Name or service not known); "
            "fix the name, or write a numeric address",
        )

    def test_say_which_setting_to_mend(self) -> None:
        """An error that does not refer to a file is reported in one line that begins with the file and the key."""
        self.assertEqual(format_error(PortInUse("UDP 1:2: taken"), "a.toml"), "a.toml: [node] port: UDP 1:2: taken")
        self.assertEqual(
            format_error(TunnelPortInUse("TCP 1:2: taken"), "a.toml"), "a.toml: [node] tunnel_port: TCP 1:2: taken"
        )
        self.assertEqual(format_error(BadStore("two\nlines"), "a.toml"), "a.toml: [node] store: two lines")
        self.assertEqual(format_error(UnknownAgent("x"), ""), "[agent] module: x")


class CheckedServiceTests(SynchronousTestCase):
    def test_take_the_next_port(self) -> None:
        """A node whose default port is in use starts on the next free port; a configured port in use is rejected."""
        team = MemoryTeam()
        team.switchboard.make_network("127.0.0.1", NODE_PORT).listen(lambda datagram, source: None)

        def service(**more: Any) -> CheckedService:
            made = CheckedService(
                Settings.from_mapping({"node": {"name": "a", "team_key": KEY, **more}}, "test"),
                team.make_dependencies("a", NODE_PORT),
            )
            self.patch(
                plugin,
                "make_network_factory",
                lambda node, *_: lambda: team.switchboard.make_network(node.host, node.port),
            )
            return made

        self.patch(
            plugin,
            "replace_busy_ports",
            lambda settings: replace_busy_ports(settings, lambda _, host, port: port != NODE_PORT),
        )
        moved = service()
        moved.startService()
        self.addCleanup(moved.stopService)
        self.assertEqual(moved.assembly.node.entangled.contact.address.port, NODE_PORT + 1)
        errors = io.StringIO()
        with contextlib.redirect_stderr(errors):
            self.assertRaises(SystemExit, service(port=NODE_PORT).startService)
        self.assertIn("test: [node] port: ", errors.getvalue())


class OptionsTests(SynchronousTestCase):
    def test_flags_win_over_the_file(self) -> None:
        """A flag overrides its own value in the file, and no other value."""
        path = Path(self.mktemp())
        path.write_text('[node]\nname = "a"\nteam_key = "t"\nport = 7001\nkind = "dog"\n', encoding="utf-8")
        options = Options()
        options.parseOptions(["--config", str(path), "--port", "7002", "--roles", "edge,bootstrap"])
        node = options.settings.node
        self.assertEqual((node.name, node.port, node.kind, node.roles), ("a", 7002, "dog", ("edge", "bootstrap")))

    def test_flags_alone_are_enough(self) -> None:
        """A node can be configured with flags alone."""
        options = Options()
        options.parseOptions(["--name", "b", "--known-nodes", "10.0.0.1:7000,10.0.0.2:7000", "--web-port", "0"])
        settings = options.settings
        self.assertEqual((settings.node.name, settings.web.port), ("b", 0))
        self.assertEqual(settings.node.known_nodes, (Address("10.0.0.1", 7000), Address("10.0.0.2", 7000)))

    def key_file(self) -> str:
        """Return the path of a file with a team's secret."""
        path = Path(self.mktemp())
        path.touch(mode=0o600)
        path.write_text("t\n", encoding="utf-8")
        return str(path)

    def test_every_setting_of_a_flag_exists(self) -> None:
        """Each flag except ``--config`` corresponds to a setting."""
        values = {
            "name": "a", "kind": "k", "host": "127.0.0.1", "port": "0", "known-nodes": "10.0.0.1:1",
            "store": "s.sqlite", "membership": "m", "team-key-file": self.key_file(), "roles": "edge",
            "agent-module": "search", "driver-kind": "sim", "web-host": "127.0.0.1", "web-port": "0", "web-tls": "auto",
            "web-tls-port": "0", "web-yard": "10.0.0.1:1", "tunnels": "wss://a", "tunnel-port": "443", "lan": "false",
        }  # fmt: skip
        self.assertEqual(set(values), {str(row[0]) for row in Options.optParameters} - {"config"})
        Options().parseOptions([word for name, value in values.items() for word in (f"--{name}", value)])

    def test_names_become_addresses_once(self) -> None:
        """The host names of known nodes and of the simulator are resolved once, in the family of the node's address."""
        asked: list[tuple[str, int]] = []

        def look_up(host: str, port: int, family: int, type: int) -> Any:  # noqa: A002
            asked.append((host, family))
            return [(family, type, 17, "", ("10.9.8.7", port))]

        mapping = {
            "node": {"name": "a", "known_nodes": ["laptop.local:7000"], "roles": ["web"]},
            "web": {"yard": "yard.local:7400"},
        }
        settings = resolve_hosts(Settings.from_mapping(mapping, "x.toml"), look_up)
        self.assertEqual(settings.node.known_nodes, (Address("10.9.8.7", 7000),))
        self.assertEqual(settings.web.yard, Address("10.9.8.7", 7400))
        self.assertEqual(asked, [("laptop.local", socket.AF_INET), ("yard.local", socket.AF_UNSPEC)])
