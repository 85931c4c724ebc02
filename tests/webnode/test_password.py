"""Tests of ``webnode.password``: hashes of passwords."""

from __future__ import annotations

from twisted.trial.unittest import SynchronousTestCase

from webnode.password import LOG_N, P, R, hash_password, parse_hash, verify_password


class PasswordTests(SynchronousTestCase):
    def test_know_the_password_again(self) -> None:
        """A hash matches only its own password, and depends on the salt."""
        text = hash_password("correct horse", bytes(16), 4)
        self.assertTrue(verify_password(text, "correct horse"))
        for other in ("correct hors", "Correct horse", "", text):
            self.assertFalse(verify_password(text, other))
        self.assertNotEqual(text, hash_password("correct horse", bytes(15) + b"\x01", 4))
        self.assertNotIn("horse", text)

    def test_be_hard_to_guess(self) -> None:
        """The default hash needs 16 MiB and five rounds."""
        self.assertEqual(parse_hash(hash_password("correct horse", bytes(16)))[:3], (LOG_N, R, P))
        self.assertEqual((128 * R * 2**LOG_N, P), (16 * 1024 * 1024, 5))

    def test_refuse_what_is_no_hash(self) -> None:
        """Invalid hashes, and hashes that need too much memory, are rejected."""
        good = hash_password("x", bytes(16), 4)
        tail = good.split("$", 4)[4]
        for text in (
            "",
            "secret",
            "bcrypt$4$8$5$a$b",
            f"scrypt$30$8$5${tail}",
            f"scrypt$x$8$5${tail}",
            good + "$",
            "$" * 5,
        ):
            self.assertRaises(ValueError, parse_hash, text)
