"""Tests of the page's texts: the catalogue of each language, and the modules and the template that use its keys."""

from __future__ import annotations

import json
import re
from collections.abc import Iterator
from typing import Any

from twisted.trial.unittest import SynchronousTestCase

from tests.webnode.texts import ROOM, catalogue

STATIC = ROOM / "static"
MODULES = {path.name: path.read_text() for path in sorted(STATIC.glob("*.js"))}
TEMPLATE = (ROOM / "templates" / "index.html").read_text()
LITERAL = re.compile(r'"((?:[^"\\\n]|\\.)*)"')
KEY = re.compile(r"[a-z]+(\.[A-Za-z_-]+)+")
FAMILY = re.compile(r"""textOf\("([a-z.]+)"|text\(`([a-z.]+)\.\$\{""")
CODE = re.compile(
    r"(?:\b(?:class|d|for|href|id|rel|role|type|viewBox)\"?: "
    r"|(?:querySelector(?:All)?|closest|closest\?\.|matchMedia|matches)\()$"
)
"""Matches the code in front of a string if the string is a CSS class, an attribute or a selector."""
NO_TEXT = {
    " KiB": "a unit",
    " MiB": "a unit",
    " cm": "a unit",
    " km": "a unit",
    "Android (Chrome)": "the name of a product",
    "iPhone, iPad (Safari)": "the name of a product",
    "Enter": "a key of the keyboard",
    "ArrowDown": "a key of the keyboard",
    "Authorization": "a header",
    "Bearer": "a header's value",
    "goes on": "a code of the API",
    "has no robot": "a code of the API",
    "light dark": "a value of the property color-scheme",
    "swarm revoke ": "a command",
}
"""The strings that look like text shown to users but are not translated, with the reason."""


def forms(text: Any) -> list[str]:
    """Return the plural forms of a text; a text without plural forms has one form."""
    return list(text.values()) if isinstance(text, dict) else [text]


def strings(source: str) -> Iterator[tuple[str, str]]:
    """Yield each string, and each constant part of a template string, in a module, with the code in front of it."""
    at = start = 0
    depths: list[int] = []  # the depth of braces in each open template string
    while at < len(source):
        char = source[at]
        is_in_template = bool(depths) and depths[-1] == 0
        if is_in_template:
            if char == "\\":
                at += 1
            elif source.startswith("${", at) or char == "`":
                yield source[start:at], source[:start]
                at += char == "$"
                depths[-1] = 1
                if char == "`":
                    depths.pop()
        elif source.startswith("//", at):
            at = source.index("\n", at)
        elif char == '"':
            found = LITERAL.match(source, at)
            if found is not None:
                yield found[1], source[:at]
                at = found.end() - 1
        elif char == "`":
            depths.append(0)
            start = at + 1
        elif depths and char in "{}":
            depths[-1] += 1 if char == "{" else -1
            start = at + 1
        at += 1


def is_text(string: str) -> bool:
    """Return whether a string looks like text shown to users.

    Such a string has two consecutive words, is a capitalised word, or begins with a space or punctuation followed by a
    word, as if it continued a sentence.
    """
    found = (
        re.search(r"[A-Za-z]{2,}[,.:;]? \(?[A-Za-z]{2,}", string)
        or re.fullmatch(r"[A-Z][a-z]+[.:\N{HORIZONTAL ELLIPSIS}]?", string)
        or re.match(r"[,;:]? [A-Za-z]{2,}", string)
    )
    return found is not None


class TextsTests(SynchronousTestCase):
    def setUp(self) -> None:
        self.english = catalogue("en")
        source = MODULES["texts.js"]
        listed = re.search(r"^const LANGUAGES = (\[.*\]);", source, re.MULTILINE)
        assert listed is not None
        self.languages: list[str] = json.loads(listed[1])

    def test_languages(self) -> None:
        """The catalogues match the languages of the page.

        Each has the keys and placeholders of the English catalogue.
        """
        self.assertEqual(sorted(path.stem for path in (STATIC / "texts").iterdir()), sorted(self.languages))
        for language in self.languages:
            texts = catalogue(language)
            self.assertEqual(sorted(texts), sorted(self.english), language)
            for key, text in texts.items():
                wanted = {name for form in forms(self.english[key]) for name in re.findall(r"\{(\w+)\}", form)}
                for form in forms(text):
                    self.assertEqual(set(re.findall(r"\{(\w+)\}", form)) | {"count"}, wanted | {"count"}, key)
                    self.assertTrue(form.strip(), key)
                if isinstance(text, dict):
                    self.assertIn("other", text, key)

    def test_keys(self) -> None:
        """Each key that a module or the template uses is in the catalogue, and each key in the catalogue is used."""
        source = "\n".join(MODULES.values())
        named = {each for text in (source, TEMPLATE) for each in LITERAL.findall(text) if KEY.fullmatch(each)}
        groups = {key.rpartition(".")[0] for key in self.english}
        families = {first or second for first, second in FAMILY.findall(source)}
        self.assertEqual(families - groups, set())
        families |= named & groups
        called = set(re.findall(r"""\btext\("([^"]+)"|data-text(?:-\w+)?="([^"]+)\"""", source + TEMPLATE))
        self.assertEqual({first or second for first, second in called} - set(self.english), set())
        begun = {key.partition(".")[0] for key in self.english}
        others = {"position.lat", "position.lon", "position.accuracy", "target.bearing", "target.distance"}
        unknown = {key for key in named if key.partition(".")[0] in begun} - set(self.english) - families - others
        self.assertEqual(unknown, set())
        dynamic = {key for key in self.english if key.rpartition(".")[0] in families}
        self.assertEqual(set(self.english) - named - dynamic, set())

    def test_no_text_in_modules(self) -> None:
        """No module contains text shown to users; such text is in the catalogue."""
        for name, source in MODULES.items():
            for string, before in strings(source):
                if is_text(string) and string not in NO_TEXT and not CODE.search(before[-40:]):
                    self.fail(f"{name}: {string!r} must be moved to texts/en.js")

    def test_no_text_in_template(self) -> None:
        """The template contains no text except the page's name and the notice for browsers without JavaScript."""
        body = re.sub(r"<noscript>.*</noscript>|\{\{.*?\}\}|\{%.*?%\}", "", TEMPLATE, flags=re.DOTALL)
        texts = {text.strip() for text in re.findall(r">([^<>]*)<", body)} - {""}
        self.assertEqual(texts, {"Swarm"})
        self.assertEqual(re.findall(r' (?:title|aria-label|placeholder)="[^"]', body), [])

    def test_find_text(self) -> None:
        """The scan of the modules finds texts in strings and in template strings, including nested ones."""
        source = 'f("No devices", `${n} of ${a ? `in all there` : "Done"} and that`); // "Not this"\n'
        self.assertEqual(
            [each for each, _ in strings(source) if is_text(each)],
            ["No devices", " of ", "in all there", "Done", " and that"],
        )
