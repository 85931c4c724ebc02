"""Tests of the demonstration: configurations, the story, the judgement of an experiment, and the event stream."""

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
from sim.demo import port, stage
from sim.demo.cast import CASTS, MOST_PORTS, chosen
from sim.demo.configuration import DOGS, Plan
from sim.demo.demonstration import main
from sim.demo.experiment import LIMIT_S, Experiment, report, table, to_target
from sim.demo.stage import MARK, Trouble, arranged, fresh
from sim.demo.story import present, told
from sim.demo.visitor import MAX_EVENT, EventStream

TASK = "t1"


def snapshot(*xs: float, moving: str = "", target: bool = True) -> dict[str, Any]:
    """The yard with dog1, dog2, ... at ``(x, 0)`` and the target at the origin."""
    dogs = [
        {"name": f"dog{number}", "x": x, "y": 0.0, "heading": 0.0, "moving": f"dog{number}" == moving}
        for number, x in enumerate(xs, 1)
    ]
    return {"t": 0.0, "dogs": dogs, "target": {"x": 0.0, "y": 0.0, "radius": 0.08} if target else None}


def state(task: str, by: str = "", **statuses: str) -> dict[str, Any]:
    """What the page says: the task's status, who finished, and the status of each dog."""
    return {
        "devices": [
            {"uuid": name, "name": name, "status": status, "task": TASK, "gone": None}
            for name, status in statuses.items()
        ],
        "tasks": [{"id": TASK, "title": "Find", "status": task, "result": {"by": by, "took": 9.0} if by else None}],
        "groups": [],
    }


class ExperimentTests(SynchronousTestCase):
    """An experiment is judged by where the dogs are."""

    def setUp(self) -> None:
        self.first = Experiment("one", TASK, kills=False, started=0.0)
        self.second = Experiment("two", TASK, kills=True, started=0.0)

    def test_nearest_dog_at_the_target_passes(self) -> None:
        """The nearest executes and stands at the target when the task is completed: all checks hold."""
        self.first.look(5.0, state("EXECUTING", dog1="EXECUTING", dog2="WAITING"), snapshot(1.0, 1.5))
        self.first.look(9.0, state("COMPLETED", "dog1", dog1="DONE"), snapshot(0.30, 1.5))
        self.assertTrue(self.first.held, table([self.first]))
        self.assertAlmostEqual(self.first.gap_m or 0.0, 0.10)

    def test_wrong_dog_fails(self) -> None:
        """A dog that was not the nearest when they decided fails the experiment, though it reached the target."""
        self.first.look(5.0, state("EXECUTING", dog2="EXECUTING"), snapshot(1.0, 1.5))
        self.first.look(9.0, state("COMPLETED", "dog2"), snapshot(1.0, 0.25))
        self.assertFalse(self.first.held)
        self.assertIn("nearest: dog1", table([self.first]))

    def test_claim_without_reaching_the_target_fails(self) -> None:
        """A task said to be completed by a dog that is far away fails."""
        self.first.look(5.0, state("EXECUTING", dog1="EXECUTING"), snapshot(1.0, 1.5))
        self.first.look(9.0, state("COMPLETED", "dog1"), snapshot(0.8, 1.5))
        self.assertFalse(self.first.held)

    def test_nobody_is_killed_in_the_first_experiment(self) -> None:
        """Without ``kills`` no dog is named, however near it comes."""
        self.first.look(5.0, state("EXECUTING", dog1="EXECUTING"), snapshot(1.0, 1.5))
        self.assertEqual(self.first.look(6.0, state("EXECUTING", dog1="EXECUTING"), snapshot(0.4, 1.5)), "")

    def test_dog_is_killed_once_and_on_its_way(self) -> None:
        """The dog is named when it has come 0.1 m nearer, not before, and only once."""
        running = state("EXECUTING", dog1="EXECUTING", dog2="WAITING")
        named = [self.second.look(x, running, snapshot(1.05 - x, 1.5)) for x in (0.0, 0.05, 0.11, 0.2)]
        self.assertEqual(named, ["", "", "dog1", ""])

    def test_dog_with_a_short_way_is_killed_half_way(self) -> None:
        """A dog that has less than 0.2 m to go is named when it has gone half of that, before it is there."""
        running = state("EXECUTING", dog1="EXECUTING", dog2="WAITING")
        named = [self.second.look(float(n), running, snapshot(x, 1.5)) for n, x in enumerate((0.45, 0.43, 0.39))]
        self.assertEqual(named, ["", "", "dog1"])

    def test_takeover_is_timed_until_another_dog_moves(self) -> None:
        """The takeover lasts from the kill until another dog executes and moves; the lost one no longer counts."""
        running = state("EXECUTING", dog1="EXECUTING", dog2="WAITING")
        self.second.look(0.0, running, snapshot(1.0, 1.5))
        self.assertEqual(self.second.look(1.0, running, snapshot(0.8, 1.5)), "dog1")
        self.second.look(1.5, running, snapshot(0.8, 1.5, moving="dog1"))
        taken = state("EXECUTING", dog1="EXECUTING", dog2="EXECUTING")
        self.second.look(2.0, taken, snapshot(0.8, 1.5))
        self.assertIsNone(self.second.takeover_s)
        self.second.look(2.25, taken, snapshot(0.8, 1.5, moving="dog2"))
        self.assertAlmostEqual(self.second.takeover_s or 0.0, 1.25)
        self.second.look(9.0, state("COMPLETED", "dog2", dog2="DONE"), snapshot(0.8, 0.3))
        self.assertTrue(self.second.held, table([self.second]))

    def test_second_experiment_without_a_loss_fails(self) -> None:
        """A task completed before any dog was lost proves nothing, and fails."""
        self.second.look(0.0, state("EXECUTING", dog1="EXECUTING"), snapshot(1.0, 1.5))
        self.second.look(1.0, state("COMPLETED", "dog1"), snapshot(0.25, 1.5))
        self.assertFalse(self.second.held)
        self.assertIn("nobody was lost", table([self.second]))

    def test_lost_dog_that_finishes_fails(self) -> None:
        """A result in the name of the dog that was killed is no takeover."""
        running = state("EXECUTING", dog1="EXECUTING")
        self.second.look(0.0, running, snapshot(1.0, 1.5))
        self.second.look(1.0, running, snapshot(0.8, 1.5))
        self.second.look(2.0, state("COMPLETED", "dog1"), snapshot(0.3, 1.5))
        self.assertFalse(self.second.held)

    def test_gone_dog_does_not_execute(self) -> None:
        """A device that the page shows as gone is not taken for the one that executes."""
        gone = state("EXECUTING", dog1="EXECUTING")
        gone["devices"][0]["gone"] = 1.0
        self.second.look(0.0, gone, snapshot(1.0))
        self.assertEqual(self.second.look(1.0, gone, snapshot(0.5)), "")

    def test_experiment_ends_when_time_is_up(self) -> None:
        """A task that never ends is over after the limit, and fails with its status in words."""
        self.first.look(LIMIT_S - 1, state("OPEN"), None)
        self.assertFalse(self.first.is_over)
        self.first.look(LIMIT_S + 1, state("OPEN"), None)
        self.assertTrue(self.first.is_over)
        self.assertIn("out of time, task OPEN", table([self.first]))

    def test_failed_task_fails(self) -> None:
        """A task that failed ends the experiment, which fails."""
        self.first.look(1.0, state("FAILED"), snapshot(1.0))
        self.assertTrue(self.first.is_over)
        self.assertFalse(self.first.held)

    def test_report_says_the_same_as_the_table(self) -> None:
        """The report for programs has each check of the table with its truth."""
        self.first.look(1.0, state("FAILED"), snapshot(1.0))
        (row,) = report([self.first])
        self.assertFalse(row["held"])
        self.assertEqual(list(row["checks"].values()), [check.held for check in self.first.checks()])

    def test_distances_need_a_target(self) -> None:
        """Without a target, or without a snapshot, there are no distances."""
        self.assertEqual(to_target(snapshot(1.0, target=False)), {})
        self.assertEqual(to_target(None), {})
        self.assertEqual(to_target(snapshot(-2.0)), {"dog1": 2.0})


class StoryTests(SynchronousTestCase):
    """What changed is told in words."""

    def test_devices_join_change_leave_and_return(self) -> None:
        """A device is told when it joins, changes its status, goes, and comes back; nothing is told twice."""
        idle, busy = state("OPEN", dog1="IDLE"), state("OPEN", dog1="SEARCHING")
        gone = state("OPEN", dog1="GONE")
        gone["devices"][0]["gone"] = 3.0
        self.assertIn("dog1 joined", told({}, idle))
        self.assertEqual(told(idle, busy), ["dog1: IDLE -> SEARCHING"])
        self.assertEqual(told(busy, busy), [])
        self.assertEqual(told(busy, gone), ["dog1 is gone"])
        self.assertEqual(told(gone, state("OPEN")), [])
        self.assertEqual(told(gone, idle), ["dog1 is back"])

    def test_task_is_told_with_its_result(self) -> None:
        """A task's end names who did it, and how long it took."""
        self.assertEqual(
            told(state("EXECUTING"), state("COMPLETED", "dog2")),
            ["task 'Find': EXECUTING -> COMPLETED by dog2 in 9.0 s"],
        )

    def test_consensus_is_told_with_the_bids(self) -> None:
        """A group's consensus point is told with the bids that led to it, once."""
        after = state("OPEN")
        members = [{"name": "dog1", "cost": 0.5}, {"name": "dog2", "cost": None}]
        after["groups"] = [{"task": TASK, "members": members, "assigned": "dog1", "agree": 2, "of": 2}]
        self.assertEqual(told(state("OPEN"), after), ["2 of 2 agree on dog1 (dog1 0.50 m)"])
        self.assertEqual(told(after, after), [])

    def test_present_leaves_out_the_gone(self) -> None:
        """Only devices that are there count as present."""
        both = state("OPEN", dog1="IDLE", dog2="GONE")
        self.assertEqual(list(present(both)), ["dog1"])


class ConfigurationTests(SynchronousTestCase):
    """The configurations are TOML that says what was planned."""

    def setUp(self) -> None:
        ports = {"vaio": 7000, "pi": 7004, "dog1": 7001, "dog2": 7002, "dog3": 7003}
        folder = Path('/tmp/a "strange"\\folder\x7f')
        self.plan = Plan(folder, "127.0.0.1", 8080, 7400, ports, "quiet-otter", 8081)
        self.plan = replace(self.plan, robots=chosen("sim", DOGS, folder, iter(()), 7400))
        self.tables = {name: tomllib.loads(text) for name, text in self.plan.texts().items()}

    def test_every_node_has_a_file_in_lawful_toml(self) -> None:
        """Two web nodes and three dogs, each with its own port and store, whatever the folder is called."""
        self.assertEqual(list(self.tables), ["vaio", "pi", *DOGS])
        nodes = [table["node"] for table in self.tables.values()]
        self.assertEqual([node["port"] for node in nodes], [7000, 7004, 7001, 7002, 7003])
        self.assertEqual(nodes[1]["store"], str(self.plan.run_dir / "pi.sqlite"))
        folder = self.plan.run_dir
        self.assertEqual([node["membership"] for node in nodes], [str(folder / f"{n}.membership") for n in self.tables])

    def test_every_node_is_a_member(self) -> None:
        """What the team is founded with names each node that has a file, and no key of an open team."""
        words = self.plan.founding()
        members = [word.partition("=")[0] for flag, word in zip(words, words[1:], strict=False) if flag == "--member"]
        self.assertEqual([words[words.index("--first") + 1], *members], list(self.tables))
        self.assertNotIn("team_key", str(self.tables))

    def test_dogs_know_the_laptop_and_drive_themselves(self) -> None:
        """A dog knows the bootstrap node only, and its driver asks for the robot of its own name."""
        dog = self.tables["dog2"]
        self.assertEqual(dog["node"]["known_nodes"], ["127.0.0.1:7000"])
        self.assertEqual(dog["agent"], {"module": "search"})
        self.assertEqual((dog["driver"]["kind"], dog["driver"]["options"]["robot"]), ("sim", "dog2"))

    def test_cast(self) -> None:
        """Each dog's driver is told of the robot that the yard plays; without robots of other kinds it plays none."""
        self.assertEqual(self.plan.played, "")
        robots = chosen("mixed", DOGS, self.plan.run_dir, iter(range(9000, 9100)), 7400)
        plan = replace(self.plan, robots=robots)
        drivers = {name: tomllib.loads(plan.texts()[name])["driver"] for name in DOGS}
        self.assertEqual([table["kind"] for table in drivers.values()], ["aibo", "create2", "bittle"])
        played = tomllib.loads(plan.played)
        self.assertEqual(played, drivers)
        models = [tomllib.loads(plan.texts()[name])["node"]["kind"] for name in DOGS]
        self.assertEqual(models, ["AIBO ERS-7", "iRobot Create 2", "Petoi Bittle"])
        taken = [n for table in drivers.values() for n in re.findall(r"\b90\d\d\b", str(table))]
        self.assertEqual(len(taken), len(set(taken)))

    def test_every_cast_is_known_to_its_drivers(self) -> None:
        """Whatever the three are, the drivers take their options, and the older Tekkotsu is among the dogs."""
        for wish in CASTS:
            robots = chosen(wish, DOGS, self.plan.run_dir, iter(range(9000, 9000 + MOST_PORTS * len(DOGS))), 7400)
            for name, robot in robots.items():
                parts = [(part["kind"], part["options"]) for part in robot.parts]
                capabilities = describe(robot.kind, robot.options, name, parts).capabilities
                self.assertLessEqual({"base2d", "odometry", "camera"}, set(capabilities), wish)
        dogs = chosen("aibo", DOGS, self.plan.run_dir, iter(range(9000, 9100)), 7400)
        self.assertEqual([dog.played.get("dialect") for dog in dogs.values()], [None, None, "T2"])

    def test_laptop_has_the_page_and_no_driver(self) -> None:
        """The laptop serves the page over the yard, and has neither agent nor driver."""
        web = {"host": "127.0.0.1", "port": 8080, "yard": "127.0.0.1:7400", "code": "quiet-otter"}
        self.assertEqual(self.tables["vaio"]["web"], web)
        self.assertEqual(set(self.tables["vaio"]), {"node", "web", "faults"})

    def test_page_has_a_reserve(self) -> None:
        """A second web node serves the page of the same yard at a port of its own, with the same code."""
        self.assertEqual(self.tables["pi"]["web"], {**self.tables["vaio"]["web"], "port": 8081})
        self.assertEqual(
            (self.tables["pi"]["node"]["roles"], set(self.tables["pi"])), (["edge", "web"], {"node", "web", "faults"})
        )

    def test_page_over_tls(self) -> None:
        """Where it was planned, each web node serves the page over TLS at a port of its own, and no dog does."""
        texts = replace(self.plan, tls_ports=(8443, 8444)).texts()
        tables = {name: tomllib.loads(text) for name, text in texts.items()}
        self.assertEqual(tables["vaio"]["web"], {**self.tables["vaio"]["web"], "tls": "auto", "tls_port": 8443})
        self.assertEqual(tables["pi"]["web"]["tls_port"], 8444)
        self.assertEqual(tables["dog1"], self.tables["dog1"])


class EventStreamTests(SynchronousTestCase):
    """Server-sent events come out of bytes."""

    WIRE = b'event: state\r\ndata: {"a":\r\ndata: 1}\r\n\r\n: heartbeat\n\nevent: other\ndata:x\n\ndata: y\n\n'

    def test_events_survive_any_cut(self) -> None:
        """The same events come out whole and byte by byte; comments are none."""
        wanted = [("state", b'{"a":\n1}'), ("other", b"x"), ("message", b"y")]
        self.assertEqual(EventStream().feed(self.WIRE), wanted)
        stream = EventStream()
        pieces = [event for byte in self.WIRE for event in stream.feed(bytes([byte]))]
        self.assertEqual(pieces, wanted)

    def test_endless_line_is_dropped(self) -> None:
        """A line without end does not fill the memory; the stream is understood again after it."""
        stream = EventStream()
        stream.feed(b"data: " + b"x" * (MAX_EVENT + 1))
        self.assertEqual(stream.feed(b"\n\ndata: y\n\n"), [("message", b"y")])


class StageTests(SynchronousTestCase):
    """The run folder is emptied only where it is ours."""

    def setUp(self) -> None:
        self.folder = Path(self.mktemp())

    def test_ports_of_one_plan_differ(self) -> None:
        """A port of the page that was asked for is not given to the page over TLS as well."""
        (wanted,) = port.free("tcp", "127.0.0.1", 1)
        self.patch(stage, "TLS_PORT", wanted)
        plan = arranged(self.folder, "127.0.0.1", wanted, True, lambda line: None, True)
        ports = [plan.web_port, plan.reserve_port, *plan.tls_ports, plan.yard_port]
        self.assertEqual((plan.web_port, len(set(ports))), (wanted, 5))

    def test_free_ports_stay_free(self) -> None:
        """No free port is one that systems give to outgoing connections, so none is taken before its process starts."""
        lowest_given = 32_768
        for kind in ("tcp", "udp", port.BOTH):
            ports = port.free(kind, "127.0.0.1", 20)
            self.assertEqual(len(set(ports)), 20)
            self.assertLess(max(ports), lowest_given)

    def test_ports_are_free_for_both_kinds(self) -> None:
        """Where a port shall do for both kinds, one that is held for one of them alone is not given."""
        first, last = port.free(port.BOTH, "127.0.0.1", 2)
        self.patch(port, "QUIET", [first, last])
        for kind in (socket.SOCK_STREAM, socket.SOCK_DGRAM):
            with socket.socket(socket.AF_INET, kind) as held:
                held.bind(("127.0.0.1", first))
                if kind == socket.SOCK_STREAM:
                    held.listen(1)
                self.assertEqual(port.free(port.BOTH, "127.0.0.1", 1), [last])
                self.assertRaises(OSError, port.free, port.BOTH, "127.0.0.1", 2)

    def test_foreign_folder_is_refused(self) -> None:
        """A folder with somebody's file in it is refused and left as it is."""
        self.folder.mkdir()
        (self.folder / "thesis.txt").write_text("mine")
        with self.assertRaises(Trouble):
            fresh(self.folder)
        self.assertTrue((self.folder / "thesis.txt").exists())

    def test_earlier_run_is_removed(self) -> None:
        """Stores and logs of an earlier demonstration are gone, so no run sees the records of another."""
        fresh(self.folder).close()
        (self.folder / "dog1.sqlite").write_text("old")
        (self.folder / "inner").mkdir()
        fresh(self.folder).close()
        self.assertEqual([entry.name for entry in self.folder.iterdir()], [MARK])

    def test_second_demonstration_is_refused(self) -> None:
        """While one demonstration holds the folder a second one is refused in one line."""
        with fresh(self.folder):
            error = self.assertRaises(Trouble, fresh, self.folder)
            self.assertNotIn("\n", str(error))
        fresh(self.folder).close()

    def test_what_is_no_folder_is_refused(self) -> None:
        """A file in the place of the folder, or of the folder above it, is refused with what to do."""
        self.folder.write_text("mine")
        for folder in (self.folder, self.folder / "inner"):
            said = str(self.assertRaises(Trouble, fresh, folder))
            self.assertTrue(said.startswith(f"{folder} cannot be used ("), said)
            self.assertIn("choose another --run-dir", said)

    def test_foreign_address_is_refused(self) -> None:
        """An address that is none of this machine is refused as such, and its port is not called busy."""

        def nowhere(*_: object) -> list[int]:
            raise socket.gaierror(socket.EAI_NONAME, "Name or service not known")

        self.patch(port, "free", nowhere)
        for wanted in (None, 8080):
            error = self.assertRaises(Trouble, arranged, self.folder, "nohost", wanted, True, lambda line: None)
            self.assertIn("the page cannot be at nohost (Name or service not known); give --web-host", str(error))


class CommandLineTests(SynchronousTestCase):
    """The command line says what is wrong with it."""

    def test_unknown_option_ends_with_two(self) -> None:
        """An option that does not exist ends the program with exit code 2 before anything starts."""
        self.assertEqual(self.assertRaises(SystemExit, main, ["--nonsense"]).code, 2)

    def test_wrong_values_are_named(self) -> None:
        """A port that is none, and a report in no folder, are refused before anything starts, with what would do."""
        for words, said in (
            (["--web-port", "99999"], "--web-port: must be 0 to 65535, is '99999'"),
            (["--web-port", "-1"], "--web-port: must be 0 to 65535, is '-1'"),
            (["--headless", "--report", "/nowhere/x.json"], "--report /nowhere/x.json: there is no such folder; make"),
        ):
            errors = io.StringIO()
            with contextlib.redirect_stderr(errors):
                self.assertEqual(self.assertRaises(SystemExit, main, words).code, 2)
            self.assertIn(said, errors.getvalue())
