"""Tests of the demonstration: configurations, log lines, results of experiments, and the event stream."""

from __future__ import annotations

import contextlib
import io
import re
import socket
import tomllib
from dataclasses import replace
from pathlib import Path
from typing import Any

from twisted.trial.unittest import SynchronousTestCase

from drivers.registry import describe
from sim.demo import free_ports, preparation
from sim.demo.configuration import DOGS, Plan
from sim.demo.demonstration import main
from sim.demo.experiment import LIMIT_S, Experiment, format_table, make_report, measure_distances
from sim.demo.page_client import MAX_EVENT_BYTES, EventParser
from sim.demo.preparation import MARKER_FILE, DemoError, lock_run_dir, make_plan
from sim.demo.robots import MAX_PORTS, ROBOT_SETS, make_robots
from sim.demo.state_changes import describe_changes, find_present

TASK = "t1"


def snapshot(*xs: float, moving: str = "", target: bool = True) -> dict[str, Any]:
    """Return a snapshot of the simulator with dog1, dog2, ... at ``(x, 0)`` and the target at the origin."""
    dogs = [
        {"name": f"dog{number}", "x": x, "y": 0.0, "heading": 0.0, "moving": f"dog{number}" == moving}
        for number, x in enumerate(xs, 1)
    ]
    return {"t": 0.0, "dogs": dogs, "target": {"x": 0.0, "y": 0.0, "radius": 0.08} if target else None}


def state(task: str, by: str = "", gone: float | None = None, **statuses: str) -> dict[str, Any]:
    """Return the page's state: task status, finishing agent, and the status and time of loss of each dog."""
    return {
        "devices": [
            {"uuid": name, "name": name, "status": status, "task": TASK, "gone": gone}
            for name, status in statuses.items()
        ],
        "tasks": [{"id": TASK, "title": "Find", "status": task, "result": {"by": by, "took": 9.0} if by else None}],
        "groups": [],
    }


RUNS = state("EXECUTING", dog1="EXECUTING", dog2="WAITING")


class ExperimentTests(SynchronousTestCase):
    """The result of an experiment depends on the positions of the dogs."""

    def test_verdicts(self) -> None:
        """An experiment passes if the nearest dog reaches the target.

        It fails if the task fails, if the dog that finishes is not at the target or is not the nearest dog, and, in
        experiment 2, if no dog was lost or the lost dog finishes.
        """
        wrong = state("EXECUTING", dog2="EXECUTING")
        for kills, looks, held, words in (
            (False, [(RUNS, (1.0, 1.5)), (state("COMPLETED", "dog1"), (0.30, 1.5))], True, "(gap 0.10 m)"),
            (False, [(RUNS, (1.0, 1.5)), (state("COMPLETED", "dog1"), (0.80, 1.5))], False, "(gap 0.60 m)"),
            (False, [(wrong, (1.0, 1.5)), (state("COMPLETED", "dog2"), (1.0, 0.25))], False, "nearest: dog1"),
            (False, [(state("FAILED"), (1.0,))], False, "task completed (FAILED)"),
            (True, [(RUNS, (1.0, 1.5)), (state("COMPLETED", "dog1"), (0.25, 1.5))], False, "nobody was lost"),
            (True, [(RUNS, (1.0,)), (RUNS, (0.8,)), (state("COMPLETED", "dog1"), (0.3,))], False, "NO   dog1 finished"),
        ):
            run = Experiment("one", TASK, kills, 0.0)
            for now, (seen, xs) in enumerate(looks):
                run.update(float(now), seen, snapshot(*xs))
            said, (row,) = format_table([run]), make_report([run])
            self.assertTrue(run.is_over)
            self.assertEqual((run.has_passed, row["held"], words in said), (held, held, True), said)
            self.assertEqual(list(row["checks"].values()), [check.is_met for check in run.list_checks()])

    def test_who_is_killed(self) -> None:
        """``update`` returns the dog to kill: once, when the moving dog has walked 0.1 m or half of its way.

        In experiment 1, and if the moving dog has left, ``update`` returns no dog.
        """
        gone = state("EXECUTING", gone=1.0, dog1="EXECUTING")
        for kills, seen, ways, named in (
            (True, RUNS, (1.05, 1.0, 0.94, 0.85), ["", "", "dog1", ""]),
            (True, RUNS, (0.45, 0.43, 0.39), ["", "", "dog1"]),
            (True, gone, (1.0, 0.5), ["", ""]),
            (False, RUNS, (1.0, 0.4), ["", ""]),
        ):
            run = Experiment("two", TASK, kills, 0.0)
            self.assertEqual([run.update(float(now), seen, snapshot(x, 1.5)) for now, x in enumerate(ways)], named)

    def test_takeover_is_timed_until_another_dog_moves(self) -> None:
        """The takeover lasts from the kill until a different dog executes and moves.

        Motion of the killed dog is ignored.
        """
        run = Experiment("two", TASK, True, 0.0)
        run.update(0.0, RUNS, snapshot(1.0, 1.5))
        self.assertEqual(run.update(1.0, RUNS, snapshot(0.8, 1.5)), "dog1")
        run.update(1.5, RUNS, snapshot(0.8, 1.5, moving="dog1"))
        taken = state("EXECUTING", dog1="EXECUTING", dog2="EXECUTING")
        run.update(2.0, taken, snapshot(0.8, 1.5))
        self.assertIsNone(run.takeover_s)
        run.update(2.25, taken, snapshot(0.8, 1.5, moving="dog2"))
        self.assertAlmostEqual(run.takeover_s or 0.0, 1.25)
        run.update(9.0, state("COMPLETED", "dog2", dog2="DONE"), snapshot(0.8, 0.3))
        self.assertTrue(run.has_passed, format_table([run]))

    def test_experiment_ends_when_time_is_up(self) -> None:
        """An experiment ends at its time limit, and its table shows the last status of the task."""
        run = Experiment("one", TASK, False, 0.0)
        run.update(LIMIT_S - 1, state("OPEN"), None)
        self.assertFalse(run.is_over)
        run.update(LIMIT_S + 1, state("OPEN"), None)
        self.assertTrue(run.is_over)
        self.assertIn("out of time, task OPEN", format_table([run]))

    def test_distances_need_a_target(self) -> None:
        """Without a target, or without a snapshot, there are no distances."""
        self.assertEqual(measure_distances(snapshot(1.0, target=False)), {})
        self.assertEqual(measure_distances(None), {})
        self.assertEqual(measure_distances(snapshot(-2.0)), {"dog1": 2.0})


class StateChangesTests(SynchronousTestCase):
    """Log lines describe the differences between two states of the page."""

    def test_told(self) -> None:
        """Each join, status change, loss, return, task result and agreement is logged once."""
        idle, busy = state("OPEN", dog1="IDLE"), state("OPEN", dog1="SEARCHING")
        gone = state("OPEN", gone=3.0, dog1="GONE")
        agreed = state("OPEN")
        members = [{"name": "dog1", "cost": 0.5}, {"name": "dog2", "cost": None}]
        agreed["groups"] = [{"task": TASK, "members": members, "assigned": "dog1", "agree": 2, "of": 2}]
        done = "task 'Find': EXECUTING -> COMPLETED by dog2 in 9.0 s"
        for before, after, lines in (
            ({}, idle, ["dog1 joined", "task 'Find': OPEN"]),
            (idle, busy, ["dog1: IDLE -> SEARCHING"]),
            (busy, busy, []),
            (busy, gone, ["dog1 is gone"]),
            (gone, state("OPEN"), []),
            (gone, idle, ["dog1 is back"]),
            (state("EXECUTING"), state("COMPLETED", "dog2"), [done]),
            (state("OPEN"), agreed, ["2 of 2 agree on dog1 (dog1 0.50 m)"]),
            (agreed, agreed, []),
        ):
            self.assertEqual(describe_changes(before, after), lines)
        self.assertEqual(list(find_present(state("OPEN", dog1="IDLE", dog2="GONE"))), ["dog1"])


class ConfigurationTests(SynchronousTestCase):
    """The configurations are valid TOML and contain the planned values."""

    def setUp(self) -> None:
        ports = {"vaio": 7000, "pi": 7004, "dog1": 7001, "dog2": 7002, "dog3": 7003}
        folder = Path('/tmp/a "strange"\\folder\x7f')
        self.plan = Plan(folder, "127.0.0.1", 8080, 7400, ports, "quiet-otter", 8081)
        self.plan = replace(self.plan, robots=make_robots("sim", DOGS, folder, iter(()), 7400))
        self.tables = self.read(self.plan)

    def read(self, plan: Plan) -> dict[str, Any]:
        """Parse the configuration of each node."""
        return {name: tomllib.loads(text) for name, text in plan.make_configs().items()}

    def test_every_node_has_a_file_in_lawful_toml(self) -> None:
        """Each of two web nodes and three dogs has its own ports, store and robot, and knows the first node."""
        self.assertEqual(list(self.tables), ["vaio", "pi", *DOGS])
        nodes = [table["node"] for table in self.tables.values()]
        self.assertEqual([node["port"] for node in nodes], [7000, 7004, 7001, 7002, 7003])
        folder = self.plan.run_dir
        for name, node in zip(self.tables, nodes, strict=True):
            self.assertEqual(node["store"], str(folder / f"{name}.sqlite"))
            self.assertEqual(node["membership"], str(folder / f"{name}.membership"))
            self.assertEqual(node["known_nodes"], [] if name == "vaio" else ["127.0.0.1:7000"])
        dog = self.tables["dog2"]
        self.assertEqual(dog["agent"], {"module": "search"})
        self.assertEqual((dog["driver"]["kind"], dog["driver"]["options"]["robot"]), ("sim", "dog2"))

    def test_every_node_is_a_member(self) -> None:
        """The arguments of ``swarm init`` list each node that has a file; no configuration contains a team key."""
        words = self.plan.make_init_arguments()
        members = [word.partition("=")[0] for flag, word in zip(words, words[1:], strict=False) if flag == "--member"]
        self.assertEqual([words[words.index("--first") + 1], *members], list(self.tables))
        self.assertNotIn("team_key", str(self.tables))

    def test_every_cast_is_known_to_its_drivers(self) -> None:
        """For each value of ROBOT the emulators match the drivers, and all ports differ.

        One Aibo speaks the older dialect.
        """
        self.assertEqual(self.plan.emulated_robots, "")
        for wish in ROBOT_SETS:
            ports = iter(range(9000, 9000 + MAX_PORTS * len(DOGS)))
            plan = replace(self.plan, robots=make_robots(wish, DOGS, self.plan.run_dir, ports, 7400))
            tables, played = self.read(plan), tomllib.loads(plan.emulated_robots)
            for name, robot in plan.robots.items():
                self.assertEqual(tables[name]["node"]["kind"], robot.model)
                self.assertEqual(
                    {**tables[name]["driver"], **robot.emulator_options}, played.get(name, robot.driver_table)
                )
                parts = [(part["kind"], part["options"]) for part in robot.parts]
                capabilities = describe(robot.kind, robot.options, name, parts).capabilities
                self.assertLessEqual({"base2d", "odometry", "camera"}, set(capabilities), wish)
            taken = re.findall(r"\b90\d\d\b", str([tables[name]["driver"] for name in DOGS]))
            self.assertEqual(len(taken), len(set(taken)))
            dialects = [robot.simulator_table.get("dialect") for robot in plan.robots.values()]
            self.assertEqual(dialects, [None, None, "T2" if wish == "aibo" else None])

    def test_two_nodes_serve_the_page(self) -> None:
        """Both web nodes serve the page and the map on their own ports, and over TLS if the plan has ports for TLS."""
        web = {"host": "127.0.0.1", "port": 8080, "yard": "127.0.0.1:7400", "code": "quiet-otter"}
        secure = self.read(replace(self.plan, tls_ports=(8443, 8444)))
        for name, wanted, tls_port in (("vaio", web, 8443), ("pi", {**web, "port": 8081}, 8444)):
            self.assertEqual(set(self.tables[name]), {"node", "web", "faults"})
            self.assertEqual(self.tables[name]["web"], wanted)
            self.assertEqual(secure[name]["web"], {**wanted, "tls": "auto", "tls_port": tls_port})
        self.assertEqual(secure["dog1"], self.tables["dog1"])


class EventStreamTests(SynchronousTestCase):
    """``EventParser`` parses server-sent events."""

    WIRE = b'event: state\r\ndata: {"a":\r\ndata: 1}\r\n\r\n: heartbeat\n\nevent: other\ndata:x\n\ndata: y\n\n'

    def test_events_survive_any_cut(self) -> None:
        """The parser finds the same events in the whole input and byte by byte, and ignores comments."""
        wanted = [("state", b'{"a":\n1}'), ("other", b"x"), ("message", b"y")]
        self.assertEqual(EventParser().feed(self.WIRE), wanted)
        stream = EventParser()
        pieces = [event for byte in self.WIRE for event in stream.feed(bytes([byte]))]
        self.assertEqual(pieces, wanted)

    def test_endless_line_is_dropped(self) -> None:
        """The parser drops a line that does not end, and parses the events after it."""
        stream = EventParser()
        stream.feed(b"data: " + b"x" * (MAX_EVENT_BYTES + 1))
        self.assertEqual(stream.feed(b"\n\ndata: y\n\n"), [("message", b"y")])


class PreparationTests(SynchronousTestCase):
    """Ports are free, and only run folders of the demonstration are emptied."""

    def setUp(self) -> None:
        self.folder = Path(self.mktemp())

    def test_ports_of_one_plan_differ(self) -> None:
        """The port requested for the page is not used for the page over TLS as well."""
        (wanted,) = free_ports.find_free_ports("tcp", "127.0.0.1", 1)
        self.patch(preparation, "TLS_PORT", wanted)
        plan = make_plan(self.folder, "127.0.0.1", wanted, True, lambda line: None, True)
        ports = [plan.web_port, plan.reserve_port, *plan.tls_ports, plan.simulator_port]
        self.assertEqual((plan.web_port, len(set(ports))), (wanted, 5))

    def test_free_ports_stay_free(self) -> None:
        """Free ports lie below the range for outgoing connections, so another process does not get one at random."""
        lowest_given = 32_768
        for kind in ("tcp", "udp", free_ports.TCP_AND_UDP):
            ports = free_ports.find_free_ports(kind, "127.0.0.1", 20)
            self.assertEqual(len(set(ports)), 20)
            self.assertLess(max(ports), lowest_given)

    def test_ports_are_free_for_both_kinds(self) -> None:
        """A port is skipped if it is in use for TCP or for UDP."""
        first, last = free_ports.find_free_ports(free_ports.TCP_AND_UDP, "127.0.0.1", 2)
        self.patch(free_ports, "PORT_RANGE", [first, last])
        for kind in (socket.SOCK_STREAM, socket.SOCK_DGRAM):
            with socket.socket(socket.AF_INET, kind) as held:
                held.bind(("127.0.0.1", first))
                if kind == socket.SOCK_STREAM:
                    held.listen(1)
                self.assertEqual(free_ports.find_free_ports(free_ports.TCP_AND_UDP, "127.0.0.1", 1), [last])
                self.assertRaises(OSError, free_ports.find_free_ports, free_ports.TCP_AND_UDP, "127.0.0.1", 2)

    def test_only_a_free_folder_of_ours_is_emptied(self) -> None:
        """The folder of an earlier demonstration is emptied.

        A folder with other files, or in use, remains unchanged.
        """
        lock_run_dir(self.folder).close()
        (self.folder / "dog1.sqlite").write_text("old")
        (self.folder / "inner").mkdir()
        with lock_run_dir(self.folder):
            self.assertEqual([entry.name for entry in self.folder.iterdir()], [MARKER_FILE])
            self.assertNotIn("\n", str(self.assertRaises(DemoError, lock_run_dir, self.folder)))
        (self.folder / MARKER_FILE).rename(self.folder / "thesis.txt")
        self.assertRaises(DemoError, lock_run_dir, self.folder)
        self.assertTrue((self.folder / "thesis.txt").exists())

    def test_what_is_no_folder_is_refused(self) -> None:
        """If the folder or its parent is a file, the path is rejected with a remedy."""
        self.folder.write_text("mine")
        for folder in (self.folder, self.folder / "inner"):
            said = str(self.assertRaises(DemoError, lock_run_dir, folder))
            self.assertTrue(said.startswith(f"cannot use {folder} ("), said)
            self.assertIn("choose another --run-dir", said)

    def test_foreign_address_is_refused(self) -> None:
        """The error for an address of another machine suggests ``--web-host``, and does not report a busy port."""
        for wanted in (None, 8080):
            error = self.assertRaises(DemoError, make_plan, self.folder, "192.0.2.1", wanted, True, lambda line: None)
            self.assertRegex(str(error), r"cannot serve the page on 192\.0\.2\.1 \(.*\); set --web-host")


class CommandLineTests(SynchronousTestCase):
    def test_wrong_words_are_refused(self) -> None:
        """An unknown option, an invalid port, and a report path in a missing folder are rejected before the start."""
        for words, said in (
            (["--nonsense"], "unrecognized arguments: --nonsense"),
            (["--web-port", "99999"], "--web-port: must be 0 to 65535, is '99999'"),
            (["--web-port", "-1"], "--web-port: must be 0 to 65535, is '-1'"),
            (["--headless", "--report", "/nowhere/x.json"], "--report /nowhere/x.json: no such folder; create"),
        ):
            errors = io.StringIO()
            with contextlib.redirect_stderr(errors):
                self.assertEqual(self.assertRaises(SystemExit, main, words).code, 2)
            self.assertIn(said, errors.getvalue())
