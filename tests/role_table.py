"""Write the role table of docs/explanation/trust-model.md: ``python -m tests.role_table``."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from pathlib import Path

from middleware.admission.roles import METHODS, NAMESPACES, OTHER_METHODS, ROLES

PAGE = Path(__file__).parents[1] / "docs" / "explanation" / "trust-model.md"
BEGIN, END = "<!-- role table: python -m tests.role_table -->\n", "<!-- end of the role table -->\n"


def write_tables() -> str:
    """Return two tables: the roles that may write each namespace, and the roles that may call each group of methods."""
    head = f"| | {' | '.join(ROLES)} |\n|---|{'---|' * len(ROLES)}\n"
    namespaces = [(f"`{name}`: {each.text}", each.roles) for name, each in NAMESPACES.items()]
    return f"{BEGIN}\n| namespace {head[2:]}{_rows(namespaces)}\n| method {head[2:]}{_rows(_group(METHODS))}\n{END}"


def _group(methods: Mapping[str, frozenset[str]]) -> list[tuple[str, frozenset[str]]]:
    """Group the methods that the same roles may call."""
    groups: dict[frozenset[str], list[str]] = {}
    for name, roles in methods.items():
        groups.setdefault(roles, []).append(f"`{name}`")
    groups.setdefault(frozenset(OTHER_METHODS), []).append("methods that a program exposes in addition")
    return [(", ".join(names), roles) for roles, names in groups.items()]


def _rows(rows: Collection[tuple[str, Collection[str]]]) -> str:
    return "".join(f"| {text} | {' | '.join('yes' if r in roles else '' for r in ROLES)} |\n" for text, roles in rows)


def main() -> None:
    """Replace the tables in the page."""
    text = PAGE.read_text(encoding="utf-8")
    before, rest = text.split(BEGIN, 1)
    PAGE.write_text(before + write_tables() + rest.split(END, 1)[1], encoding="utf-8")


if __name__ == "__main__":
    main()
