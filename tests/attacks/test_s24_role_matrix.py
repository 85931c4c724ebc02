"""Attack S24: an insider tries every method and every record namespace of a running team.

``python -m tests.attacks.role_matrix`` prints the counts.
"""

from __future__ import annotations

from twisted.trial.unittest import SynchronousTestCase

from middleware.admission.roles import DEVICE, GATEWAY, KINDS, METHODS, VIEWER, kind_of, may_call, may_store
from tests.attacks.role_matrix import REVOKED_OPERATOR, Counts, list_slots, try_everything


class RoleMatrixTests(SynchronousTestCase):
    """Each subject at a team of its own; what the role table forbids is refused and changes nothing."""

    def check(self, subject: str, roles: tuple[str, ...]) -> Counts:
        """Check that the trial of ``subject`` tried all that its ``roles`` forbid, and that all of it was refused."""
        counts = try_everything(subject)
        self.assertEqual(counts.wrong, [])
        self.assertEqual((counts.methods_refused, counts.records_refused), (counts.methods, counts.records))
        self.assertEqual(counts.changes, 0)
        nodes = 3
        self.assertEqual(counts.methods, nodes * sum(not may_call(roles, name) for name in (*METHODS, "made.up")))
        forbidden = [slot for slot in list_slots(b"o" * 32) if not may_store(roles, slot)]
        self.assertEqual(counts.records, 2 * nodes * len(forbidden))
        return counts

    def test_viewer(self) -> None:
        """A viewer can neither act, order, bid nor write anything but its own presence."""
        self.assertGreater(self.check(VIEWER, (VIEWER,)).records, 100)

    def test_device(self) -> None:
        """A device can neither order nor write what only an operator or a gateway may."""
        self.assertGreater(self.check(DEVICE, (DEVICE,)).records, 50)

    def test_gateway(self) -> None:
        """A gateway is refused nothing that the table allows it."""
        self.assertGreater(self.check(GATEWAY, (GATEWAY,)).allowed, 100)

    def test_revoked_operator(self) -> None:
        """A revoked operator can do nothing at all, neither itself nor by a member that carries its records."""
        counts = self.check(REVOKED_OPERATOR, ())
        self.assertEqual(counts.allowed, 0)

    def test_slots_cover_the_table(self) -> None:
        """The slots that are tried have every namespace of the table."""
        self.assertEqual({kind_of(slot) for slot in list_slots(b"o" * 32)}, set(KINDS))
