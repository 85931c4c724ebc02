"""Convert: what TOML or a command line gave, to the type that the field of a dataclass declares.

``msgspec`` checks types and constraints (``Annotated[int, Meta(ge=0, le=65535)]``); this module turns its errors into
``Invalid``, with the key, the problem and the remedy.  Dataclasses and not ``msgspec.Struct``, because a dataclass can
leave a secret out of its ``repr``.
"""

from __future__ import annotations

import json
import re
from collections.abc import Callable, Iterable, Mapping
from dataclasses import MISSING, Field, dataclass, fields
from typing import Any, Literal, TypeVar, get_args, get_origin, get_type_hints

from msgspec import Meta, MsgspecError, convert

T = TypeVar("T")
MAX_SHOWN = 60
FINITE = Meta(ge=-1.7e308, le=1.7e308)
"""Any number but NaN and the infinities."""


class Invalid(Exception):
    """A value that its field does not allow."""

    def __init__(self, key: str, problem: str, remedy: str) -> None:
        super().__init__(key, problem, remedy)
        self.key = key
        self.problem = problem
        self.remedy = remedy


@dataclass(frozen=True)
class Then:
    """A step after the conversion: return the value to use, or raise ``ValueError``.

    ``raw`` is the type of the value before this step, where the field has another one.
    """

    apply: Callable[[Any], Any]
    raw: Any = None


@dataclass(frozen=True)
class Unit:
    """The unit of a number, for errors."""

    name: str


@dataclass(frozen=True)
class Secret:
    """Marks a value that no error shows."""


def check_printable(value: Any) -> Any:
    """Return ``value`` if it is no text, or all its characters are printable."""
    if isinstance(value, str) and not value.isprintable():
        raise ValueError("has a line break or another character that cannot be printed")
    return value


LINE = Then(check_printable)
UNIQUE = Then(lambda items: tuple(dict.fromkeys(items)))
"""Leaves repeated entries of a list out."""


def convert_table(table: object, cls: type[T]) -> T:
    """Convert a table to the dataclass ``cls``; raises ``Invalid``, with an empty key where it is no table."""
    if not isinstance(table, Mapping):
        raise Invalid("", f"must be a table, is {show_value(table)}", "write { key = value }")
    known = {field.name: field for field in fields(cls)}  # type: ignore[arg-type]
    for key in table:
        if key not in known:
            raise Invalid(str(key), "is unknown", f"{nearest_of(str(key), known)}known are {', '.join(known)}")
    hints = get_type_hints(cls, include_extras=True)
    values = {key: _convert(value, hints[key], known[key], False) for key, value in table.items()}
    for key, field in known.items():
        if key not in values and field.default is MISSING and field.default_factory is MISSING:
            raise Invalid(key, f"is missing, and must be {_expected_by(hints[key])}", _remedy_for(hints[key], None))
    return cls(**values)


def convert_field(value: object, cls: type[Any], key: str, is_text: bool = False) -> Any:
    """Convert ``value`` to the type of one field of the dataclass ``cls``; raises ``Invalid``.

    ``is_text``: it is a word of a command line, where lists are separated by commas.
    """
    field = next(field for field in fields(cls) if field.name == key)
    return _convert(value, get_type_hints(cls, include_extras=True)[key], field, is_text)


def _convert(value: object, hint: Any, field: Field[Any], is_text: bool) -> Any:
    extra = getattr(hint, "__metadata__", ())
    steps = [each for each in extra if isinstance(each, Then)]
    raw = next((step.raw for step in steps if step.raw is not None), hint)
    try:
        if is_text and get_origin(_base_of(raw)) is tuple:
            value = [word.strip() for word in str(value).split(",") if word.strip()]
        result = convert(value, raw, strict=not is_text)
        for step in steps:
            result = step.apply(result)
        return result
    except (MsgspecError, ValueError) as error:
        expected, remedy = _expected_by(hint), _remedy_for(hint, field.default)
        if any(isinstance(each, Secret) for each in extra):
            raise Invalid(field.name, f"must be {expected} (its value is not shown)", remedy) from None
        problem = _problem_of(error, value)
        raise Invalid(field.name, f"{problem}, but must be {expected}", remedy) from None


def show_value(value: object) -> str:
    """``value`` as an error shows it: on one line, and not too long."""
    text = json.dumps(value, default=str, ensure_ascii=False)
    return text if len(text) <= MAX_SHOWN else text[: MAX_SHOWN - 3] + "..."


def nearest_of(word: str, known: Iterable[str]) -> str:
    """The beginning of a remedy that names the nearest known word; empty where none is near."""
    from difflib import get_close_matches  # only a mistake needs it

    near = get_close_matches(word[:64], list(known), n=1, cutoff=0.5)
    return f"the nearest is {near[0]}; " if near else ""


def _base_of(hint: Any) -> Any:
    return get_args(hint)[0] if hasattr(hint, "__metadata__") else hint


def _problem_of(error: Exception, value: object) -> str:
    """What is wrong with ``value``: the innermost entry at the path that ``msgspec`` names, such as ``$[1].kind``."""
    text = str(error)
    if not isinstance(error, MsgspecError):
        return text or f"is {show_value(value)}"
    path = re.search(r" - at `(?:key in `)?\$([^`]*)`", text)
    place = ""
    for name, number in re.findall(r"\.(\w+)|\[(\d+)\]", path[1] if path else ""):
        if isinstance(value, Mapping) and name in value:
            value, place = value[name], f"{place}.{name}"
        elif number and isinstance(value, list | tuple):
            value, place = value[int(number)], f"{place}[{number}]"
    unknown = re.match(r"Object .* field `.*?`", text)
    problem = unknown[0].lower().replace("object", "a table") if unknown else f"is {show_value(value)}"
    return f"{place.lstrip('.')} {problem}".strip()


def _expected_by(hint: Any) -> str:
    """What a type allows, for people."""
    extra = getattr(hint, "__metadata__", ())
    metas = [each for each in extra if isinstance(each, Meta)]
    for meta in metas:
        if meta.description:
            return meta.description
    base, unit = _base_of(hint), "".join(f" {each.name}" for each in extra if isinstance(each, Unit))
    if get_origin(base) is Literal:
        return f"one of {', '.join(map(json.dumps, get_args(base)))}"
    if get_origin(base) is tuple:
        most = next((f" of at most {meta.max_length} entries" for meta in metas if meta.max_length), "")
        return f"a list{most}, each {_expected_by(get_args(base)[0])}"
    name = {bool: "true or false", int: "a whole number", float: "a number", str: "text"}.get(base, "a table")
    bounds = {"ge": "from", "gt": "above", "le": "to", "lt": "below", "pattern": "that matches"}
    limits = [
        f" {word} {limit:g}" if isinstance(limit, int | float) and limit < 1e6 else f" {word} {limit}"
        for meta in metas
        if meta is not FINITE
        for bound, word in bounds.items()
        if (limit := getattr(meta, bound)) is not None
    ]
    lengths = [f" of {meta.min_length or 0} to {meta.max_length} characters" for meta in metas if meta.max_length]
    return name + "".join([*limits, unit, *lengths])


def _remedy_for(hint: Any, default: object) -> str:
    for meta in getattr(hint, "__metadata__", ()):
        if isinstance(meta, Meta) and meta.examples:
            default = meta.examples[0]
    # TOML writes texts, numbers, truth values and lists as JSON does.
    has_example = isinstance(default, bool | int | float | str | list | tuple) and default not in ("", ())
    return f"write, for example, {json.dumps(default)}" if has_example else "write such a value, or leave it out"
