"""Docstrings, comments and documentation are plain technical English, and use the terms of ``docs/glossary.md``."""

from __future__ import annotations

import ast
import io
import re
import subprocess
import tokenize
from collections.abc import Iterator
from pathlib import Path

from twisted.trial.unittest import SynchronousTestCase

ROOT = Path(__file__).resolve().parent.parent
GLOSSARY = ROOT / "docs" / "glossary.md"

RULES = {
    r"who(?:m|so)?ever|whichever": "name the actor: the holder, the sender, the node",
    r"(?:no|some|any)body": "name the actor: no node, a peer, a client",
    r"(?<=[.;:(] )[Ww]ho (?!is\b)\w+": "name the actor: the node that ...",
    r"anew|once more|henceforth|ever since|from then on": "again, since",
    r"(?:is|are|was|were|be) (?:there )?no more|any more(?! than)": "no longer",
    r"shall|lest|thereof|wherein|whereof|herein|therein|thereby|hereby|beside": "must, of it, in it, next to",
    r"in (?:its|their|his|her) stead": "instead of it",
    r"of (?:one's|his|ours|theirs)(?: own)?": "own X, the X of ...",
    r"(?:is|are|was|were) (?:told|asked|said) (?:to|by|of|so|again)": "use the active verb with its subject",
    r"on purpose|might well|as it were|so to speak|for good and all": "deliberately, can",
    r"(?<=[.:] )What (?:is|was|are|were|has|had|it|they|a|the)\b[^?\n]*(?=[.\n])": "name the thing, not 'what ...'",
}
"""Regular expressions of phrases that have to be read twice, each with its replacement."""

EXCEPTIONS = {
    "CHANGELOG.md": "tells the history, with the names of its time",
    "docs/glossary.md": "lists the words that are not used",
}
"""The files that may break a rule, each with the reason."""

Found = tuple[str, int, str, str]


def read_terms(text: str) -> dict[str, str]:
    """Return the table *Words that are not used* of the glossary: regular expression -> term."""
    section = text.split("## Words that are not used", 1)[-1].split("\n## ", 1)[0]
    rows = re.findall(r"^\| (?!not used|---)([^|]+) \| ([^|]+) \|$", section, re.M)
    return {
        "|".join(re.escape(word.strip()) + "s?" for word in words.split(",")): f"the term is {term.strip()}"
        for words, term in rows
    }


def read_python(text: str) -> Iterator[tuple[int, str]]:
    """Yield the docstrings and comments of a Python file, each with its line number."""
    for node in ast.walk(ast.parse(text)):
        if isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant) and isinstance(node.value.value, str):
            yield node.lineno, node.value.value
    for token in tokenize.generate_tokens(io.StringIO(text).readline):
        if token.type == tokenize.COMMENT and not re.match(r"#\s*(?:type:|noqa|pragma|!)", token.string):
            yield token.start[0], token.string.lstrip("# ")


def read_markdown(text: str) -> Iterator[tuple[int, str]]:
    """Yield the lines of a Markdown file, excluding its code blocks and the targets of its links."""
    is_code = False
    for number, line in enumerate(text.split("\n"), 1):
        if line.lstrip().startswith("```"):
            is_code = not is_code
        elif not is_code and not line.startswith("    "):
            yield number, re.sub(r"\]\([^)]*\)", "]", line)


def read_script(text: str) -> Iterator[tuple[int, str]]:
    """Yield the comments of a JavaScript or CSS file."""
    for number, line in enumerate(text.split("\n"), 1):
        if comment := re.search(r"(?:^|\s)//(?!\s*@ts)(.*)|^\s*/?\*+(.*)", line):
            yield number, comment.group(1) or comment.group(2) or ""


READERS = {".py": read_python, ".md": read_markdown, ".js": read_script, ".css": read_script}


def find_phrases(name: str, text: str, rules: dict[str, str]) -> list[Found]:
    """Return the phrases of a file that break a rule: file, line, phrase and advice.

    Text in backticks is a name, not prose, and is not checked.
    """
    found = []
    for line, prose in READERS[Path(name).suffix](text):
        prose = re.sub(r"`+[^`]*`+", "X", prose)
        for rule, advice in rules.items():
            for match in re.finditer(rf"\b(?:{rule})\b", prose, re.I):
                found.append((name, line + prose.count("\n", 0, match.start()), match.group(), advice))
    return found


class ProseTest(SynchronousTestCase):
    """Tests of the texts in the source tree, and of the check itself."""

    def setUp(self) -> None:
        self.rules = RULES | read_terms(GLOSSARY.read_text())

    def test_rules_find_phrases(self) -> None:
        """Docstrings, comments and text are searched; code, code blocks and names in backticks are not."""
        examples = {
            "a.py": '"""Return the lease.\n\nWhoever holds it asks anew."""\nx = 1  # the lessee\n',
            "a.md": "The courier sends it.\n\n```\nnobody\n```\n\nSee [`anew`](anew.md).\n",
            "a.js": "let x = 1; // nobody\nlet y = 'anew'\n",
        }
        found = [
            (name, line, phrase)
            for name in examples
            for name, line, phrase, _ in find_phrases(name, examples[name], self.rules)
        ]
        self.assertEqual(
            found,
            [
                ("a.py", 3, "Whoever"),
                ("a.py", 3, "anew"),
                ("a.py", 4, "lessee"),
                ("a.md", 1, "courier"),
                ("a.js", 1, "nobody"),
            ],
        )

    def test_tree_breaks_no_rule(self) -> None:
        """No file under version control contains a phrase for which a rule has a replacement."""
        listed = subprocess.run(["git", "ls-files", "-z"], cwd=ROOT, capture_output=True, text=True, check=True)
        names = [name for name in listed.stdout.split("\0") if Path(name).suffix in READERS and (ROOT / name).exists()]
        self.assertGreater(len(names), 500)
        found = [each for name in names if name not in EXCEPTIONS for each in self.find_in_tree(name)]
        self.assertEqual(
            found, [], "\n" + "\n".join(f"{n}:{line}: {phrase!r}: {advice}" for n, line, phrase, advice in found)
        )

    def test_exceptions_are_needed(self) -> None:
        """Each exception is a file that breaks a rule."""
        self.assertEqual([name for name in EXCEPTIONS if not self.find_in_tree(name)], [])

    def find_in_tree(self, name: str) -> list[Found]:
        """Return the phrases of a file of the source tree that break a rule."""
        return find_phrases(name, (ROOT / name).read_text(), self.rules)
