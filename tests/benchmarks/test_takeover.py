"""Tests of the command line of ``python -m benchmarks.takeover``. No trial runs."""

from __future__ import annotations

import contextlib
import io
from pathlib import Path

from twisted.trial.unittest import SynchronousTestCase

from benchmarks.takeover import __main__ as takeover


class CommandLineTests(SynchronousTestCase):
    def test_wrong_values_are_named(self) -> None:
        """An invalid number, share or folder exits with code 2; the error lists the valid values. No trial starts."""
        self.patch(takeover, "run_virtual", lambda *_: [])
        blocked = Path(self.mktemp())
        blocked.write_text("a file", encoding="utf-8")
        for words, said in (
            ("--count x", "--count: must be a whole number of at least 0, is 'x'"),
            ("--count -1", "--count: must be a whole number of at least 0, is '-1'"),
            ("--jobs -1", "--jobs: must be a whole number of at least 0, is '-1'"),
            ("--loss 2", "--loss: must be a share from 0 to 1, is '2'"),
            ("--loss some", "--loss: must be a share from 0 to 1, is 'some'"),
            ("--loss nan", "--loss: must be a share from 0 to 1, is 'nan'"),
            ("--count 0", "there is nothing to do"),
            (f"--out {blocked}", f"--out {blocked} cannot be created (File exists); choose another folder"),
        ):
            errors = io.StringIO()
            with contextlib.redirect_stderr(errors):
                self.assertEqual(self.assertRaises(SystemExit, takeover.main, words.split()).code, 2)
            self.assertIn(said, errors.getvalue())
