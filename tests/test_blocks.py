"""The code blocks of the documentation: each command is parsed, each settings file validated, each program compiled."""

from __future__ import annotations

import argparse
import ast
import contextlib
import importlib
import inspect
import re
import shlex
import sys
import textwrap
import tomllib
from collections.abc import Callable, Iterator, Mapping
from functools import partial
from typing import Any, NamedTuple, NoReturn

from twisted.trial.unittest import SynchronousTestCase

from middleware.config.settings import TABLES, Settings
from middleware.errors import BadSetting
from middleware.faults.scenario import parse_scenario
from sim.team.command import KINDS
from sim.team.scenario import parse_scenario as parse_simulation
from swarmnode.command import main as swarm
from swarmnode.plugin import Options
from swarmnode.simulation import main as sim
from tests.test_docs import DOCUMENTS, ROOT

LANGUAGES = {"sh", "text", "toml", "python", "mermaid", "yaml", "ini", "nginx"}
FENCE = re.compile(r"^( *)```(\{?[a-z]*)[^\n]*\n(.*?)^\1```", re.M | re.S)
TARGETS = set(re.findall(r"^([a-z][\w-]*):", (ROOT / "Makefile").read_text(), re.M))
VARIABLES = set(re.findall(r"^([A-Z_]+) *[?:]?=", (ROOT / "Makefile").read_text(), re.M))


class Block(NamedTuple):
    """A code block: its document and line, its language and its text."""

    place: str
    language: str
    text: str


class Parsed(Exception):
    """A command line was accepted; the command itself must not run."""


def find_blocks(*languages: str) -> Iterator[Block]:
    """Yield the code blocks in these languages, or all code blocks if no language is given."""
    for document in DOCUMENTS:
        text = document.read_text(encoding="utf-8")
        for match in FENCE.finditer(text):
            if match.group(2) in languages or not (languages or match.group(2).startswith("{")):
                indent = match.group(1)
                lines = [line.removeprefix(indent) for line in match.group(3).split("\n")]
                line = text.count("\n", 0, match.start()) + 1
                yield Block(f"{document.relative_to(ROOT)}:{line}", match.group(2), "\n".join(lines))


def split_commands(text: str) -> Iterator[list[str]]:
    """Yield the commands of a shell block as words, without assignments, redirections and comments.

    Optional words in brackets are included: ``make demo [SEED=1]``.
    """
    for line in re.sub(r"\[([^\[\]]+)\]", r"\1", text.replace("\\\n", " ")).split("\n"):
        for command in re.split(r"\s(?:&&|\|\|?|;|&)(?=\s|$)|;\s", line):
            words = shlex.split(re.sub(r"\s[0-9]?>{1,2}\s*\S+|<\s*\S+", "", command), comments=True)
            while words and (re.match(r"[A-Z_]+=", words[0]) or words[0] in ("sudo", "exec", "nohup")):
                del words[0]
            if words:
                yield words


def parse_make(words: list[str]) -> None:
    """Check the targets and variables of a ``make`` command."""
    for word in words:
        name, is_variable, _ = word.partition("=")
        if name not in (VARIABLES if is_variable else TARGETS):
            raise ValueError(f"the Makefile has no {name}")


def parse_twistd(words: list[str]) -> None:
    """Check the options of ``twistd ... swarm-node ...``."""
    known = {f"--{name}" for name, *_ in Options.optParameters} | {"--help"}
    for word in words[words.index("swarm-node") :] if "swarm-node" in words else ():
        if word.startswith("--") and word.partition("=")[0] not in known:
            raise ValueError(f"twistd swarm-node has no {word}")


def parse_module(words: list[str]) -> None:
    """Check the options of ``python -m MODULE ...`` for the modules of this project."""
    if words[:1] == ["-m"] and words[1].partition(".")[0] in ("benchmarks", "sim", "tests", "swarmnode"):
        module = importlib.import_module(words[1])
        if hasattr(module, "__path__"):
            module = importlib.import_module(f"{words[1]}.__main__")
        run, sys.argv = module.main, words[1:]
        run(words[2:]) if inspect.signature(run).parameters else run()


PARSERS: dict[str, Callable[[list[str]], Any]] = {
    "swarm": swarm,
    "sim": sim,
    "make": parse_make,
    "twistd": parse_twistd,
    "python": parse_module,
    "python3": parse_module,
}


def merge_tables(first: Mapping[str, Any], second: Mapping[str, Any]) -> dict[str, Any]:
    """Return the tables of both files; keys of the second one replace those of the first one."""
    merged = dict(first)
    for name, table in second.items():
        merged[name] = {**first.get(name, {}), **table} if isinstance(table, dict) else table
    return merged


def find_problems(block: Block, content: dict[str, Any]) -> list[str]:
    """Return, for each kind of file, the problem of a TOML block as such a file; it is empty if the block is valid."""
    named: dict[str, dict[str, Any]] = {"node": {"name": "dog1"}}
    readers: list[Callable[[], object]] = [
        lambda: Settings.from_mapping(merge_tables(named, content), "node.toml"),
        lambda: parse_scenario(content, "scenario.toml"),
        lambda: parse_simulation(
            block.text, "team.toml", "team", {name: kind.settings for name, kind in KINDS.items()}
        ),
        *(partial(Settings.from_mapping, merge_tables(named, {table: content}), "node.toml") for table in TABLES),
    ]
    problems = []
    for read in readers:
        try:
            read()
            problems.append("")
        except BadSetting as error:
            problems.append(str(error))
    return problems


class BlockTest(SynchronousTestCase):
    """The fenced code blocks of all documents."""

    maxDiff = None

    def test_blocks_name_their_language(self) -> None:
        """Each code block has a language, so that a reader and this test know whether to run it."""
        wrong = [(block.place, block.language) for block in find_blocks() if block.language not in LANGUAGES]
        self.assertEqual(wrong, [])

    def test_commands_are_accepted(self) -> None:
        """Each command line in the shell blocks is accepted by the argument parser of its command."""

        def stop(parser: argparse.ArgumentParser, *words: Any, **options: Any) -> NoReturn:
            parse(parser, *words, **options)
            raise Parsed

        parse, wrong, count = argparse.ArgumentParser.parse_args, [], 0
        self.patch(argparse.ArgumentParser, "parse_args", stop)
        self.patch(sys, "argv", [])
        for block in find_blocks("sh"):
            for words in split_commands(block.text):
                if parser := PARSERS.get(words[0].rpartition("/")[2]):
                    count += 1
                    try:
                        with contextlib.suppress(Parsed):
                            parser(words[1:])
                    except (SystemExit, Exception) as error:
                        wrong.append(f"{block.place}: {shlex.join(words)}: {type(error).__name__} {error}")
        self.assertEqual(wrong, [])
        self.assertGreater(count, 100)

    def test_settings_are_valid(self) -> None:
        """Each TOML block is valid: settings of a node or keys of one of its tables, a scenario, or a table of robots.

        ``tests.test_docs`` validates the tables of robots.
        """
        for block in find_blocks("toml"):
            content = tomllib.loads(block.text)
            if not all(re.fullmatch(r"dog\d", name) for name in content):
                problems = find_problems(block, content)
                self.assertIn("", problems, f"{block.place}: {problems}")

    def test_programs_compile(self) -> None:
        """Each Python block is a program or a part of one.

        ``tests.live.test_examples`` runs the program in the README.
        """
        for block in find_blocks("python"):
            compile(textwrap.dedent(block.text), block.place, "exec", ast.PyCF_ALLOW_TOP_LEVEL_AWAIT)
