"""Tests of the processes of the demonstration, with a fake reactor."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from twisted.internet.error import ProcessExitedAlready, ProcessTerminated
from twisted.internet.interfaces import IReactorProcess
from twisted.internet.protocol import ProcessProtocol
from twisted.internet.task import Clock
from twisted.python.failure import Failure
from twisted.trial.unittest import SynchronousTestCase
from zope.interface import implementer

from sim.demo.processes import RESTART_S, ProcessGroup, make_child_command


class MemoryProcess:
    """A process that ends on any signal, or, if ``stubborn`` is set, only on KILL."""

    def __init__(self, clock: Clock, pid: int, arguments: list[str], protocol: ProcessProtocol, stubborn: bool) -> None:
        self._clock = clock
        self.pid = pid
        self.arguments = arguments
        self.signals: list[str] = []
        self._protocol = protocol
        self._stubborn = stubborn
        self._ended = False

    def signalProcess(self, signal: str) -> None:
        if self._ended:
            raise ProcessExitedAlready
        self.signals.append(signal)
        if signal == "KILL" or not self._stubborn:
            self._ended = True
            self._clock.callLater(0.0, self._protocol.processEnded, Failure(ProcessTerminated(1)))

    def write_line(self, data: bytes) -> None:
        """Write to standard output."""
        self._protocol.outReceived(data)


@implementer(IReactorProcess)
class MemoryProcesses(Clock):
    """A reactor that starts ``MemoryProcess`` objects instead of real processes."""

    def __init__(self, stubborn: bool = False) -> None:
        super().__init__()
        self.started: list[MemoryProcess] = []
        self._stubborn = stubborn

    def spawnProcess(  # type: ignore[override]
        self, protocol: Any, executable: Any, args: Any = (), *_: Any, **__: Any
    ) -> Any:
        process = MemoryProcess(self, 100 + len(self.started), list(args), protocol, self._stubborn)
        self.started.append(process)
        protocol.makeConnection(process)
        return process


class TeamTests(SynchronousTestCase):
    """``ProcessGroup`` starts, logs, kills, restarts and ends processes."""

    def setUp(self) -> None:
        self.folder = Path(self.mktemp())
        self.folder.mkdir()
        self.said: list[tuple[str, str]] = []

    def team(self, stubborn: bool = False) -> tuple[ProcessGroup, MemoryProcesses]:
        reactor = MemoryProcesses(stubborn)
        team = ProcessGroup(reactor, self.folder, lambda name, line: self.said.append((name, line)))
        team.add("dog1", ["-m", "x"])
        team.add("dog2", ["-m", "y"])
        team.start()
        self.addCleanup(reactor.advance, 60.0)
        self.addCleanup(team.stop)
        return team, reactor

    def test_processes_start_on_a_leash_and_are_heard(self) -> None:
        """Each process ends with its parent.

        The output lines of a process reach the listener, the log file and the list of its last lines.
        """
        team, reactor = self.team()
        self.assertEqual(reactor.started[0].arguments, make_child_command(["-m", "x"]))
        self.assertEqual((team.get_pid("dog1"), team.get_pid("dog2"), team.list_ended()), (100, 101, []))
        reactor.started[0].write_line(b"one\ntw")
        reactor.started[0].write_line(b"o\n")
        self.assertEqual(self.said, [("dog1", "one"), ("dog1", "two")])
        self.assertEqual((self.folder / "dog1.log").read_text(), "one\ntwo\n")
        self.assertEqual(team.get_tail("dog1"), ["one", "two"])

    def test_killed_process_stays_away_for_the_delay(self) -> None:
        """A killed process restarts after exactly ``RESTART_S``; the other process keeps running."""
        team, reactor = self.team()
        reactor.advance(100.0)
        team.kill("dog1")
        for name in ("dog1", "cat1"):
            self.assertRaises(KeyError, team.kill, name)
        reactor.advance(0.0)
        self.assertEqual((reactor.started[0].signals, team.list_ended()), (["KILL"], ["dog1"]))
        reactor.advance(RESTART_S - 0.1)
        self.assertIsNone(team.get_pid("dog1"))
        reactor.advance(0.2)
        self.assertEqual((team.get_pid("dog1"), team.get_pid("dog2")), (102, 101))

    def test_stop_ends_all_and_starts_none(self) -> None:
        """After ``stop`` no process runs or restarts, and no timer remains.

        Further calls of ``stop`` complete as well.
        """
        team, reactor = self.team()
        team.kill("dog2")
        reactor.advance(0.0)
        first, second = team.stop(), team.stop()
        reactor.pump([0.1] * 3)
        self.successResultOf(first)
        self.successResultOf(second)
        self.successResultOf(team.stop())
        self.assertEqual((team.list_ended(), reactor.getDelayedCalls()), (["dog1", "dog2"], []))

    def test_stop_waits_for_the_stubborn_and_kills_them(self) -> None:
        """``stop`` kills a process that ignores TERM for four seconds, and waits until the process has ended."""
        team, reactor = self.team(stubborn=True)
        done = team.stop()
        reactor.pump([0.1] * 30)
        self.assertNoResult(done)
        reactor.pump([0.1] * 15)
        self.successResultOf(done)
        self.assertEqual(reactor.started[0].signals, ["TERM", "KILL"])
