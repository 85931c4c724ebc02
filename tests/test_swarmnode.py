"""Tests of the front door: options, wiring, a node that comes and goes, and a team that a seed replays."""

from __future__ import annotations

import contextlib
import io
import os
import random
import socket
import sqlite3
import subprocess
import sys
from pathlib import Path
from typing import Any

from twisted.application.service import Service
from twisted.internet import reactor
from twisted.logger import ILogObserver, LogEvent, formatEvent, globalLogPublisher
from twisted.trial.unittest import SynchronousTestCase
from zope.interface import implementer

import swarmnode
from middleware.entangled.clock import HeapClock
from middleware.entangled.errors import BadStore, PortInUse
from middleware.entangled.network.network import Address
from middleware.entangled.network.switchboard import Switchboard
from middleware.entangled.store import MemoryStore
from middleware.errors import BadSetting, MissingExtra, UnknownAgent
from middleware.node import SwarmNode
from middleware.settings import Settings
from rehearsal import VirtualTeam
from swarmnode import NodeService, Options, Seams, assembled, identity_in, makeService, resolved, told

ROOT = Path(__file__).resolve().parent.parent


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
        path = self.file('[node]\nname = "a"\nprot = 7\n')
        self.assert_says(self.refusal("--config", path), path, "[node] prot", "the nearest is port")

    def test_refuse_wrong_type(self) -> None:
        """A value of the wrong type is refused with file, key and what to write."""
        path = self.file('[node]\nname = "a"\nport = "high"\n')
        self.assert_says(self.refusal("--config", path), path, "[node] port", "write a number")

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
        self.assert_says(self.refusal("--name", "a", "--port", "70000"), "command line: --port", "0..65535")
        self.assert_says(self.refusal("--name", "a", "--known-nodes", "here"), "--known-nodes", "host:port")

    def test_refuse_unknown_agent(self) -> None:
        """An agent that does not exist is refused with those that do."""
        path = self.file('[node]\nname = "a"\n[driver]\nkind = "sim"\n[agent]\nmodule = "serch"\n')
        self.assert_says(self.refusal("--config", path, is_made=True), path, "[agent] module", "'serch'", "search")

    def test_refuse_agent_that_cannot_be_imported(self) -> None:
        """An agent of one's own that cannot be loaded says why."""
        path = self.file('[node]\nname = "a"\n[driver]\nkind = "sim"\n[agent]\nmodule = "no_such_module:Mind"\n')
        line = self.refusal("--config", path, is_made=True)
        self.assert_says(line, "[agent] module", "no_such_module")

    def test_refuse_unknown_driver(self) -> None:
        """A kind of robot that there is no driver for is refused with those that there are."""
        path = self.file('[node]\nname = "a"\n[driver]\nkind = "simm"\n')
        self.assert_says(self.refusal("--config", path, is_made=True), path, "[driver]", "'simm'", "known are sim")

    def test_refuse_wrong_driver_option(self) -> None:
        """A driver's option with a wrong value is refused with the option and what to write."""
        path = self.file('[node]\nname = "a"\n[driver]\nkind = "sim"\noptions = { port = "x" }\n')
        self.assert_says(self.refusal("--config", path, is_made=True), path, "[driver]", "port", "as in port = 7400")

    def test_refuse_foreign_store(self) -> None:
        """A SQLite file of another program is refused, named, and left as it was."""
        foreign = self.folder / "foreign.sqlite"
        with contextlib.closing(sqlite3.connect(foreign)) as connection:
            connection.execute("CREATE TABLE birds(name TEXT)")
        before = foreign.read_bytes()
        path = self.file('[node]\nname = "a"\nstore = "foreign.sqlite"\n')
        self.assert_says(self.refusal("--config", path, is_made=True), path, "[node] store", "foreign.sqlite")
        self.assertEqual(foreign.read_bytes(), before)

    def test_refuse_unreadable_store(self) -> None:
        """A store that is no SQLite file, or lies in no folder, is refused and named."""
        (self.folder / "text.sqlite").write_text("this is a letter " * 99, encoding="utf-8")
        for name in ("text.sqlite", "no/such/folder.sqlite"):
            path = self.file(f'[node]\nname = "a"\nstore = "{name}"\n')
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
        self.assertEqual(told(BadStore("two\nlines"), "a.toml"), "a.toml: [node] store: two lines")
        self.assertEqual(told(UnknownAgent("x"), ""), "[agent] module: x")


class OptionsTests(SynchronousTestCase):
    def test_flags_win_over_the_file(self) -> None:
        """A flag replaces what the file says, and leaves everything else."""
        path = Path(self.mktemp())
        path.write_text('[node]\nname = "a"\nport = 7001\nkind = "dog"\n', encoding="utf-8")
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

    def test_every_setting_of_a_flag_exists(self) -> None:
        """Each flag but the file's is a setting: all of them at once are accepted."""
        values = {
            "name": "a", "kind": "k", "host": "127.0.0.1", "port": "0", "known-nodes": "10.0.0.1:1",
            "store": "s.sqlite", "team-key": "t", "roles": "edge", "agent-module": "search", "driver-kind": "sim",
            "web-host": "127.0.0.1", "web-port": "0", "web-yard": "10.0.0.1:1",
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


class Page(Service):
    """A page that only counts."""

    def __init__(self, pages: list[Page]) -> None:
        pages.append(self)


class World:
    """A board, a clock and nodes on it."""

    def __init__(self) -> None:
        self.clock = HeapClock()
        self.board = Switchboard(self.clock, random.Random(1))
        self.pages: list[Page] = []

    def seams(self, name: str, port: int, store: MemoryStore | None = None) -> Seams:
        """The seams of one node."""
        return Seams(
            self.clock,
            lambda: self.board.network("127.0.0.1", port),
            MemoryStore() if store is None else store,
            random.Random(name),
            self.clock.seconds,
        )

    def service(self, name: str, port: int, is_web: bool = False) -> NodeService:
        """A node that joins through port 7000."""
        known = [] if port == 7000 else ["127.0.0.1:7000"]
        settings = Settings.from_mapping({"node": {"name": name, "port": port, "known_nodes": known}}, "test")
        return NodeService(settings, self.seams(name, port), [self.page] if is_web else [])

    def page(self, node: SwarmNode) -> Page:
        """The page of a node, which has to run."""
        assert node.running
        return Page(self.pages)


class AssemblyTests(SynchronousTestCase):
    def settings(self, **tables: Any) -> Settings:
        """Settings of a node called a."""
        return Settings.from_mapping({"node": {"name": "a", **tables.pop("node", {})}, **tables}, "test")

    def test_driver_brings_kind_and_capabilities(self) -> None:
        """A node with a driver is of the robot's kind and has its capabilities; what the settings say wins."""
        world = World()
        settings = self.settings(
            node={"capabilities": {"base2d": {"max": 1}, "horn": {}}},
            driver={"kind": "sim"},
            agent={"module": "search"},
        )
        made = assembled(settings, world.seams("a", 7000))
        device = made.node.presence.device
        self.assertEqual(device.kind, "aibo-ers7")
        self.assertEqual(device.capabilities["base2d"], {"max": 1})
        self.assertEqual(set(device.capabilities), {"base2d", "horn", "odometry", "ranger", "imu", "power", "camera"})
        self.assertIsNotNone(made.agent)

    def test_node_without_body_has_no_agent(self) -> None:
        """A laptop has neither driver nor agent, and its kind is what the settings say."""
        made = assembled(self.settings(node={"kind": "laptop"}), World().seams("a", 7000))
        self.assertEqual((made.agent, made.driver, made.node.presence.device.kind), (None, None, "laptop"))

    def test_identity_is_kept_in_the_store(self) -> None:
        """The store keeps the identity: whatever the dice say, a node is the same after a restart."""
        store = MemoryStore()
        first = identity_in(store, random.Random(1))
        self.assertEqual(identity_in(store, random.Random(2)).node_id, first.node_id)
        self.assertNotEqual(identity_in(MemoryStore(), random.Random(2)).node_id, first.node_id)

    def test_spoiled_identity_is_made_anew(self) -> None:
        """A note that is no seed does not keep the node from starting."""
        store = MemoryStore()
        store.note("identity", b"short")
        self.assertEqual(identity_in(store, random.Random(1)).node_id, identity_in(store, random.Random(1)).node_id)

    def test_lost_identity_is_said(self) -> None:
        """A node whose store was there before and has no identity any more says that it is a new one."""
        lines: list[str] = []

        @implementer(ILogObserver)
        def seen(event: LogEvent) -> None:
            lines.append(formatEvent(event))

        globalLogPublisher.addObserver(seen)
        self.addCleanup(globalLogPublisher.removeObserver, seen)
        store = MemoryStore()
        identity_in(store, random.Random(1))
        self.assertEqual(lines, [])
        lost = MemoryStore()
        lost.origin = "replaced"
        identity_in(lost, random.Random(1))
        self.assertIn("this node is a new one now", "".join(lines))


class NodeServiceTests(SynchronousTestCase):
    def setUp(self) -> None:
        self.world = World()
        self.first = self.world.service("a", 7000)
        self.second = self.world.service("b", 7001, is_web=True)
        for service in (self.first, self.second):
            service.startService()
            self.addCleanup(self.end, service)
        self.world.clock.advance(1.0)
        self.devices = self.first.assembly.node.watch_devices(lambda records: None)
        self.world.clock.advance(0.5)

    def end(self, service: NodeService) -> None:
        """Stop it if it runs."""
        if service.running:
            self.successResultOf(service.stopService())

    def seen(self) -> int:
        """How many devices the first node sees."""
        return len(self.devices.records)

    def test_service_leaves_in_order(self) -> None:
        """A node that is stopped says goodbye: it is gone before its lease is over, its store is closed."""
        self.assertEqual(self.seen(), 2)
        self.end(self.second)
        self.world.clock.advance(0.1)
        self.assertEqual(self.seen(), 1)
        self.assertFalse(self.world.pages[0].running)

    def test_service_vanishes_without_a_word(self) -> None:
        """A node whose power fails is believed in until its lease is over, and sends nothing any more."""
        self.second.vanish()
        self.world.clock.advance(0.3)
        sent = self.world.board.counters["unsent"]
        self.assertEqual(self.seen(), 2)
        self.world.clock.advance(1.2)
        self.assertEqual(self.seen(), 1)
        self.assertEqual(self.world.board.counters["unsent"], sent)

    def test_service_leaves_and_returns(self) -> None:
        """A node told to leave is gone with its page, and comes back with its identity and a page of its new self."""
        before = self.second.assembly.node
        self.second.leave(3.0)
        self.assertFalse(self.world.pages[0].running)
        self.world.clock.advance(2.5)
        self.assertEqual(self.seen(), 1)
        self.world.clock.advance(2.0)
        after = self.second.assembly.node
        self.assertEqual(self.seen(), 2)
        self.assertTrue(after is not before and after.uuid == before.uuid)
        self.assertEqual([page.running for page in self.world.pages], [0, 1])

    def test_second_wish_to_leave_changes_nothing(self) -> None:
        """Two wishes to leave, one shortly after the other, bring the node back once."""
        self.second.leave(2.0)
        self.second.leave(3.0)
        self.world.clock.advance(2.5)
        back = self.second.assembly.node
        self.world.clock.advance(3.0)
        self.assertIs(self.second.assembly.node, back)
        self.assertEqual(self.seen(), 2)

    def test_stopped_while_away_stays_away(self) -> None:
        """A node that is stopped while it is away does not come back."""
        self.second.leave(2.0)
        self.end(self.second)
        self.world.clock.advance(5.0)
        self.assertEqual(self.seen(), 1)
        self.assertFalse(self.second.assembly.node.running)

    def test_port_taken_meanwhile_is_tried_again(self) -> None:
        """A node whose port was taken while it was away tries again until it is free."""
        self.second.leave(1.0)
        squatter = self.world.board.network("127.0.0.1", 7001)
        squatter.listen(lambda datagram, source: None)
        self.world.clock.advance(2.0)
        self.assertFalse(self.second.assembly.node.running)
        squatter.close()
        self.world.clock.advance(4.0)
        self.assertEqual(self.seen(), 2)

    def test_port_in_use_flies_at_the_start(self) -> None:
        """A node whose port another holds does not start, and says so to its caller."""
        third = self.world.service("c", 7001)
        self.assertRaises(PortInUse, third.startService)


class WebRoleTests(SynchronousTestCase):
    def test_web_role_without_flask_names_the_extra(self) -> None:
        """Where Flask is not installed the web role is refused with the command that installs it."""
        hidden = {
            name: sys.modules.pop(name) for name in list(sys.modules) if name.split(".")[0] in ("flask", "webnode")
        }
        sys.modules["flask"] = None  # type: ignore[assignment]

        def restore() -> None:
            for name in [name for name in sys.modules if name.split(".")[0] in ("flask", "webnode")]:
                del sys.modules[name]
            sys.modules.update(hidden)

        self.addCleanup(restore)
        world = World()
        service = world.service("a", 7000)
        settings, seams = service.settings, world.seams("a", 7000)
        error = self.assertRaises(MissingExtra, swarmnode.web_page, settings, seams, reactor, service.assembly.node)
        self.assertEqual(
            told(error, "x.toml"),
            "x.toml: [node] roles: the web role needs more than the bare node; "
            "install it by: pip install 'swarm-node[web]'",
        )


RUN = """
from rehearsal import VirtualTeam
team = VirtualTeam(7)
team.run_demo()
team.clock.advance(12.0)
print(team.board.digest())
"""


class ReplayTests(SynchronousTestCase):
    def digest(self, seed: int, seconds: float) -> str:
        """The trace of a team's run."""
        team = VirtualTeam(seed)
        team.run_demo()
        team.clock.advance(seconds)
        team.stop()
        return team.board.digest()

    def test_seed_replays_a_team_exactly(self) -> None:
        """Two runs of one seed exchange the same datagrams at the same moments; another seed gives another run."""
        self.assertEqual(self.digest(5, 8.0), self.digest(5, 8.0))
        self.assertNotEqual(self.digest(5, 1.0), self.digest(6, 1.0))

    def test_order_of_sets_does_not_matter(self) -> None:
        """The hash seed of the interpreter changes nothing: two processes with different ones give the same trace."""
        digests = set()
        for hash_seed in ("1", "4242"):
            environment = {**os.environ, "PYTHONHASHSEED": hash_seed}
            command = [sys.executable, "-c", RUN]
            child = subprocess.run(command, cwd=ROOT, env=environment, capture_output=True, text=True, timeout=120)
            self.assertEqual(child.returncode, 0, child.stderr)
            digests.add(child.stdout.strip())
        self.assertEqual(len(digests), 1)
        self.assertEqual(len(digests.pop()), 64)
