"""Layer: one coat of a byte stream, as bytes in and bytes out: TLS, and the way through a proxy; no socket."""

from __future__ import annotations

import base64
import ssl
from tempfile import NamedTemporaryFile
from typing import Protocol

from formats.head import MAX_HEAD, head, taken

_PIECE = 16384


class Layer(Protocol):
    """What lies between the stream and what is said on it.  After ``fault`` nothing more comes of it."""

    is_open: bool
    fault: str

    def opening(self) -> bytes:
        """What to send first."""

    def received(self, data: bytes) -> tuple[bytes, bytes]:
        """Take bytes as they come; what was inside, and what to send back at once."""

    def wrapped(self, data: bytes) -> bytes:
        """What to send for ``data``, once it is open."""


class Tls:
    """One end of TLS, by Python's own ``ssl``; ``host`` is whom a client names (SNI)."""

    def __init__(self, context: ssl.SSLContext, host: str = "", is_server: bool = False) -> None:
        self.is_open = False
        self.fault = ""
        self._in, self._out = ssl.MemoryBIO(), ssl.MemoryBIO()
        self._tls = context.wrap_bio(self._in, self._out, server_side=is_server, server_hostname=host or None)

    def opening(self) -> bytes:
        """What to send first."""
        self._shake()
        return self._out.read()

    def received(self, data: bytes) -> tuple[bytes, bytes]:
        """Take bytes as they come; what was inside, and what to send back at once."""
        self._in.write(data)
        if not self.is_open and not self.fault:
            self._shake()
        pieces = []
        while self.is_open and not self.fault:
            try:
                piece = self._tls.read(_PIECE)
            except ssl.SSLWantReadError:
                break
            except ssl.SSLError as error:
                self._fail(error)
                break
            if not piece:
                self.fault = "the other end has closed TLS"
            pieces.append(piece)
        return b"".join(pieces), self._out.read()

    def wrapped(self, data: bytes) -> bytes:
        """What to send for ``data``."""
        try:
            self._tls.write(data)
        except ssl.SSLError as error:
            self._fail(error)
        return self._out.read()

    def _shake(self) -> None:
        try:
            self._tls.do_handshake()
            self.is_open = True
        except ssl.SSLWantReadError:
            pass
        except ssl.SSLError as error:
            self._fail(error)

    def _fail(self, error: ssl.SSLError) -> None:
        self.fault = f"TLS: {error.reason or error}"


class Proxied:
    """The way through an HTTP proxy: CONNECT (RFC 9110, section 9.3.6); ``login`` is ``user:password``."""

    def __init__(self, target: str, login: str = "") -> None:
        self.is_open = False
        self.fault = ""
        self._target = target
        self._login = login
        self._buffer = bytearray()

    def opening(self) -> bytes:
        """What to send first."""
        login = base64.b64encode(self._login.encode()).decode()
        more = [f"Proxy-Authorization: Basic {login}"] if login else []
        return head(f"CONNECT {self._target} HTTP/1.1", f"Host: {self._target}", *more)

    def received(self, data: bytes) -> tuple[bytes, bytes]:
        """Take bytes as they come; those after the proxy's answer are the stream's."""
        if self.is_open:
            return data, b""
        self._buffer += data
        answer = taken(self._buffer)
        if answer is None:
            if len(self._buffer) >= MAX_HEAD:
                self.fault = "no proxy answers there"
            return b"", b""
        version, status = [*answer.first.split(b" "), b""][:2]
        if not version.startswith(b"HTTP/1.") or not status.startswith(b"2"):
            self.fault = f"the proxy refuses: {answer.said!r}"
            return b"", b""
        self.is_open = True
        rest, self._buffer = bytes(self._buffer), bytearray()
        return rest, b""

    def wrapped(self, data: bytes) -> bytes:
        """What to send for ``data``."""
        return data


def client_context() -> ssl.SSLContext:
    """TLS for whoever dials.  It checks no certificate: the Noise handshake inside proves who is there."""
    context = ssl.SSLContext(ssl.PROTOCOL_TLS_CLIENT)
    context.check_hostname = False
    context.verify_mode = ssl.CERT_NONE
    _plain_web(context)
    return context


def server_context(pem: str) -> ssl.SSLContext:
    """TLS for whoever is dialled; ``pem`` is a key with its certificate."""
    context = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER)
    _plain_web(context)
    # Python takes them from files only; this one is nobody else's to read, and gone at once.
    with NamedTemporaryFile("w", suffix=".pem") as file:
        file.write(pem)
        file.flush()
        context.load_cert_chain(file.name)
    # A tunnel is dialled once and stays: tickets to resume it by would be 500 bytes for nothing.
    context.num_tickets = 0
    context.options |= ssl.OP_NO_TICKET
    return context


def _plain_web(context: ssl.SSLContext) -> None:
    context.minimum_version = ssl.TLSVersion.TLSv1_2
    context.options |= ssl.OP_NO_RENEGOTIATION
    # What a browser would say that wants to speak WebSocket: boxes in between choose by it.
    context.set_alpn_protocols(["http/1.1"])
