"""Tests of the key files of members and operators."""

from __future__ import annotations

import os
import random
from pathlib import Path

from twisted.trial.unittest import SynchronousTestCase

from middleware.admission import keyfile, membership_file
from middleware.admission import operator as operators
from middleware.admission.errors import BadKeyFile
from middleware.admission.membership_file import Membership, MembershipFile
from tests.middleware.admission.paper import NOW, operator


class MembershipTests(SynchronousTestCase):
    def setUp(self) -> None:
        self.path = Path(self.mktemp())
        self.membership = operator().create_membership("vaio", ("device", "bootstrap"), NOW, random.Random(1))

    def refusal(self, path: Path) -> str:
        """Return the error message for the membership file at ``path``."""
        return str(self.assertRaises(BadKeyFile, MembershipFile, path))

    def test_read_as_it_was_kept(self) -> None:
        """A membership is unchanged after writing and reading, and only the owner of the file can read it."""
        membership_file.create_membership_file(self.path, self.membership)
        self.assertEqual(MembershipFile(self.path).membership, self.membership)
        self.assertEqual(self.path.stat().st_mode & 0o777, 0o600)

    def test_what_is_no_membership(self) -> None:
        """A missing file, invalid content, a key file of another kind and a file of another team raise an error."""
        self.assertIn("cannot be read", self.refusal(self.path))
        foreign = operator(2).create_membership("vaio", ("device",), NOW, random.Random(1))
        wrong = self.membership.to_json() | {"pass": foreign.certificate.hex()}
        for content in (wrong, {"kind": "other"}, self.membership.to_json() | {"secrets": []}):
            keyfile.write(self.path, content)
            self.assertIn(str(self.path), self.refusal(self.path))
        self.path.write_text("not JSON")
        self.assertIn(str(self.path), self.refusal(self.path))

    def test_nothing_is_overwritten(self) -> None:
        """A new key file never replaces an existing file, so a mistake cannot destroy a team's key."""
        operators.create_operator_file(self.path, operator())
        self.assertRaises(BadKeyFile, operators.create_operator_file, self.path, operator(2))
        self.assertEqual(operators.load_operator(self.path), operator())

    def test_replaced_whole(self) -> None:
        """A new secret replaces the file completely and leaves no temporary file; an unwritable folder is reported."""
        membership_file.create_membership_file(self.path, self.membership)
        kept = MembershipFile(self.path)
        kept.save(self.membership.with_secret(2, b"2" * 32, NOW + 60))
        self.assertEqual(MembershipFile(self.path).membership, kept.membership)
        leftover = [name for name in os.listdir(self.path.parent) if name.startswith(f".{self.path.name}")]
        self.assertEqual(leftover, [])
        nowhere = Path(self.mktemp()) / "folder" / "file"
        self.assertIn(
            "cannot be written",
            str(self.assertRaises(BadKeyFile, membership_file.create_membership_file, nowhere, kept.membership)),
        )

    def test_old_secrets_run_out(self) -> None:
        """After a rotation the previous secret is accepted for its grace period, in any order of arrival."""
        first = self.membership.secrets[0][1]
        second, third = (2, b"2" * 32, NOW + 60), (3, b"3" * 32, NOW + 90)
        for order in ((second, third), (third, second)):
            held: Membership = self.membership
            for each in order:
                held = held.with_secret(*each)
            self.assertEqual([s for _, s, _ in held.list_accepted_secrets(NOW)], [third[1], second[1], first])
            self.assertEqual([s for _, s, _ in held.list_accepted_secrets(NOW + 60)], [third[1], second[1]])
            self.assertEqual([s for _, s, _ in held.list_accepted_secrets(NOW + 90)], [third[1]])
