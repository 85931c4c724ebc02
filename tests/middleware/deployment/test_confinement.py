"""Tests of ``middleware.deployment.confinement``.

The tests evaluate the filter of system calls in the same way as the kernel.
"""

from __future__ import annotations

import struct

from twisted.trial.unittest import SynchronousTestCase

from middleware.deployment import confinement
from middleware.deployment.confinement import ALLOWED_CALLS, build_filter

ALLOW, REFUSE, KILL = 0x7FFF0000, 0x00050001, 0x80000000
MACHINES = {"x86_64": 0xC000003E, "aarch64": 0xC00000B7}


def verdict(program: bytes, architecture: int, number: int) -> int:
    """Return the result of a seccomp program for one system call."""
    lines = [struct.unpack_from("=HBBI", program, at) for at in range(0, len(program), 8)]
    loaded, at = 0, 0
    while True:
        code, if_equal, otherwise, value = lines[at]
        at += 1
        if code == 0x20:
            loaded = {0: number, 4: architecture}[value]
        elif code == 0x15:
            at += if_equal if loaded == value else otherwise
        else:
            return int(value)


class ConfinementTests(SynchronousTestCase):
    def test_exactly_the_listed_calls(self) -> None:
        """The filter allows exactly the listed calls.

        It rejects all other calls, and kills the process on another architecture.
        """
        for machine, architecture in MACHINES.items():
            program = build_filter(machine)
            _, _, numbers = confinement._NUMBERS[machine]
            self.assertEqual((len(numbers), len(set(numbers))), (len(ALLOWED_CALLS), len(ALLOWED_CALLS)))
            for number in (*range(600), 0x40000000, 2**32 - 1):
                wanted = ALLOW if number in numbers else REFUSE
                self.assertEqual(verdict(program, architecture, number), wanted, (machine, number))
            self.assertEqual(verdict(program, 0x40000003, numbers[0]), KILL)

    def test_dangerous_calls_are_none_of_them(self) -> None:
        """No listed call opens a file, connects, starts a process, traces a process or sends a signal."""
        for call in ("open", "openat", "socket", "connect", "clone", "fork", "execve", "ptrace", "kill", "bpf"):
            self.assertNotIn(call, ALLOWED_CALLS)
        self.assertNotIn("ioctl", ALLOWED_CALLS)

    def test_unknown_machine(self) -> None:
        """An unknown architecture raises ``ValueError``."""
        self.assertRaises(ValueError, build_filter, "pdp11")
