"""Parse proxies and tunnel URLs: ``wss://host:443/swarm`` or, on one machine, ``ws://127.0.0.1:8000/swarm``."""

from __future__ import annotations

import hashlib
import re
from typing import NamedTuple
from urllib.parse import unquote

from middleware.entangled.network.network import Address

PATH = "/swarm"
DEFAULT_PORTS = {"wss": 443, "ws": 80}
VIRTUAL_PREFIX = "~wss-"
"""The prefix of the virtual addresses of tunnels, at both ends."""
_PATTERN = re.compile(r"(wss?)://(\[[0-9a-fA-F:.]{2,45}\]|[A-Za-z0-9._-]{1,253})(?::([0-9]{1,5}))?(/[!-~]{0,200})?")


class Url(NamedTuple):
    """The parts of a tunnel URL; the scheme ``ws`` means a connection without TLS."""

    scheme: str
    host: str
    port: int
    path: str = PATH

    @classmethod
    def parse(cls, text: str) -> Url:
        """Parse a URL; raise ``ValueError`` if it is invalid."""
        found = _PATTERN.fullmatch(text)
        port = int(found[3] or DEFAULT_PORTS[found[1]]) if found else 0
        if found is None or not 0 < port < 65536:
            raise ValueError(f"{text[:80]!r} is not a tunnel URL of the form wss://host:port/path")
        return cls(found[1], found[2].strip("[]"), port, found[4] or PATH)

    @property
    def is_tls(self) -> bool:
        """Whether the tunnel uses TLS."""
        return self.scheme == "wss"

    @property
    def authority(self) -> str:
        """Host and port in the form of HTTP; a default port is omitted, as in browsers."""
        host = f"[{self.host}]" if ":" in self.host else self.host
        return host if self.port == DEFAULT_PORTS[self.scheme] else f"{host}:{self.port}"

    @property
    def address(self) -> Address:
        """The virtual address of the node that serves the URL."""
        return Address(VIRTUAL_PREFIX + hashlib.blake2s(str(self).encode(), digest_size=6).hexdigest(), 1)

    def __str__(self) -> str:
        return f"{self.scheme}://{self.authority}{self.path}"


class Proxy(NamedTuple):
    """An HTTP proxy with support for CONNECT; ``login`` is ``user:password``."""

    host: str
    port: int
    login: str = ""

    @classmethod
    def parse(cls, text: str) -> Proxy:
        """Parse the environment variable ``https_proxy``; raise ``ValueError`` if it is invalid."""
        found = re.fullmatch(r"(?:http://)?(?:([^@/]+)@)?(\[[0-9a-fA-F:.]+\]|[^:@/\[\]]+)(?::([0-9]{1,5}))?/?", text)
        port = int(found[3] or 3128) if found else 0
        if found is None or not 0 < port < 65536:
            raise ValueError("the proxy must have the form http://host:port")
        return cls(found[2].strip("[]"), port, unquote(found[1] or ""))
