"""Convert values of TOML or a command line to the types of dataclass fields.

``msgspec`` checks types and constraints (``Annotated[int, Meta(ge=0, le=65535)]``); this module converts the errors of
``msgspec`` to ``InvalidValue``, with the key, the problem and the remedy. Dataclasses are used instead of
``msgspec.Struct`` because a dataclass can omit a secret from its ``repr``.
"""

from __future__ import annotations

import json
import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import MISSING, dataclass, fields
from typing import Annotated, Any, Literal, TypeVar, get_args, get_origin, get_type_hints

from msgspec import Meta, MsgspecError, convert

T = TypeVar("T")
MAX_SHOWN_CHARS = 60
FINITE = Meta(ge=-1.7e308, le=1.7e308)
"""Any number except NaN and the infinities."""


class InvalidValue(Exception):
    """A value that is invalid for its field."""

    def __init__(self, key: str, problem: str, remedy: str) -> None:
        super().__init__(key, problem, remedy)
        self.key = key
        self.problem = problem
        self.remedy = remedy


@dataclass(frozen=True)
class ConversionStep:
    """A step after the conversion: return the value to use, or raise ``ValueError``.

    ``raw`` is the type of the value before this step, if it differs from the type of the field.
    """

    apply: Callable[[Any], Any]
    raw: Any = None


@dataclass(frozen=True)
class Unit:
    """The unit of a number, for errors."""

    name: str


@dataclass(frozen=True)
class Secret:
    """Marks a secret value, which errors must not contain."""


def check_printable(value: Any) -> Any:
    """Return ``value`` if it is not a string, or all its characters are printable; else raise ``ValueError``."""
    if isinstance(value, str) and not value.isprintable():
        raise ValueError("has a line break or another character that cannot be printed")
    return value


PRINTABLE = ConversionStep(check_printable)


def one_of(words: Sequence[str]) -> ConversionStep:
    """Allow one of ``words``."""
    return ConversionStep(lambda word: word, raw=Literal[tuple(words)])


def some_of(words: Sequence[str]) -> ConversionStep:
    """Allow a list of at least one of ``words``, sorted in the order of ``words``."""
    word: Any = Literal[tuple(words)]
    raw = Annotated[tuple[word, ...], Meta(min_length=1)]
    return ConversionStep(lambda given: tuple(word for word in words if word in given), raw)


UNIQUE = ConversionStep(lambda items: tuple(dict.fromkeys(items)))
"""Removes duplicates from a list."""


def convert_table(table: object, cls: type[T]) -> T:
    """Convert a table to the dataclass ``cls``; raise ``InvalidValue``, with an empty key if it is not a table."""
    if not isinstance(table, Mapping):
        raise InvalidValue("", f"must be a table, is {show_value(table)}", "write { key = value }")
    known = {field.name: field for field in fields(cls)}  # type: ignore[arg-type]
    for key in table:
        if key not in known:
            raise InvalidValue(
                str(key), "is unknown", f"the nearest is {find_nearest(str(key), known)}; known are {', '.join(known)}"
            )
    hints = get_type_hints(cls, include_extras=True)
    values = {key: convert_value(value, hints[key], key, known[key].default) for key, value in table.items()}
    for key, field in known.items():
        if key not in values and field.default is MISSING and field.default_factory is MISSING:
            raise InvalidValue(key, "is missing", _make_remedy(hints[key]))
    return cls(**values)


def convert_field(value: object, cls: type[Any], key: str, is_text: bool = False) -> Any:
    """Convert ``value`` to the type of one field of the dataclass ``cls``, like ``convert_value``."""
    default = next(field.default for field in fields(cls) if field.name == key)
    return convert_value(value, get_type_hints(cls, include_extras=True)[key], key, default, is_text)


def convert_value(value: object, hint: Any, key: str = "", default: object = None, is_text: bool = False) -> Any:
    """Convert ``value`` to the type ``hint``; raise ``InvalidValue`` with ``key``, and with ``default`` as the example.

    With ``is_text`` the value is a command-line argument, in which commas separate the entries of a list.
    """
    extra = getattr(hint, "__metadata__", ())
    raw = get_raw_type(hint)
    try:
        if is_text and get_origin(_get_base_type(raw)) is tuple:
            value = [word.strip() for word in str(value).split(",") if word.strip()]
        if is_text and raw is bool:
            value = {"true": True, "false": False}.get(str(value), value)
        result = convert(value, raw, strict=not is_text or raw is bool)
        for step in extra:
            result = step.apply(result) if isinstance(step, ConversionStep) else result
        return result
    except (MsgspecError, ValueError) as error:
        if any(isinstance(each, Secret) for each in extra):
            raise InvalidValue(key, "is not allowed (its value is not shown)", _make_remedy(hint)) from None
        place, wrong = _locate_error(value, error)
        problem = str(error)
        if isinstance(error, MsgspecError) or not problem:
            unknown = re.match(r"Object .* field `.*?`", problem)
            problem = f"has {unknown[0][7:]}" if unknown else f"is {show_value(wrong)}"
        raise InvalidValue(key, f"{place} {problem}".strip(), _make_remedy(hint, default, wrong)) from None


def get_raw_type(hint: Any) -> Any:
    """Return the type of a value before its steps."""
    steps = [each for each in getattr(hint, "__metadata__", ()) if isinstance(each, ConversionStep)]
    return next((step.raw for step in steps if step.raw is not None), hint)


def show_value(value: object) -> str:
    """Return ``value`` as JSON for an error, truncated to ``MAX_SHOWN_CHARS`` characters."""
    text = json.dumps(value, default=str, ensure_ascii=False)
    return text if len(text) <= MAX_SHOWN_CHARS else text[: MAX_SHOWN_CHARS - 3] + "..."


def find_nearest(word: str, known: Iterable[str]) -> str:
    """Return the known word that is most similar to ``word``."""
    from difflib import get_close_matches  # imported only for an error

    return get_close_matches(word[:64], list(known), n=1, cutoff=0.0)[0]


def _get_base_type(hint: Any) -> Any:
    return get_args(hint)[0] if hasattr(hint, "__metadata__") else hint


def _locate_error(value: object, error: Exception) -> tuple[str, object]:
    """Return the place and value of the entry in an error of ``msgspec``, from a path such as ``$[1].kind``."""
    path = re.search(r" - at `(?:key in `)?\$([^`]*)`", str(error))
    place = ""
    for name, number in re.findall(r"\.(\w+)|\[(\d+)\]", path[1] if path else ""):
        if isinstance(value, Mapping) and name in value:
            value, place = value[name], f"{place}.{name}"
        elif number and isinstance(value, list | tuple):
            value, place = value[int(number)], f"{place}[{number}]"
    return place, value


def _describe_type(hint: Any) -> str:
    """Describe the values that a type allows, for errors."""
    extra = getattr(hint, "__metadata__", ())
    metas = [each for each in extra if isinstance(each, Meta)]
    for meta in metas:
        if meta.description:
            return meta.description
    if get_raw_type(hint) is not hint:
        return _describe_type(get_raw_type(hint))
    base, unit = _get_base_type(hint), "".join(f" {each.name}" for each in extra if isinstance(each, Unit))
    if get_origin(base) is Literal:
        return f"one of {', '.join(map(json.dumps, get_args(base)))}"
    if get_origin(base) in (list, tuple):
        most = next(
            (f" of {meta.min_length or 0} to {meta.max_length} entries" for meta in metas if meta.max_length), ""
        )
        entry = get_args(base)[0]
        return f"a list{most}" if entry is Any else f"a list{most}, each {_describe_type(entry)}"
    name = {bool: "true or false", int: "a whole number", float: "a number", str: "text"}.get(base, "a table")
    bounds = {"ge": "from", "gt": "above", "le": "to", "lt": "below", "pattern": "that matches"}
    limits = [
        f" {word} {limit:.15g}" if isinstance(limit, float) else f" {word} {limit}"
        for meta in metas
        if meta is not FINITE
        for bound, word in bounds.items()
        if (limit := getattr(meta, bound)) is not None
    ]
    lengths = [f" of {meta.min_length or 0} to {meta.max_length} characters" for meta in metas if meta.max_length]
    return name + "".join([*limits, unit, *lengths])


def _make_remedy(hint: Any, default: object = None, wrong: object = None) -> str:
    words = _list_words(hint)
    if words and isinstance(wrong, str):
        return f'write {_describe_type(hint)}; the nearest is "{find_nearest(wrong, words)}"'
    for meta in getattr(hint, "__metadata__", ()):
        if isinstance(meta, Meta) and meta.examples:
            default = meta.examples[0]
    # TOML writes strings, numbers and lists like JSON.
    has_example = isinstance(default, int | float | str | list | tuple) and default not in (True, False, "", ())
    return f"write {_describe_type(hint)}{f', such as {json.dumps(default)}' if has_example else ''}"


def _list_words(hint: Any) -> list[str]:
    """Return the words that a type allows, directly or as entries of a list."""
    base = _get_base_type(get_raw_type(hint))
    if get_origin(base) is tuple:
        base = _get_base_type(get_args(base)[0])
    return [word for word in get_args(base) if isinstance(word, str)] if get_origin(base) is Literal else []
