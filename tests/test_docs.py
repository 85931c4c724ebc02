"""The documents: what they point to exists, and the examples are lawful settings."""

from __future__ import annotations

import re
from pathlib import Path

from twisted.trial.unittest import SynchronousTestCase

from drivers.registry import describe
from middleware.settings import Settings

ROOT = Path(__file__).parents[1]
DOCUMENTS = [ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md")), ROOT / "benchmarks" / "README.md"]
LINK = re.compile(r"\[[^\]]*\]\(([^)\s]+)\)")
NAMED = re.compile(r"`([\w./-]+\.(?:py|toml|json|md))(?:::(\w+))?`")
EXAMPLES = sorted((ROOT / "examples").glob("*.toml"))


class DocumentTests(SynchronousTestCase):
    def test_links_lead_somewhere(self) -> None:
        """Every relative link and picture of the documents is a file or folder beside them."""
        for document in DOCUMENTS:
            for target in LINK.findall(document.read_text(encoding="utf-8")):
                if not re.match(r"https?:|mailto:|#", target):
                    place = document.parent / target.partition("#")[0]
                    self.assertTrue(place.exists(), f"{document.relative_to(ROOT)} links to {target}")

    def test_named_files_exist(self) -> None:
        """Every file that a document names by its path exists, and holds the name that stands behind it."""
        for document in DOCUMENTS:
            for path, name in NAMED.findall(document.read_text(encoding="utf-8")):
                if "/" not in path and not name:
                    continue
                where = f"{document.relative_to(ROOT)} names {path}"
                self.assertTrue((ROOT / path).is_file(), where)
                if name:
                    defined = rf"^\s*(?:async )?(?:def|class) {name}\b|^(?:[A-Z_]+, )*{name}\b[^=\n]*="
                    text = (ROOT / path).read_text(encoding="utf-8")
                    self.assertTrue(re.search(defined, text, re.MULTILINE), f"{where}::{name}")

    def test_thesis_is_complete(self) -> None:
        """The page on the thesis has a row for each requirement, assumption and algorithm, and Figures 5.3 to 5.7."""
        text = (ROOT / "docs" / "thesis.md").read_text(encoding="utf-8")
        chapters = {part.splitlines()[0].split(" ")[0]: part for part in text.split("\n## ")[1:]}
        for chapter, numbers in (("Requirements", range(1, 10)), ("Assumptions", range(1, 6))):
            for number in numbers:
                self.assertIn(f"\n| {number} | ", chapters[chapter])
        for number in range(1, 6):
            self.assertIn(f"\n| 4.{number} | ", chapters["Algorithms"])
        for number in range(3, 8):
            self.assertIn(f"(images/figure-5-{number}.png)", chapters["Figures"])

    def test_pictures_are_light(self) -> None:
        """No picture of the documents weighs more than 300 kB, and each is shown somewhere."""
        shown = " ".join(document.read_text(encoding="utf-8") for document in DOCUMENTS)
        for picture in sorted((ROOT / "docs" / "images").glob("*.png")):
            self.assertLess(picture.stat().st_size, 300_000, picture.name)
            self.assertTrue(f"images/{picture.name}" in shown, f"no document shows {picture.name}")


class ExampleTests(SynchronousTestCase):
    def test_load(self) -> None:
        """Every example is a settings file without a fault, and names a driver and options that there are."""
        self.assertEqual([file.stem for file in EXAMPLES], ["dog1", "dog2", "dog3", "laptop-bootstrap", "sensor"])
        for file in EXAMPLES:
            settings = Settings.load(str(file))
            if settings.driver.kind:
                body = describe(settings.driver.kind, settings.driver.options, settings.node.name)
                self.assertIn("camera", body.capabilities)

    def test_belong_together(self) -> None:
        """All examples are of one team, and each knows the laptop at the address where it listens."""
        every = {file.stem: Settings.load(str(file)) for file in EXAMPLES}
        laptop = every.pop("laptop-bootstrap").node
        self.assertEqual(laptop.known_nodes, ())
        for settings in every.values():
            self.assertEqual(settings.node.team_secret, laptop.team_secret)
            self.assertEqual([(a.host, a.port) for a in settings.node.known_nodes], [(laptop.host, laptop.port)])
