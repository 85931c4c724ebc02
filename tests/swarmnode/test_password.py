"""Tests of ``swarm password``."""

from __future__ import annotations

import io
import sys

from twisted.trial.unittest import SynchronousTestCase

from middleware.config.settings import Settings
from swarmnode.password import main
from webnode.password import verify_password


class PasswordCommandTests(SynchronousTestCase):
    def typed(self, *answers: str) -> tuple[int, str, str]:
        said, out, errors = list(answers), io.StringIO(), io.StringIO()
        self.patch(sys, "stderr", errors)

        def ask(prompt: str) -> str:
            if not said:
                raise EOFError
            return said.pop(0)

        return main([], out, ask, bytes), out.getvalue(), errors.getvalue()

    def test_print_a_line_for_the_settings(self) -> None:
        """The output is a line of TOML for the settings; it contains a hash that matches the password."""
        code, out, _ = self.typed("correct horse", "correct horse")
        self.assertEqual(code, 0)
        path = self.mktemp()
        with open(path, "w", encoding="utf-8") as file:
            file.write(f'[node]\nname = "vaio"\n[web]\n{out}')
        self.assertTrue(verify_password(Settings.load(path).web.password, "correct horse"))
        self.assertNotIn("horse", out)

    def test_refuse_in_one_line(self) -> None:
        """An invalid or missing password gives one error line and exit code 1.

        It is invalid if it is short, begins with a space, or differs from its repetition.
        """
        for answers, words in (
            (("short",), "5 characters"),
            (("correct horse", "correct hors"), "not the same"),
            ((" correct horse",), "a space"),
            ((), "no password entered"),
        ):
            code, out, errors = self.typed(*answers)
            self.assertEqual((code, out, errors.count("\n")), (1, "", 1))
            self.assertIn(words, errors)
