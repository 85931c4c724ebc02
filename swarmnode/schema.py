"""``swarm schema``: print the JSON schema of a settings file, for editors that validate TOML by a schema."""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Sequence
from dataclasses import MISSING, fields
from typing import Any, TextIO, get_type_hints

import msgspec

from formats.convert import get_raw_type
from middleware.config.settings import TABLES


def make_json_schema() -> dict[str, Any]:
    """Return the schema; for some settings it allows values that their later conversion rejects."""
    tables = {name: _make_struct(name, cls) for name, cls in TABLES.items()}
    optional: list[tuple[str, Any, Any]] = [
        (name, table, msgspec.field(default_factory=dict)) for name, table in tables.items() if name != "node"
    ]
    struct = msgspec.defstruct("Settings", [("node", tables["node"]), *optional], forbid_unknown_fields=True)
    return msgspec.json.schema(struct)


def _make_struct(name: str, cls: type[Any]) -> type[Any]:
    hints = get_type_hints(cls, include_extras=True)
    known: list[tuple[Any, ...]] = []
    for each in fields(cls):
        default = each.default if each.default is not MISSING else None
        is_needed = each.default is MISSING is each.default_factory
        known.append((each.name, get_raw_type(hints[each.name]), *(() if is_needed else (default,))))
    return msgspec.defstruct(name, known, forbid_unknown_fields=True)


def main(words: Sequence[str] | None = None, out: TextIO | None = None) -> int:
    """Run the command; returns 0."""
    parser = argparse.ArgumentParser(
        prog="swarm schema",
        description="Print the JSON schema of a settings file, for editors that validate TOML by a schema.",
        epilog="Example: swarm schema > swarm-node.schema.json",
    )
    parser.parse_args(words)
    (out or sys.stdout).write(json.dumps(make_json_schema(), indent=2) + "\n")
    return 0
