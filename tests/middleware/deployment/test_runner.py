"""Tests of ``middleware.deployment.runner``, the node's side of a module's process, in virtual time."""

from __future__ import annotations

import random
from collections.abc import Callable
from typing import Any

from twisted.trial.unittest import SynchronousTestCase

from middleware.consensus.deployed_modules import BEHAVIOUR, STRATEGY
from middleware.consensus.guarded_strategy import MAX_LOSSES, StrategyError, StrategyLost
from middleware.consensus.strategy import Report
from middleware.deployment import module_channel
from middleware.deployment.manifest import make_next_manifest
from middleware.deployment.runner import MAX_PENDING, REPLY_TIMEOUT_S, START_TIMEOUT_S, PushedStrategy, Runner, State
from middleware.errors import UnknownTask
from swarmnode.sandbox import make_memory_channel

NEAREST = b"from middleware.consensus.strategies.nearest import Nearest as Strategy\n"
ONE = [0, "find", []]


class Scripted:
    """A process that replies as a script determines."""

    has_unsent = False

    def __init__(self, answer: Callable[[int, str], bytes]) -> None:
        self.is_ended = False
        self.asked: list[str] = []
        self._answer = answer
        self._splitter = module_channel.FrameSplitter(module_channel.MAX_REQUEST_BYTES)
        self._ready: list[bytes] = []

    def send(self, message: bytes) -> None:
        for question in self._splitter.feed(message):
            number, verb, _ = module_channel.parse_request(question)
            self.asked.append(verb)
            self._ready += module_channel.FrameSplitter(module_channel.MAX_REPLY_BYTES).feed(self._answer(number, verb))

    def receive(self, within_s: float) -> list[bytes]:
        ready, self._ready = self._ready, []
        return ready

    def kill(self) -> None:
        self.is_ended = True


def well(number: int, content: Any) -> bytes:
    return module_channel.pack([number, True, content])


class RunnerTests(SynchronousTestCase):
    def setUp(self) -> None:
        self.now = 0.0
        self.objection = ""
        self.processes: list[Scripted] = []
        self.flushed = False

    def runner(self, answer: Callable[[int, str], bytes], kind: str = STRATEGY) -> Runner:
        """Return the started runner of a module whose process replies with ``answer``."""

        def spawn() -> Scripted:
            self.processes.append(Scripted(answer))
            return self.processes[-1]

        runner = Runner(
            make_next_manifest("best", kind, NEAREST, None), NEAREST, spawn, lambda: self.now, lambda: self.objection
        )
        runner.start()
        runner.poll()
        return runner

    def good(self, number: int, verb: str) -> bytes:
        """Reply that the module is loaded, and reply to each call with the same result."""
        return well(number, {"limits": ["seccomp"], "reads": ["load"], "told": []} if verb != "call" else 7)

    def test_ready_and_asked(self) -> None:
        """After loading, the runner knows the limits and the fields that the module reads, and forwards calls to it."""
        runner = self.runner(self.good)
        self.assertEqual((runner.state, runner.limits, runner.reads), (State.READY, ("seccomp",), ("load",)))
        self.assertEqual(runner.call("call", ONE), 7)
        self.assertEqual(PushedStrategy(runner).name, "deployed:best")

    def test_may_not_run(self) -> None:
        """An objection prevents the start of the process, and its restart."""
        self.objection = "is revoked"
        runner = self.runner(self.good)
        self.assertEqual((runner.state, runner.why, self.processes), (State.OUT, "is revoked", []))
        self.objection = ""
        lost = self.runner(lambda number, verb: self.good(number, verb) if verb == "load" else b"")
        self.assertRaises(StrategyLost, lost.call, "call", ONE)
        self.objection = "is revoked"
        self.assertRaises(StrategyError, lost.call, "call", ONE)
        self.assertEqual((lost.state, len(self.processes)), (State.OUT, 1))

    def test_silence_costs_the_process(self) -> None:
        """A process that does not reply is killed.

        After ``MAX_LOSSES`` lost processes no further process is started.
        """
        runner = self.runner(lambda number, verb: self.good(number, verb) if verb == "load" else b"")
        for _ in range(MAX_LOSSES):
            self.assertRaises(StrategyLost, runner.call, "call", ONE)
        self.assertIs(runner.state, State.OUT)
        self.assertRaises(StrategyError, runner.call, "call", ONE)
        self.assertEqual([each.is_ended for each in self.processes], [True] * MAX_LOSSES)

    def test_never_loaded(self) -> None:
        """A process that is not ready in time is killed."""
        runner = self.runner(lambda number, verb: b"")
        self.assertRaises(StrategyError, runner.call, "call", ONE)
        self.now = START_TIMEOUT_S + 1.0
        runner.poll()
        self.assertEqual((runner.state, self.processes[0].is_ended), (State.LOST, True))

    def test_hostile_answers(self) -> None:
        """An invalid reply ends the process, and raises only ``StrategyError``."""
        for nonsense in (
            module_channel.pack(7),
            module_channel.pack([1]),
            module_channel.pack([99, True, None]),
            module_channel.pack(["1", True, None]),
            module_channel.pack([2, 1, None]),
            b"\0\0\0\1\xc1",
            b"\0\0\0\0",
        ):

            def answer(number: int, verb: str, nonsense: bytes = nonsense) -> bytes:
                return self.good(number, verb) if verb == "load" else nonsense

            runner = self.runner(answer)
            self.assertRaises(StrategyError, runner.call, "call", ONE)
            self.assertIs(runner.state, State.LOST)

    def test_hostile_facts(self) -> None:
        """Invalid facts in the reply to "load" are ignored or rejected, without an exception."""
        for facts in (None, 7, {}, {"limits": 7, "reads": 7}, {"limits": [None] * 99, "reads": [[], {}, 1]}):
            runner = self.runner(lambda number, verb, facts=facts: well(number, facts))  # type: ignore[misc]
            self.assertIs(runner.state, State.READY if isinstance(facts, dict) else State.OUT)
            self.assertLessEqual(len(runner.limits), 16)

    def test_instances(self) -> None:
        """An instance of a behaviour is created, called and dropped.

        If the process ends, the instance ends with the same reason.
        """
        runner = self.runner(self.good, BEHAVIOUR)
        instance = runner.create({"turns": 1}, random.Random(1))
        answers: list[tuple[bool, Any]] = []
        self.assertTrue(instance.send_request("look", [], lambda is_well, content: answers.append((is_well, content))))
        instance.poll()
        self.assertEqual(answers, [(True, 7)])
        instance.close()
        self.assertEqual(self.processes[0].asked, ["load", "make", "call", "drop"])
        other = runner.create({}, random.Random(1))
        runner.stop("is revoked")
        other.poll()
        self.assertEqual((other.fault, runner.instances), ("is revoked", set()))
        self.assertFalse(other.send_request("look", [], lambda is_well, content: None))
        self.assertRaises(UnknownTask, runner.create, {}, random.Random(1))

    def test_late_behaviour_is_ended(self) -> None:
        """If a behaviour exceeds the timeout, its process is killed and its pending calls fail."""
        runner = self.runner(lambda number, verb: b"" if verb == "call" else self.good(number, verb), BEHAVIOUR)
        instance = runner.create({}, random.Random(1))
        answers: list[bool] = []
        instance.send_request("look", [], lambda is_well, content: answers.append(is_well))
        self.now = REPLY_TIMEOUT_S
        instance.poll()
        self.assertEqual(answers, [])
        self.now = REPLY_TIMEOUT_S + 0.01
        instance.poll()
        self.assertEqual((answers, runner.state, bool(instance.fault)), ([False], State.LOST, True))

    def test_questions_are_bounded(self) -> None:
        """The number of pending calls is limited."""
        runner = self.runner(lambda number, verb: b"" if verb == "call" else self.good(number, verb), BEHAVIOUR)
        for _ in range(MAX_PENDING):
            runner.send_request("call", [], lambda is_well, content: None)
        self.assertRaises(module_channel.ProcessEnded, runner.send_request, "call", [], lambda is_well, content: None)

    def test_twin(self) -> None:
        """The runner that uses no process loads, decides and rejects in the same way as the runner with a process."""
        runner = Runner(make_next_manifest("best", STRATEGY, NEAREST, None), NEAREST, make_memory_channel, lambda: 0.0)
        runner.start()
        runner.poll()
        found = PushedStrategy(runner).find([Report("a", 2.0), Report("b", 1.0)])
        self.assertEqual((found.assigned_agent, runner.limits), ("b", ("simulated",)))
        wrong = Runner(make_next_manifest("best", STRATEGY, b"1 / 0", None), b"1 / 0", make_memory_channel, lambda: 0.0)
        wrong.start()
        wrong.poll()
        self.assertEqual(wrong.state, State.OUT)
        self.assertIn("ZeroDivisionError", wrong.why)
