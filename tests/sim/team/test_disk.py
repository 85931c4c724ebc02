"""Tests of the simulated disk."""

from __future__ import annotations

import random

from twisted.trial.unittest import SynchronousTestCase

from middleware.entangled.clock import HeapClock
from middleware.entangled.errors import Unwritable
from middleware.entangled.identity import Identity
from middleware.entangled.record import Lifetime, Record
from sim.team.disk import SimulatedDisk, SurvivingMemory, restore_store

OWNER = Identity(b"o" * 32)


def _record(name: str, sequence: int = 1, lifetime: Lifetime = "team") -> Record:
    return Record(b"k" * 20, name, OWNER.public, sequence, lifetime, 60.0, b"\xc0")


class DiskTests(SynchronousTestCase):
    """Tests of ``SimulatedDisk``."""

    def setUp(self) -> None:
        """Create an empty disk."""
        self.clock = HeapClock()
        self.disk = SimulatedDisk(self.clock, random.Random(1))

    def _names(self, store: SurvivingMemory) -> list[str]:
        return [record.name for record in store.records()]

    def _reborn(self) -> SurvivingMemory:
        return restore_store(self.disk, SimulatedDisk(self.clock, random.Random(2)), self.clock.seconds())

    def test_last_moment_goes_with_the_power(self) -> None:
        """A record confirmed by ``wait_for_write`` survives a power loss; unconfirmed records and leases do not."""
        self.disk.put(_record("safe"), 60.0)
        self.disk.put(_record("lease", lifetime="leased"), 60.0)
        self.disk.set_note("fact", b"1")
        safe = self.disk.wait_for_write()
        self.assertNoResult(safe)
        self.clock.advance(0.1)
        self.successResultOf(safe)
        self.disk.put(_record("late"), 60.0)
        late = self.disk.wait_for_write()
        self.disk.lose_power()
        self.clock.advance(1.0)
        self.assertNoResult(late)
        reborn = self._reborn()
        self.assertEqual((self._names(reborn), reborn.get_note("fact")), (["safe"], b"1"))
        self.assertEqual(reborn.find_expiry(_record("safe").slot), self.clock.seconds() + 60.0)

    def test_third_life_has_what_the_first_wrote(self) -> None:
        """A record survives two consecutive restarts."""
        self.disk.put(_record("old"), 60.0)
        self.clock.advance(1.0)
        second = self._reborn()
        self.assertEqual(self._names(restore_store(second, SurvivingMemory(), 1.0)), ["old"])

    def test_goodbye_writes_all(self) -> None:
        """``close`` writes all pending records."""
        self.disk.put(_record("last"), 60.0)
        self.disk.close()
        self.assertEqual(self._names(self._reborn()), ["last"])

    def test_full_disk_refuses_by_name_and_recovers(self) -> None:
        """A full disk rejects pending and new writes but serves reads.

        When it has space, pending records are written.
        """
        self.disk.put(_record("before"), 60.0)
        self.clock.advance(0.1)
        self.disk.is_full = True
        self.disk.put(_record("owed"), 60.0)
        owed = self.disk.wait_for_write()
        self.clock.advance(0.1)
        self.failureResultOf(owed, Unwritable)
        self.assertIn("full", self.disk.write_error)
        self.assertRaises(Unwritable, self.disk.put, _record("refused"), 60.0)
        self.failureResultOf(self.disk.wait_for_write(), Unwritable)
        self.assertEqual(self._names(self.disk), ["before", "owed"])
        self.disk.is_full = False
        self.clock.advance(1.0)
        self.assertEqual(self.disk.write_error, "")
        self.successResultOf(self.disk.wait_for_write())
        self.assertEqual(sorted(self._names(self._reborn())), ["before", "owed"])

    def test_memory_outlives_the_power_but_for_leases(self) -> None:
        """In a scenario without disks, everything except the leases survives a restart."""
        memory = SurvivingMemory()
        memory.put(_record("team"), 60.0)
        memory.put(_record("lease", lifetime="leased"), 60.0)
        memory.set_note("fact", b"1")
        reborn = restore_store(memory, SurvivingMemory(), 5.0)
        self.assertEqual((self._names(reborn), reborn.get_note("fact"), reborn.origin), (["team"], b"1", "kept"))
