"""Tests of the reference pages that contain tables with columns generated from the code (``docs/generate.py``)."""

from __future__ import annotations

import re
from importlib.util import module_from_spec, spec_from_file_location
from pathlib import Path
from types import ModuleType

from twisted.trial.unittest import SynchronousTestCase

DOCS = Path(__file__).parents[1] / "docs"


def load_generator() -> ModuleType:
    """Return ``docs/generate.py`` as a module."""
    spec = spec_from_file_location("generate", DOCS / "generate.py")
    assert spec is not None and spec.loader is not None
    module = module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


class ReferenceTableTests(SynchronousTestCase):
    def test_tables_agree_with_the_code(self) -> None:
        """Each table has a row for each name in the code, the same columns as the code, and no empty cell."""
        generator = load_generator()
        for name, list_rows in generator.TABLES.items():
            text = (DOCS / "reference" / f"{name}.md").read_text(encoding="utf-8")
            self.assertEqual(generator.update_rows(text, list_rows()), text, f"run make docs: {name}.md is outdated")
            table = text.partition(generator.BEGIN)[2].partition(generator.END)[0]
            self.assertEqual(re.findall(r"^\|.*\| *\|.*$", table, re.MULTILINE), [], f"{name}.md has an empty cell")

    def test_rows_are_updated(self) -> None:
        """A changed column is replaced, a new row gets empty cells, an obsolete row is removed, and the text stays."""
        generator = load_generator()
        rows = ["| name | type | meaning |", "|---|---|---|", "| `a` | text | first |", "| `b` | text | second |"]
        page = "\n".join(["Before.", "", generator.BEGIN, "", *rows, "", generator.END, "", "After."])
        updated = generator.update_rows(page, {"a": ("number",), "c": ("text",)})
        self.assertEqual(
            updated.splitlines()[5:8],
            ["|---|---|---|", "| `a` | number | first |", "| `c` | text |  |"],
        )
        self.assertTrue(updated.startswith("Before.\n") and updated.endswith("\nAfter."))
