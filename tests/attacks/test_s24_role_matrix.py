"""Attack S24: try every method and every record namespace of a running team as an insider.

``python -m tests.attacks.role_matrix`` prints the counts.
"""

from __future__ import annotations

from twisted.trial.unittest import SynchronousTestCase

from middleware.admission.roles import DEVICE, GATEWAY, KINDS, METHODS, VIEWER, classify_slot, may_call, may_store
from tests.attacks.role_matrix import REVOKED_OPERATOR, list_slots, try_everything


class RoleMatrixTests(SynchronousTestCase):
    """Each insider acts in a new team; attempts that the role table forbids are rejected and change nothing."""

    def test_every_subject(self) -> None:
        """All attempts that an insider's roles forbid are rejected; no permitted attempt is rejected for the role.

        A viewer writes only its presence, a device cannot send orders, and a revoked operator can do nothing, neither
        directly nor through a member that sends its records.
        """
        subjects: dict[str, tuple[tuple[str, ...], int]] = {
            VIEWER: ((VIEWER,), 100),
            DEVICE: ((DEVICE,), 50),
            GATEWAY: ((GATEWAY,), 0),
            REVOKED_OPERATOR: ((), 100),
        }
        for subject, (roles, least) in subjects.items():
            with self.subTest(subject=subject):
                counts, nodes = try_everything(subject), 3
                self.assertEqual((counts.wrong, counts.changes), ([], 0))
                self.assertEqual((counts.methods_refused, counts.records_refused), (counts.methods, counts.records))
                forbidden = [name for name in (*METHODS, "made.up") if not may_call(roles, name)]
                self.assertEqual(counts.methods, nodes * len(forbidden))
                slots = [slot for slot in list_slots(b"o" * 32) if not may_store(roles, slot)]
                self.assertEqual(counts.records, 2 * nodes * len(slots))
                self.assertGreater(counts.records, least)
                self.assertEqual(counts.allowed, nodes * sum(may_call(roles, name) for name in METHODS))

    def test_slots_cover_the_table(self) -> None:
        """The slots of the attempts cover every namespace of the role table."""
        self.assertEqual({classify_slot(slot) for slot in list_slots(b"o" * 32)}, set(KINDS))
