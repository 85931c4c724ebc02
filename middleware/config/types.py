"""Types of a node's settings with their constraints."""

from __future__ import annotations

import math
import re
from collections.abc import Mapping
from ipaddress import ip_address
from typing import Annotated, Any

from msgspec import Meta, Struct

from formats.convert import FINITE, PRINTABLE, UNIQUE, ConversionStep, Secret, show_value
from middleware.entangled.network.network import ANY_HOST, Address
from middleware.entangled.network.url import Url

_POSITIONS = ({"x", "y", "heading"}, {"lat", "lon", "accuracy"})


def _read_host(text: str) -> str:
    return str(ip_address(text))


def _read_reachable_host(text: str) -> str:
    address = None if text == ANY_HOST else ip_address(text)
    if address is not None and address.is_unspecified:
        raise ValueError(f"is {show_value(text)}, which other nodes cannot reach")
    return ANY_HOST if address is None else str(address)


def _read_address(text: str) -> Address:
    host, _, number = text.rpartition(":")
    host = host.removeprefix("[").removesuffix("]")
    if not re.fullmatch(r"[A-Za-z0-9._:-]{1,45}", host) or not re.fullmatch(r"[0-9]{1,5}", number):
        raise ValueError(f"{show_value(text)} is not an address")
    if not 0 < int(number) <= 65535:
        raise ValueError(f"the port of {show_value(text)} is not from 1 to 65535")
    return Address(host, int(number))


def _check_tunnels(urls: tuple[str, ...]) -> tuple[str, ...]:
    for url in urls:
        if url != "auto":
            Url.parse(url)
    return urls


def _check_position(position: Mapping[str, float]) -> Mapping[str, float]:
    if position and set(position) not in _POSITIONS:
        raise ValueError(f"has {', '.join(position)}")
    return position


def _check_capabilities(capabilities: dict[str, dict[str, Any]]) -> dict[str, dict[str, Any]]:
    for name, properties in capabilities.items():
        for key, value in properties.items():
            if type(value) not in (int, float, str) or (isinstance(value, float) and not math.isfinite(value)):
                raise ValueError(f"{show_value(f'{name}.{key}')} is {show_value(value)}")
    return capabilities


class Part(Struct, forbid_unknown_fields=True):
    """One entry of ``[[driver.parts]]``."""

    kind: Annotated[str, Meta(pattern=r"^[A-Za-z_][A-Za-z0-9_]*([.:][A-Za-z_][A-Za-z0-9_]*)*$(?!\n)")]
    options: dict[str, Any] = {}


# Patterns end with $(?!\n): $ alone also matches before a final newline, and JSON Schema does not have \Z.
ShortText = Annotated[str, Meta(max_length=40), PRINTABLE]
LongText = Annotated[str, Meta(max_length=200), PRINTABLE]
File = Annotated[str, Meta(min_length=1, max_length=4000), PRINTABLE]
MaybeFile = Annotated[str, Meta(max_length=4000), PRINTABLE]
Name = Annotated[str, Meta(pattern=r"^[A-Za-z0-9_-]{1,40}$(?!\n)", examples=["dog1"])]
Module = Annotated[
    str, Meta(pattern=r"^([A-Za-z_][A-Za-z0-9_]*([.:][A-Za-z_][A-Za-z0-9_]*)*)?$(?!\n)", examples=["search"])
]
Port = Annotated[int, Meta(ge=0, le=65535, description="a number from 0 to 65535 (0: any free port)")]
Host = Annotated[
    str,
    Meta(description="a numeric address of this machine (`ip -brief address` lists them)", examples=["0.0.0.0"]),
    ConversionStep(_read_host, raw=str),
]
ReachableHost = Annotated[
    str,
    Meta(description='a numeric address of this machine that other nodes can reach, or "*"', examples=["192.168.1.10"]),
    ConversionStep(_read_reachable_host, raw=str),
]
MaybeAddress = Annotated[
    Address | None,
    Meta(description='"host:port" or empty', examples=["10.0.0.7:7000"]),
    ConversionStep(lambda text: _read_address(text) if text else None, raw=str),
]
Addresses = Annotated[
    tuple[Address, ...],
    Meta(description='a list of "host:port"', examples=[["10.0.0.7:7000"]]),
    ConversionStep(lambda texts: tuple(map(_read_address, texts)), raw=tuple[str, ...]),
    UNIQUE,
]
Tunnels = Annotated[
    tuple[str, ...],
    Meta(
        max_length=8,
        description='a list of at most 8 URLs "wss://host:port/path" or "auto"',
        examples=[["wss://node.example:443"]],
    ),
    ConversionStep(_check_tunnels),
    UNIQUE,
]
Capabilities = Annotated[
    Mapping[str, Mapping[str, float | str]],
    Meta(description="a table of finite numbers and text for each capability, such as camera = { width = 208 }"),
    ConversionStep(_check_capabilities, raw=dict[str, dict[str, Any]]),
]
Position = Annotated[
    Mapping[str, float],
    Meta(description="{ x = 0.0, y = 0.0, heading = 0.0 } or { lat = 0.0, lon = 0.0, accuracy = 0.0 }"),
    ConversionStep(_check_position, raw=dict[str, Annotated[float, FINITE]]),
]
Options = Annotated[Mapping[str, object], ConversionStep(dict, raw=dict[str, Any])]
Parts = Annotated[
    tuple[tuple[str, Mapping[str, object]], ...],
    Meta(description='at most 8 tables, such as { kind = "camera", options = {} }'),
    ConversionStep(
        lambda parts: tuple((part.kind, part.options) for part in parts),
        Annotated[tuple[Part, ...], Meta(max_length=8)],
    ),
]
SignInCode = Annotated[str, Meta(pattern=r"^([a-z0-9-]{6,40})?$(?!\n)", examples=["quiet-otter"]), Secret()]
HostNames = Annotated[
    tuple[Annotated[str, Meta(pattern=r"^[a-z0-9]([a-z0-9.-]{0,98}[a-z0-9])?$(?!\n)")], ...],
    Meta(max_length=8, examples=[["robots.lan"]]),
    UNIQUE,
]
PublicKeys = Annotated[
    tuple[Annotated[str, Meta(pattern=r"^[0-9a-f]{64}$(?!\n)")], ...],
    Meta(max_length=8, description="a list of at most 8 public keys, as `swarm deploy keys` shows them"),
    UNIQUE,
]
ModuleNames = Annotated[
    tuple[Annotated[str, Meta(pattern=r"^[a-z][a-z0-9_-]{0,31}$(?!\n)")], ...],
    Meta(max_length=8, examples=[["nearest-left"]]),
    UNIQUE,
]
