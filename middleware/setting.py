"""Setting: the rules that one value of a settings file can be held to.

Each function makes the metadata of a dataclass field: ``check`` turns what TOML gave into what the program uses, or
raises ``Wrong``; ``read`` turns the text of a command line into what TOML would have given.
"""

from __future__ import annotations

import json
import math
import re
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from difflib import get_close_matches
from ipaddress import ip_address
from typing import Any

from middleware.entangled.network.network import EVERYWHERE, Address
from middleware.entangled.network.url import Url

Rule = Mapping[str, Any]
SHOWN = 60


class Wrong(Exception):
    """A value that its rule does not allow; never leaves the settings."""

    def __init__(self, problem: str, remedy: str) -> None:
        super().__init__(problem, remedy)
        self.problem = problem
        self.remedy = remedy


def shown(value: object) -> str:
    """``value`` as an error shows it: on one line, and not too long."""
    text = json.dumps(value, default=str, ensure_ascii=False)
    return text if len(text) <= SHOWN else text[: SHOWN - 3] + "..."


def text(most: int, least: int = 0) -> Rule:
    """A rule for text of ``least`` to ``most`` characters on one line."""

    def check(value: object) -> str:
        if not isinstance(value, str) or not least <= len(value) <= most or not all(c.isprintable() for c in value):
            raise Wrong(f"must be a line of {least}..{most} characters, is {shown(value)}", "write text in quotes")
        return value

    return _rule(check)


def pattern(expression: str, example: str) -> Rule:
    """A rule for text that matches ``expression`` from end to end."""

    def check(value: object) -> str:
        if not isinstance(value, str) or not re.fullmatch(expression, value, re.ASCII):
            raise Wrong(f"must match {expression}, is {shown(value)}", f"write a name {example}")
        return value

    return _rule(check)


def secret(most: int) -> Rule:
    """A rule for text of 1 to ``most`` characters that no error shows."""

    def check(value: object) -> str:
        if not isinstance(value, str) or not 1 <= len(value) <= most:
            raise Wrong(f"must be text of 1..{most} characters (it is not shown here)", "write text in quotes")
        return value

    return _rule(check)


def hidden(most: int) -> Rule:
    """A rule for text of at most ``most`` characters that no error shows."""
    check = secret(most)["check"]
    return _rule(lambda value: value if value == "" else check(value))


def truth() -> Rule:
    """A rule for true or false."""

    def check(value: object) -> bool:
        if type(value) is not bool:
            raise Wrong(f"must be true or false, is {shown(value)}", "write true or false, without quotes")
        return value

    return _rule(check, lambda word: {"true": True, "false": False}.get(word, word))


def patterns(expression: str, most: int, example: str) -> Rule:
    """A rule for a list of at most ``most`` texts that match ``expression`` from end to end."""
    remedy = f"write a list such as [{example}]"

    def check(value: object) -> tuple[str, ...]:
        listed = _listed(value, remedy)
        for item in listed:
            if not isinstance(item, str) or not re.fullmatch(expression, item, re.ASCII):
                raise Wrong(f"{shown(item)} does not match {expression}", remedy)
        if len(listed) > most:
            raise Wrong(f"has {len(listed)} entries, more than {most}", "leave some out")
        return tuple(dict.fromkeys(str(item) for item in listed))

    return _rule(check, _comma_separated)


def port() -> Rule:
    """A rule for a port number."""

    def check(value: object) -> int:
        if type(value) is not int or not 0 <= value <= 65535:
            raise Wrong(f"must be 0..65535, is {shown(value)}", "write a number, 0 for any free port")
        return value

    return _rule(check, _number)


def whole(least: int, most: int) -> Rule:
    """A rule for a whole number."""

    def check(value: object) -> int:
        if type(value) is not int or not least <= value <= most:
            raise Wrong(f"must be {least}..{most}, is {shown(value)}", "write a whole number")
        return value

    return _rule(check, _number)


def seconds(least: float, most: float) -> Rule:
    """A rule for a duration in seconds."""

    def check(value: object) -> float:
        if type(value) not in (int, float) or not isinstance(value, int | float) or not least <= value <= most:
            raise Wrong(f"must be {least}..{most} seconds, is {shown(value)}", "write a number")
        return float(value)

    return _rule(check, _number)


def number(least: float, most: float) -> Rule:
    """A rule for a number."""

    def check(value: object) -> float:
        if type(value) not in (int, float) or not isinstance(value, int | float) or not least <= value <= most:
            raise Wrong(f"must be {least:g}..{most:g}, is {shown(value)}", "write a number")
        return float(value)

    return _rule(check, _number)


def numeric_host(is_told: bool = False) -> Rule:
    """A rule for an address of this machine, in figures; one that ``is_told`` to others must be reachable.

    Such a one may be ``"*"``, too: every interface, IPv4 and IPv6; what the others are told follows from there.
    """
    example = "192.168.1.10" if is_told else "0.0.0.0"
    remedy = f'write one such as "{example}" (`ip -brief address` lists yours)'

    def check(value: object) -> str:
        with suppress(ValueError):
            if isinstance(value, str):
                if is_told and value == EVERYWHERE:
                    return EVERYWHERE
                address = ip_address(value)
                if is_told and address.is_unspecified:
                    raise Wrong(f"must be an address that other nodes can reach, is {shown(value)}", remedy)
                return str(address)
        raise Wrong(f"must be a numeric address, is {shown(value)}", remedy)

    return _rule(check)


def address() -> Rule:
    """A rule for one ``"host:port"``, or for none (an empty text)."""

    def check(value: object) -> Address | None:
        return None if value == "" else _address(value)

    return _rule(check)


def addresses() -> Rule:
    """A rule for a list of ``"host:port"``."""

    def check(value: object) -> tuple[Address, ...]:
        return tuple(dict.fromkeys(_address(item) for item in _listed(value, 'write a list such as ["10.0.0.7:7000"]')))

    return _rule(check, _comma_separated)


def tunnels(most: int) -> Rule:
    """A rule for a list of at most ``most`` URLs of tunnels, or the word ``auto``."""

    def check(value: object) -> tuple[str, ...]:
        remedy = 'write a list such as ["wss://node.example:443"], ["auto"] or []'
        listed = _listed(value, remedy)
        for item in listed:
            try:
                if item != "auto":
                    Url.of(item if isinstance(item, str) else "")
            except ValueError:
                raise Wrong(f"{shown(item)} is no wss://host:port/path", remedy) from None
        if len(listed) > most:
            raise Wrong(f"has {len(listed)} entries, more than {most}", "leave some out")
        return tuple(dict.fromkeys(str(item) for item in listed))

    return _rule(check, _comma_separated)


def one_of(words: Sequence[str]) -> Rule:
    """A rule for one of ``words``."""

    def check(value: object) -> str:
        if not isinstance(value, str) or value not in words:
            near = get_close_matches(str(value), words, n=1, cutoff=0.0)[0]
            raise Wrong(f"must be one of {', '.join(words)}, is {shown(value)}", f'the nearest is "{near}"')
        return value

    return _rule(check)


def some_of(words: Sequence[str]) -> Rule:
    """A rule for a list of at least one of ``words``."""

    def check(value: object) -> tuple[str, ...]:
        remedy = f"write a list of some of {', '.join(words)}"
        chosen = _listed(value, remedy)
        for word in chosen:
            if word not in words:
                near = get_close_matches(str(word), words, n=1, cutoff=0.0)[0]
                raise Wrong(f"{shown(word)} is none of {', '.join(words)}", f'the nearest is "{near}"')
        if not chosen:
            raise Wrong("is empty", remedy)
        return tuple(word for word in words if word in chosen)

    return _rule(check, _comma_separated)


def table() -> Rule:
    """A rule for a table that somebody else understands."""

    def check(value: object) -> Mapping[str, object]:
        if not isinstance(value, Mapping):
            raise Wrong(f"must be a table, is {shown(value)}", "write { key = value }")
        return dict(value)

    return _rule(check)


def kinds_with_options(most: int, example: str) -> Rule:
    """A rule for a list of at most ``most`` tables, each with ``kind`` and ``options`` that somebody else understands.

    What comes of it is a tuple of (kind, options).
    """

    def check(value: object) -> tuple[tuple[str, Mapping[str, object]], ...]:
        if not isinstance(value, list | tuple) or len(value) > most:
            raise Wrong(f"must be at most {most} tables, is {shown(value)}", 'write [{ kind = "..." }]')
        checked = []
        for number, entry in enumerate(value, 1):
            if not isinstance(entry, Mapping):
                raise Wrong(f"entry {number} must be a table, is {shown(entry)}", 'write { kind = "..." }')
            for key in entry:
                if key not in ("kind", "options"):
                    raise Wrong(f"entry {number} has {shown(key)}, which is not a setting", "known are kind, options")
            kind, options = entry.get("kind"), entry.get("options", {})
            if not isinstance(kind, str) or not re.fullmatch(r"[A-Za-z_]\w*([.:][A-Za-z_]\w*)*", kind, re.ASCII):
                problem = "has no kind" if kind is None else f"has a kind that cannot be, {shown(kind)}"
                raise Wrong(f"entry {number} {problem}", f'write kind = "{example}"')
            if not isinstance(options, Mapping):
                raise Wrong(f"entry {number}: options must be a table, is {shown(options)}", "write { key = value }")
            checked.append((kind, dict(options)))
        return tuple(checked)

    return _rule(check)


def numbers(*sets: Sequence[str]) -> Rule:
    """A rule for a table of finite numbers that has the keys of one of ``sets``, or none."""

    def check(value: object) -> Mapping[str, float]:
        remedy = "write { " + ", ".join(f"{key} = 0.0" for key in sets[0]) + " }"
        if not isinstance(value, Mapping):
            raise Wrong(f"must be a table of numbers, is {shown(value)}", remedy)
        for key, inner in value.items():
            if type(inner) not in (int, float) or not math.isfinite(inner):
                raise Wrong(f"{shown(key)} must be a number, is {shown(inner)}", remedy)
        if value and not any(set(value) == set(keys) for keys in sets):
            known = " or ".join(", ".join(keys) for keys in sets)
            raise Wrong(f"must have {known}, has {', '.join(map(str, value))}", remedy)
        return {key: float(inner) for key, inner in value.items()}

    return _rule(check)


def table_of_tables() -> Rule:
    """A rule for named tables of finite numbers and text."""

    def check(value: object) -> Mapping[str, Mapping[str, float | str]]:
        remedy = "write a table of numbers and text for each, such as camera = { width = 208 }"
        if not isinstance(value, Mapping):
            raise Wrong(f"must be a table of tables, is {shown(value)}", remedy)
        checked: dict[str, dict[str, float | str]] = {}
        for name, properties in value.items():
            if not isinstance(properties, Mapping):
                raise Wrong(f"{shown(name)} must be a table, is {shown(properties)}", remedy)
            for key, inner in properties.items():
                if type(inner) not in (int, float, str) or (isinstance(inner, float) and not math.isfinite(inner)):
                    raise Wrong(f"{shown(f'{name}.{key}')} must be a number or text, is {shown(inner)}", remedy)
            checked[name] = dict(properties)
        return checked

    return _rule(check)


def _rule(check: Callable[[object], object], read: Callable[[str], object] = str) -> Rule:
    return {"check": check, "read": read}


def _number(word: str) -> object:
    """The number that ``word`` is, or the word itself, which the check then complains of."""
    for kind in (int, float):
        with suppress(ValueError):
            return kind(word)
    return word


def _comma_separated(words: str) -> object:
    return [word.strip() for word in words.split(",") if word.strip()]


def _listed(value: object, remedy: str) -> list[object]:
    if not isinstance(value, list | tuple):
        raise Wrong(f"must be a list, is {shown(value)}", remedy)
    return list(value)


def _address(value: object) -> Address:
    host, _, number = value.rpartition(":") if isinstance(value, str) else ("", "", "")
    host = host.removeprefix("[").removesuffix("]")
    if not re.fullmatch(r"[A-Za-z0-9._:-]{1,45}", host) or not re.fullmatch(r"[0-9]{1,5}", number):
        raise Wrong(f'must be "host:port", is {shown(value)}', 'write one such as "10.0.0.7:7000"')
    if not 0 < int(number) <= 65535:
        raise Wrong(f"the port must be 1..65535, is {number}", 'write one such as "10.0.0.7:7000"')
    return Address(host, int(number))
