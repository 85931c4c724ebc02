"""Tests of the documentation: links, names, numbers and tables agree with the code, and the examples are valid."""

from __future__ import annotations

import re
import tomllib
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path
from random import Random

from twisted.internet.task import Clock
from twisted.trial.unittest import SynchronousTestCase

from drivers.errors import UsageError
from drivers.registry import describe, list_built_in_kinds
from middleware.config.settings import Settings
from sim.demo.configuration import DOGS
from sim.demo.robots import ROBOT_SETS
from sim.robots import scene
from sim.robots.emulated_robots import EmulatedRobots, emulated_kinds
from sim.robots.simulator import RobotSimulator
from tests.layers import TOP, write_table
from tests.role_table import write_tables

ROOT = Path(__file__).parents[1]
DOCUMENTS = [
    ROOT / "README.md",
    ROOT / "CONTRIBUTING.md",
    *sorted((ROOT / "docs").rglob("*.md")),
    ROOT / "benchmarks" / "README.md",
]
LINK = re.compile(r"\[[^\]]*\]\(([^)\s]+)\)")
NAMED = re.compile(r"`([\w./-]+\.(?:py|toml|json|md))(?:::(\w+))?`")
EXAMPLES = sorted((ROOT / "examples").glob("*.toml"))
MARKED = re.compile(r"(\d[\d.,]*)<!-- ([^>]+) -->")
"""A number in a document, followed by the expression in the code that must have this value."""


def value_of(expression: str) -> float:
    """Return the value of an expression whose names include their modules, such as ``1000 * agents.loop.TICK``."""
    names: dict[str, object] = {"len": len, "max": max, "min": min}
    for path in re.findall(rf"\b(?:{'|'.join(TOP)})(?:\.\w+)+", expression):
        parts = path.split(".")
        names[parts[0]] = import_module(parts[0])
        for length in range(2, len(parts)):
            module = ".".join(parts[:length])
            if find_spec(module) is None:
                break
            import_module(module)
            if not hasattr(import_module(module), "__path__"):
                break
    return float(eval(expression, names))


def part_of(document: Path, title: str) -> str:
    """Return the text below the heading ``title``, up to the next heading."""
    parts = document.read_text(encoding="utf-8").split("\n## ")
    (found,) = (part for part in parts if part.splitlines()[0] == title)
    return found


class DocumentTests(SynchronousTestCase):
    def test_links_lead_somewhere(self) -> None:
        """Each relative link or picture in the documentation refers to an existing file or folder."""
        for document in DOCUMENTS:
            for target in LINK.findall(document.read_text(encoding="utf-8")):
                if not re.match(r"https?:|mailto:|#", target):
                    place = document.parent / target.partition("#")[0]
                    self.assertTrue(place.exists(), f"{document.relative_to(ROOT)} links to {target}")

    def test_named_files_exist(self) -> None:
        """Each file path in a document refers to an existing file, which defines the name that follows the path."""
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

    def test_numbers_are_those_of_the_code(self) -> None:
        """A number with a marker equals the value of the expression in the marker."""
        marked = [(page, *found) for page in DOCUMENTS for found in MARKED.findall(page.read_text(encoding="utf-8"))]
        self.assertGreater(len(marked), 100)
        for page, number, expression in marked:
            said, value = float(number.replace(",", "").rstrip(".")), value_of(expression)
            is_same = abs(said - value) <= 1e-3 * max(abs(said), abs(value))
            self.assertTrue(is_same, f"{page.relative_to(ROOT)} says {number}; {expression} is {value:g}")

    def test_role_tables_are_those_of_the_code(self) -> None:
        """The tables of roles on the security page are the output of ``tests.role_table``."""
        self.assertIn(write_tables(), (ROOT / "docs" / "explanation" / "trust-model.md").read_text(encoding="utf-8"))

    def test_layers_are_those_of_the_tests(self) -> None:
        """The table of packages on the architecture page is the one that ``tests.layers`` generates."""
        self.assertIn(write_table(), (ROOT / "docs" / "explanation" / "architecture.md").read_text(encoding="utf-8"))

    def test_every_robot_is_listed(self) -> None:
        """The table in the README lists exactly the kinds of drivers, each with a link to the page of the kind."""
        table = part_of(ROOT / "README.md", "Robots")
        rows = re.findall(r"^\| `(\w+)` \|.*\[[\w-]+\.md\]\(docs/([\w./-]+)\) \|$", table, re.MULTILINE)
        self.assertEqual(sorted(kind for kind, _ in rows), list_built_in_kinds())
        for kind, page in rows:
            self.assertIn(f"`{kind}`", (ROOT / "docs" / page).read_text(encoding="utf-8"))

    def test_every_cast_is_listed(self) -> None:
        """The demonstration's page and ``make help`` list exactly the valid values of ROBOT, with the same default."""
        rows = re.findall(
            r"^\| `(\w+)`", part_of(ROOT / "docs" / "tutorials" / "demo.md", "Which robots"), re.MULTILINE
        )
        self.assertEqual(sorted(rows), sorted(ROBOT_SETS))
        makefile = (ROOT / "Makefile").read_text(encoding="utf-8")
        self.assertIn(f"[ROBOT={'|'.join(sorted(ROBOT_SETS))}]", makefile)
        (default,) = re.findall(r"^ROBOT +\?= (\w+)$", makefile, re.MULTILINE)
        self.assertIn(f"| `{default}` (default) |", part_of(ROOT / "docs" / "tutorials" / "demo.md", "Which robots"))

    def test_emulators_serve_the_tables_of_their_pages(self) -> None:
        """The simulator accepts the example table on its page, and on the page of each kind with an emulator."""
        clock = Clock()
        for page in ("how-to/simulate-robots", *(f"robots/{kind}" for kind in emulated_kinds())):
            played: set[str] = set()
            text = (ROOT / "docs" / f"{page}.md").read_text(encoding="utf-8")
            for block in re.findall(r"^```toml\n(.*?)^```$", text, re.MULTILINE | re.DOTALL):
                table = tomllib.loads(block)
                if not set(table) <= set(DOGS):
                    continue
                EmulatedRobots(
                    clock, Random(1), RobotSimulator(clock, Random(1), scene.load_scene("three-dogs")), table
                )
                for robot in table.values():
                    played |= {robot["kind"], *(part["kind"] for part in robot.get("parts", []))}
            self.assertIn("create2" if page == "how-to/simulate-robots" else page.removeprefix("robots/"), played)
        with self.assertRaises(UsageError) as refused:
            EmulatedRobots(
                clock,
                Random(1),
                RobotSimulator(clock, Random(1), scene.load_scene("three-dogs")),
                {"dog1": {"kind": "phone"}},
            )
        self.assertTrue(str(refused.exception).endswith(f"it has {', '.join(emulated_kinds())}"), refused.exception)

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
        """Each picture in the documentation has at most 300 kB, and is used in a document."""
        shown = " ".join(document.read_text(encoding="utf-8") for document in DOCUMENTS)
        for picture in sorted((ROOT / "docs" / "images").iterdir()):
            self.assertLess(picture.stat().st_size, 300_000, picture.name)
            self.assertTrue(f"images/{picture.name}" in shown, f"no document shows {picture.name}")


class ExampleTests(SynchronousTestCase):
    def test_load(self) -> None:
        """Each example is a valid settings file with a known driver and valid options."""
        self.assertEqual([file.stem for file in EXAMPLES], ["dog1", "dog2", "dog3", "laptop-bootstrap", "sensor"])
        for file in EXAMPLES:
            settings = Settings.load(str(file))
            if settings.driver.kind:
                body = describe(settings.driver.kind, settings.driver.options, settings.node.name)
                self.assertIn("camera", body.capabilities)

    def test_belong_together(self) -> None:
        """All example settings belong to one team and contain the laptop's address."""
        every = {file.stem: Settings.load(str(file)) for file in EXAMPLES}
        laptop = every.pop("laptop-bootstrap").node
        self.assertEqual(laptop.known_nodes, ())
        for settings in every.values():
            self.assertEqual(settings.node.team_secret, laptop.team_secret)
            self.assertEqual([(a.host, a.port) for a in settings.node.known_nodes], [(laptop.host, laptop.port)])
