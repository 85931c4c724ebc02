"""Tests of the memory estimate of a simulated team."""

from __future__ import annotations

from collections.abc import Callable

from twisted.trial.unittest import SynchronousTestCase

from middleware.errors import BadSetting
from sim.team.faults.settings import Fault
from sim.team.memory import (
    BASE_BYTES,
    KIB_PER_NODE,
    NO_LIMIT_BYTES,
    check_memory,
    estimate_bytes,
    measure_free_bytes,
    measure_resident_bytes,
)
from sim.team.scenario import Scenario

MEMINFO = "MemTotal: 8000000 kB\nMemAvailable:    4000000 kB\n"


def _machine(files: dict[str, str]) -> Callable[[str], str]:
    def read(path: str) -> str:
        if path not in files:
            raise FileNotFoundError(path)
        return files[path]

    return read


class MemoryTests(SynchronousTestCase):
    """The memory estimate is compared with the memory limit before a run."""

    def test_machine_and_groups_set_the_limit(self) -> None:
        """The limit is the minimum of the free memory and the limits of all cgroups (v1 or v2).

        ``max`` means no limit.
        """
        files = {"/proc/meminfo": MEMINFO}
        self.assertEqual(measure_free_bytes(_machine(files)), 4_000_000 * 1024)
        files |= {
            "/proc/self/cgroup": "0::/team/run\n",
            "/sys/fs/cgroup/team/run/memory.max": "max",
            "/sys/fs/cgroup/team/run/memory.current": "5",
            "/sys/fs/cgroup/team/memory.max": "1000",
            "/sys/fs/cgroup/team/memory.current": "300",
        }
        self.assertEqual(measure_free_bytes(_machine(files)), 700)
        files["/proc/self/cgroup"] = "3:cpu,cpuacct:/\n5:memory:/box\n"
        files["/sys/fs/cgroup/memory/box/memory.limit_in_bytes"] = "500"
        files["/sys/fs/cgroup/memory/box/memory.usage_in_bytes"] = "600"
        self.assertEqual(measure_free_bytes(_machine(files)), 0)
        self.assertEqual(measure_free_bytes(_machine({})), NO_LIMIT_BYTES)

    def test_team_that_does_not_fit_is_refused(self) -> None:
        """The error contains a number of nodes that fits; nodes that join during the run are included."""
        files = {"/proc/meminfo": MEMINFO}
        check_memory(Scenario(nodes=10_000), _machine(files))
        error = self.assertRaises(BadSetting, check_memory, Scenario(nodes=20_000), _machine(files))
        self.assertEqual(error.key, "--nodes")
        fit = int(error.remedy.split()[3].rstrip(",").replace(",", ""))
        check_memory(Scenario(nodes=fit), _machine(files))
        self.assertRaises(BadSetting, check_memory, Scenario(nodes=fit + 50), _machine(files))
        crowd = Scenario(nodes=10, faults=(Fault("crowd", 1.0, count=90),))
        self.assertEqual(estimate_bytes(crowd), BASE_BYTES + 100 * KIB_PER_NODE["entangled"] * 1024)

    def test_own_size_is_read(self) -> None:
        """The memory of the process is reported in bytes; it is 0 if the operating system does not report it."""
        self.assertEqual(
            measure_resident_bytes(_machine({"/proc/self/status": "Name: x\nVmRSS:\t  100 kB\n"})), 102_400
        )
        self.assertEqual(measure_resident_bytes(_machine({})), 0)
