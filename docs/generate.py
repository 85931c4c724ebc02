"""Write the reference pages that the code knows, and the columns of tables in other reference pages.

``docs/conf.py`` calls ``generate`` at each build.  The pages of the command line, the settings file and the Python API
are not kept in the repository.  In the pages of ``TABLES`` it updates the first columns of the table between ``BEGIN``
and ``END``; other columns and the text are kept.
"""

from __future__ import annotations

import ast
import inspect
import io
import os
import re
from collections.abc import Callable, Iterator, Sequence
from contextlib import redirect_stdout, suppress
from dataclasses import MISSING, Field, fields, is_dataclass
from pathlib import Path
from typing import Any

REFERENCE = Path(__file__).parent / "reference"
API = {
    "The peer-to-peer library": ("middleware.entangled.node", "middleware.entangled.space.tuplespace"),
    "A node of a team": ("middleware.node", "middleware.tasks.task", "middleware.directory.presence"),
    "Strategies": ("middleware.consensus.strategy", "middleware.consensus.conformance"),
    "Behaviours and agents": ("agents.behaviour", "agents.context", "agents.motion", "agents.loop"),
    "Drivers": ("drivers.driver", "drivers.reading", "drivers.base", "drivers.conformance"),
    "Errors": ("middleware.errors", "middleware.entangled.errors", "drivers.errors"),
}
"""The modules that a program may import, by purpose."""
BEGIN, END = "<!-- rows: docs/generate.py -->", "<!-- end of the rows -->"
UNPACKED_TYPES = {"Capabilities": "table of tables", "Mapping[str, float | str]": "table of numbers and texts"}
TYPE_WORDS = {"str": "text", "int": "integer", "float": "number", "bool": "boolean", "tuple[Contact, ...]": "contacts"}
Main = Callable[[Sequence[str]], Any]
Rows = dict[str, tuple[str, ...]]


def generate() -> None:
    """Write all pages."""
    REFERENCE.mkdir(exist_ok=True)
    pages = {"command-line": write_command_line, "settings": write_settings, "python-api": write_api}
    for name, write in pages.items():
        (REFERENCE / f"{name}.md").write_text(write(), encoding="utf-8")
    for name, list_rows in TABLES.items():
        page = REFERENCE / f"{name}.md"
        text = page.read_text(encoding="utf-8")
        if (updated := update_rows(text, list_rows())) != text:
            page.write_text(updated, encoding="utf-8")


def write_command_line() -> str:
    """Return the page of the commands ``swarm`` and ``sim``: the help text of each verb."""
    from swarmnode import command, simulation

    os.environ["COLUMNS"] = "100"
    parts = ["# Command line\n", "The help text of each command, as `swarm VERB --help` prints it.\n"]
    for program, main in (("swarm", command.main), ("sim", simulation.main)):
        for words, text in _help_of(main, ()):
            title = " ".join((program, *words))
            parts.append(f"{'#' * (2 + bool(words))} `{title}`\n\n```text\n{text.rstrip()}\n```\n")
    return "\n".join(parts)


def _help_of(main: Main, words: tuple[str, ...]) -> Iterator[tuple[tuple[str, ...], str]]:
    """Yield the help text of a command, then those of its verbs."""
    out = io.StringIO()
    with redirect_stdout(out), suppress(SystemExit):
        main([*words, "--help"])
    text = out.getvalue()
    yield words, text
    listed = text if not words else text.partition("positional arguments:")[2].partition("\noptions:")[0]
    verbs = re.findall(r"^ {2,4}([a-z]+)  +\S", listed, re.MULTILINE) if len(words) < 2 else []
    for verb in verbs:
        yield from _help_of(main, (*words, verb))


def write_settings() -> str:
    """Return the page of the settings file: each key with its type, range, default and meaning."""
    from middleware.config import settings
    from swarmnode.schema import make_json_schema

    tables = make_json_schema()["$defs"]
    lead = "A node reads its settings from one TOML file. `swarm schema` prints the JSON schema for editors.\n"
    parts = ["# Settings\n", lead]
    for cls in (kind for kind in vars(settings).values() if isinstance(kind, type) and is_dataclass(kind)):
        table = cls.__name__.removesuffix("Settings").lower()
        if cls.__name__ == "Settings" or table not in tables:
            continue
        parts.append(f"## `[{table}]`\n")
        told = _attribute_docstrings(cls)
        properties = tables[table]["properties"]
        for each in fields(cls):
            if each.name in properties:
                parts.append(f"### `{each.name}`\n\n{_kind_of(properties[each.name])}\n\n{told.get(each.name, '')}\n")
    return "\n".join(parts)


def _attribute_docstrings(cls: type) -> dict[str, str]:
    """Return the docstring that follows each attribute in the source of a class."""
    body = ast.parse(inspect.getsource(cls)).body[0].body  # type: ignore[attr-defined]
    found: dict[str, str] = {}
    for statement, after in zip(body, body[1:], strict=False):
        is_told = isinstance(after, ast.Expr) and isinstance(after.value, ast.Constant)
        if isinstance(statement, ast.AnnAssign) and isinstance(statement.target, ast.Name) and is_told:
            found[statement.target.id] = inspect.cleandoc(str(after.value.value)).replace("``", "`")
    return found


def _kind_of(schema: dict[str, Any]) -> str:
    """Return the type, range and default of one key as a line."""
    kind = " or ".join(str(each) for each in schema["enum"]) if "enum" in schema else schema.get("type", "table")
    words = [f"Type: {kind}"]
    for key, title in (("minimum", "at least"), ("maximum", "at most"), ("maxLength", "characters at most")):
        if key in schema:
            words.append(f"{title} {schema[key]}")
    default = schema.get("default")
    words.append("required" if "default" not in schema else f"default `{default!r}`" if default is not None else "")
    return ", ".join(word for word in words if word) + "."


def write_api() -> str:
    """Return the page that has Sphinx document the modules of ``API``."""
    parts = ["# Python API\n", "The names that programs may import, from the docstrings.\n"]
    for title, modules in API.items():
        parts.append(f"## {title}\n")
        for module in modules:
            parts.append(f"### `{module}`\n\n```{{eval-rst}}\n.. automodule:: {module}\n   :members:\n```\n")
    return "\n".join(parts)


def list_task_fields() -> Rows:
    """Return type and default of each field of a task."""
    from middleware.tasks.task import Task

    words = {**TYPE_WORDS, **UNPACKED_TYPES}
    return {each.name: (words.get(str(each.type), str(each.type)), _format_default(each)) for each in fields(Task)}


def _format_default(each: Field[Any]) -> str:
    """Return the default of a field as a cell of a table."""
    if each.default is MISSING:
        return "required" if each.default_factory is MISSING else "empty"
    return f"`{each.default!r}`" if each.default not in ("", b"", ()) else "empty"


def list_strategies() -> Rows:
    """Return for each built-in strategy whether it divides several tasks, and the fields of a report that it reads."""
    from middleware.consensus.strategy import BUILT_IN, find_read_fields, load_strategy

    loaded = {name: load_strategy(name) for name in BUILT_IN}
    return {
        name: (
            "several" if hasattr(strategy, "find_group") else "one",
            ", ".join(("cost", *find_read_fields(strategy))),
        )
        for name, strategy in loaded.items()
    }


def list_verbs() -> Rows:
    """Return the verbs of the control socket, and whether each sends events."""
    from middleware.entangled.control.request_handler import RequestHandler
    from swarmnode.team.verb import TeamVerbs

    node: Any = None
    verbs = RequestHandler(node, node, node, node)._find_handlers()
    known = (*verbs, "devices", *TeamVerbs(node, node)._find_handlers())
    return {name: ("events" if name.endswith(" watch") else "answer",) for name in known}


def update_rows(text: str, rows: Rows) -> str:
    """Return a page with the first columns of its table set to ``rows``; the other columns of each row are kept.

    A new row gets empty cells, and a row without an entry is removed.
    """
    before, begin, rest = text.partition(BEGIN)
    table, end, after = rest.partition(END)
    head, line, *old = table.strip().splitlines()
    columns = head.count(" | ") + 1
    split = ([cell.strip() for cell in row.strip("|").split("|")] for row in old)
    kept = {cells[0].strip("`"): cells for cells in split}
    new = []
    for name, cells in rows.items():
        known = kept.get(name, [])[1 + len(cells) :]
        blank = [""] * (columns - 1 - len(cells) - len(known))
        new.append(f"| {' | '.join([f'`{name}`', *cells, *known, *blank])} |")
    return "\n".join((before + begin, "", head, line, *new, "", end + after))


TABLES = {"tasks": list_task_fields, "strategies": list_strategies, "control-socket": list_verbs}
"""The rows of the tables in pages that are kept in the repository."""
