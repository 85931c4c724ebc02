"""Tests of pushed modules in real, confined processes."""

from __future__ import annotations

import os
import random
import sys
import time
from collections.abc import Mapping
from dataclasses import astuple, fields
from pathlib import Path

from twisted.trial.unittest import SkipTest, SynchronousTestCase

from agents.behaviour import STAND
from agents.behaviour_proxy import BehaviourProxy
from drivers.reading import Frame, Observation
from middleware.consensus.deployed_modules import BEHAVIOUR, STRATEGY
from middleware.consensus.guarded_strategy import MAX_LOSSES, GuardedStrategy, StrategyError
from middleware.consensus.strategy import Report
from middleware.deployment.manifest import make_next_manifest
from middleware.deployment.process_channel import ProcessChannel
from middleware.deployment.runner import REPLY_TIMEOUT_S, PushedStrategy, Runner, State
from tests.live.until import until

TEAM = [Report("a", 3.0), Report("b", 1.0), Report("c", 2.0)]
WAIT_S = 60.0
ATTEMPT = ("call", [0, "merge", [[list(astuple(Report("ask", 1.0)))], []]])
"""The call with which ``BASE`` makes the module run its attempts."""
CHOICE = [field.name for field in fields(Report)].index("choice")
BASE = """
import ctypes, os, signal, socket, sys, threading, time
from middleware.consensus.strategies.nearest import Nearest
from middleware.consensus.strategy import Report


def tried(attempt):
    try:
        return f"DONE {attempt()!r}"[:80]
    except BaseException as error:
        return type(error).__name__


class Strategy(Nearest):
    def merge(self, a, b):
        if len(a) > 1 or not a or a[0].agent != "ask":
            return super().merge(a, b)
        return [Report("told", 0.0, choice=str(each)) for each in ATTEMPT(a[0].choice)]
"""
SPIN = """
import time


class Behaviour:
    cost = 1.0
    def __init__(self, parameters, rng): self.hangs_at = parameters["hangs_at"]; self.looks = 0
    def look(self, seen, now):
        self.looks += 1
        self.progress = len(seen.frame.data) if seen.frame else 0.0
        while self.looks >= self.hangs_at: pass
    def search(self, now): return {"base.wz": 0.5}
    def hold(self, now): return {}
    def execute(self, context): return {"base.vx": 0.1}
"""


class PushedCodeTests(SynchronousTestCase):
    """Each module runs in one process."""

    def runner(self, source: str, kind: str = STRATEGY) -> Runner:
        """Return the runner of this module when it is ready or has refused the module."""
        data = source.encode()
        runner = Runner(make_next_manifest("best", kind, data, None), data, ProcessChannel, time.monotonic)
        self.addCleanup(runner.stop, "the test is over")
        runner.start()
        until(lambda: self.looked(runner).state is not State.STARTING)
        return runner

    def looked(self, runner: Runner) -> Runner:
        """Update the state of the runner and return the runner."""
        runner.poll()
        return runner

    def asked(self, source: str) -> list[str]:
        """Return the results of the module's attempts; raise if there is no reply."""
        runner = self.runner(BASE + source)
        self.assertIs(runner.state, State.READY, runner.why)
        return [told[CHOICE] for told in runner.call(*ATTEMPT)]

    def test_confined(self) -> None:
        """On Linux all limits that the machine supports are in force, including seccomp."""
        if not sys.platform.startswith("linux"):
            raise SkipTest("the limits exist only on Linux")
        runner = self.runner(BASE)
        for limit in ("limits", "seccomp", "no new rights", "no tracing", "ends with node", "no capabilities"):
            self.assertIn(limit, runner.limits)

    def test_nothing_of_the_machine(self) -> None:
        """A module has no access to files, sockets, processes, signals and the environment."""
        if not sys.platform.startswith("linux"):
            raise SkipTest("the limits exist only on Linux")
        canary = Path(self.mktemp())
        canary.write_text("secret")
        attempts = f"""
ATTEMPTS = [
    lambda: open({str(canary.absolute())!r}).read(),
    lambda: open("/etc/passwd").read(),
    lambda: open("new", "w").write("x"),
    lambda: os.listdir("."),
    lambda: os.listdir("/proc/self/fd"),
    lambda: socket.socket(),
    lambda: socket.socket(socket.AF_UNIX),
    lambda: os.fork(),
    lambda: os.execv({sys.executable!r}, ["python", "-c", "1"]),
    lambda: threading.Thread(target=int).start(),
    lambda: os.kill(os.getppid(), 0),
    lambda: os.kill(os.getppid(), signal.SIGTERM),
    lambda: os.setuid(0),
    lambda: os.pipe(),
    lambda: bytearray(2 * 1024**3),
    lambda: __import__("subprocess").run(["true"]),
    lambda: 1 / (1 + ctypes.CDLL(None).socket(2, 1, 0)),
]
def ATTEMPT(what):
    return [tried(each) for each in ATTEMPTS] + [len(os.environ)]
"""
        *told, environment = self.asked(attempts)
        self.assertEqual((len(told), [each for each in told if each.startswith("DONE")]), (17, []))
        self.assertEqual(environment, "0")

    def test_not_in_the_node(self) -> None:
        """The node's process loads no part of the module, which runs in a separate process."""
        before = set(sys.modules)
        (number,) = self.asked("def ATTEMPT(what): return [os.getpid()]\nsys.canary = 1\n")
        self.assertNotEqual(int(number), os.getpid())
        self.assertFalse(hasattr(sys, "canary"))
        self.assertFalse([name for name in set(sys.modules) - before if name.startswith("swarm_deployed_")])

    def test_strategy_that_hangs(self) -> None:
        """A strategy that hangs when it is used is killed and restarted, at most three times."""
        runner = self.runner(BASE + "def ATTEMPT(what):\n    while True: pass\n")
        losses = 0
        while runner.state is not State.OUT:
            until(lambda: self.looked(runner).state is not State.STARTING)
            self.assertRaises(StrategyError, runner.call, *ATTEMPT)
            losses += runner.state in (State.LOST, State.OUT)
        self.assertEqual(losses, MAX_LOSSES)
        guard = GuardedStrategy(PushedStrategy(runner), twice=True)
        self.assertIn(" failed (", guard.find(TEAM).reason)
        self.flushLoggedErrors()

    def test_what_it_says_is_limited(self) -> None:
        """A module that writes directly to the pipe, or returns too large a reply, is killed or refused."""
        flood = "def ATTEMPT(what):\n    for fd in range(3, 9):\n        try: os.write(fd, b'\\xff' * 100)\n"
        runner = self.runner(BASE + flood + "        except OSError: pass\n")
        self.assertRaises(StrategyError, runner.call, *ATTEMPT)
        self.assertIs(runner.state, State.LOST)
        self.assertRaises(StrategyError, self.asked, "def ATTEMPT(what): return ['x' * 1000000]\n")

    def test_ends_with_its_node(self) -> None:
        """The process ends when its runner stops."""
        runner = self.runner(BASE)
        channel = runner._channel
        assert isinstance(channel, ProcessChannel)
        number = channel.pid
        runner.stop("over")
        self.assertRaises(ProcessLookupError, os.kill, number, 0)

    def test_module_that_is_refused(self) -> None:
        """A module that cannot be loaded or is invalid is refused with the reason, and its process ends."""
        for source, why in (
            ("1 / 0", "ZeroDivisionError"),
            ("while True: pass", "takes more than"),
            ("x = 1", "define"),
        ):
            runner = self.runner(source)
            self.assertIs(runner.state, State.OUT)
            self.assertIn(why, runner.why)

    def test_behaviour(self) -> None:
        """A behaviour receives frames and returns actions; the agent does not wait.

        A behaviour that hangs is killed.
        """
        runner = self.runner(SPIN, BEHAVIOUR)
        self.assertIs(runner.state, State.READY, runner.why)
        frame = Frame(1, 640, 480, b"j" * 200_000, 0.0)
        seen = Observation(0.0, 0.0, {"range.near": 1.0}, {}, frame)
        behaviour = BehaviourProxy(runner.create({"hangs_at": 4}, random.Random(1)), STAND)
        other = BehaviourProxy(runner.create({"hangs_at": 10**9}, random.Random(1)), STAND)
        until(lambda: behaviour.cost == 1.0)
        until(lambda: behaviour.search(time.monotonic()) == {"base.wz": 0.5})
        behaviour.look(seen, 0.0)
        until(lambda: getattr(behaviour, "progress", None) == 200_000)
        slowest = 0.0
        action: Mapping[str, float] = {}

        def has_failed() -> bool:
            nonlocal action, slowest
            begun = time.monotonic()
            behaviour.look(seen, begun)
            action = behaviour.search(begun)
            slowest = max(slowest, time.monotonic() - begun)
            return behaviour.has_failed

        until(has_failed)
        self.assertEqual((action, behaviour.search(0.0), behaviour.cost), (STAND, STAND, None))
        self.assertLess(slowest, REPLY_TIMEOUT_S)
        self.assertTrue(other.has_failed)
        self.assertIs(runner.state, State.LOST)
        third = BehaviourProxy(runner.create({"hangs_at": 10**9}, random.Random(1)), STAND)
        until(lambda: third.cost == 1.0)
        third.close()
        self.assertEqual(runner.instances, set())
        self.flushLoggedErrors()
