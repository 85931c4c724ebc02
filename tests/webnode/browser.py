"""Send HTTP requests as bytes through a real ``Site`` with a transport in memory, in virtual time."""

from __future__ import annotations

from typing import Any

from twisted.internet.address import IPv4Address
from twisted.internet.error import ConnectionDone
from twisted.internet.task import Clock
from twisted.internet.testing import StringTransport
from twisted.python.failure import Failure
from twisted.web.resource import IResource
from twisted.web.server import Site

from webnode.channel import LimitedRequest, limit_connections
from webnode.limits import AddressLimits
from webnode.server import QuietSite


class Connection:
    """One connection to a site."""

    def __init__(self, site: Site, address: str = "192.168.1.1") -> None:
        self.transport = StringTransport(peerAddress=IPv4Address("TCP", address, 54321))
        self.protocol: Any = site.buildProtocol(self.transport.getPeer())
        self.protocol.makeConnection(self.transport)

    def ask(self, path: str, method: str = "GET", **headers: str) -> Connection:
        """Send a request without a body; ``_`` in a header's name stands for ``-``."""
        lines = "".join(
            f"{name.replace('_', '-')}: {value}\r\n" for name, value in {"Host": "localhost", **headers}.items()
        )
        return self.send(f"{method} {path} HTTP/1.1\r\n{lines}\r\n".encode())

    def send(self, data: bytes) -> Connection:
        """Send bytes."""
        self.protocol.dataReceived(data)
        return self

    def taken(self) -> bytes:
        """Return the data received since the last call."""
        data: bytes = self.transport.value()
        self.transport.clear()
        return data

    def pause(self) -> None:
        """Stop reading, so that the transport pauses its producer."""
        producer: Any = self.transport.producer
        producer.pauseProducing()

    def resume(self) -> None:
        """Continue reading."""
        producer: Any = self.transport.producer
        producer.resumeProducing()

    def leave(self) -> None:
        """Close the connection."""
        self.protocol.connectionLost(Failure(ConnectionDone()))


def site_of(root: IResource, clock: Clock, limits: AddressLimits | None = None) -> Site:
    """Create a site on ``clock`` that serves requests.

    With ``limits``, its connections are limited as on a web node.
    """
    site = QuietSite(root, requestFactory=LimitedRequest, reactor=clock, timeout=None)
    if limits is not None:
        limit_connections(site, limits)
    return site
