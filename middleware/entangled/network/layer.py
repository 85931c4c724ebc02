"""Transform a byte stream without I/O: TLS, and the connection through an HTTP proxy."""

from __future__ import annotations

import base64
import ssl
from tempfile import NamedTemporaryFile
from typing import Protocol

from formats.head import MAX_HEAD_BYTES, encode_head, pop_head

_READ_BYTES = 16384


class StreamLayer(Protocol):
    """A transformation between a transport and a protocol; after a ``fault`` it produces no more bytes."""

    is_open: bool
    fault: str

    def opening(self) -> bytes:
        """Return the first bytes to send."""

    def decode(self, data: bytes) -> tuple[bytes, bytes]:
        """Process received bytes; return the decoded bytes, and the bytes to send back immediately."""

    def encode(self, data: bytes) -> bytes:
        """Encode ``data`` for sending; call it only while the layer is open."""


class TlsLayer:
    """One end of TLS, with Python's ``ssl``; ``host`` is the server name that a client sends (SNI)."""

    def __init__(self, context: ssl.SSLContext, host: str = "", is_server: bool = False) -> None:
        self.is_open = False
        self.fault = ""
        self._in, self._out = ssl.MemoryBIO(), ssl.MemoryBIO()
        self._tls = context.wrap_bio(self._in, self._out, server_side=is_server, server_hostname=host or None)

    def opening(self) -> bytes:
        """Return the first bytes to send."""
        self._do_handshake()
        return self._out.read()

    def decode(self, data: bytes) -> tuple[bytes, bytes]:
        """Process received bytes; return the decrypted bytes, and the bytes to send back immediately."""
        self._in.write(data)
        if not self.is_open and not self.fault:
            self._do_handshake()
        pieces = []
        while self.is_open and not self.fault:
            try:
                piece = self._tls.read(_READ_BYTES)
            except ssl.SSLWantReadError:
                break
            except ssl.SSLError as error:
                self._fail(error)
                break
            if not piece:
                self.fault = "the other end closed TLS"
            pieces.append(piece)
        return b"".join(pieces), self._out.read()

    def encode(self, data: bytes) -> bytes:
        """Encrypt ``data``."""
        try:
            self._tls.write(data)
        except ssl.SSLError as error:
            self._fail(error)
        return self._out.read()

    def _do_handshake(self) -> None:
        try:
            self._tls.do_handshake()
            self.is_open = True
        except ssl.SSLWantReadError:
            pass
        except ssl.SSLError as error:
            self._fail(error)

    def _fail(self, error: ssl.SSLError) -> None:
        self.fault = f"TLS: {error.reason or error}"


class ProxyLayer:
    """The connection through an HTTP proxy: CONNECT (RFC 9110, section 9.3.6); ``login`` is ``user:password``."""

    def __init__(self, target: str, login: str = "") -> None:
        self.is_open = False
        self.fault = ""
        self._target = target
        self._login = login
        self._buffer = bytearray()

    def opening(self) -> bytes:
        """Return the first bytes to send."""
        login = base64.b64encode(self._login.encode()).decode()
        more = [f"Proxy-Authorization: Basic {login}"] if login else []
        return encode_head(f"CONNECT {self._target} HTTP/1.1", f"Host: {self._target}", *more)

    def decode(self, data: bytes) -> tuple[bytes, bytes]:
        """Process received bytes; bytes after the proxy's response belong to the stream."""
        if self.is_open:
            return data, b""
        self._buffer += data
        answer = pop_head(self._buffer)
        if answer is None:
            if len(self._buffer) >= MAX_HEAD_BYTES:
                self.fault = "the response is not from an HTTP proxy; check the proxy's address"
            return b"", b""
        version, status = [*answer.first.split(b" "), b""][:2]
        if not version.startswith(b"HTTP/1.") or not status.startswith(b"2"):
            self.fault = f"the proxy refused the connection: {answer.summary!r}"
            return b"", b""
        self.is_open = True
        rest, self._buffer = bytes(self._buffer), bytearray()
        return rest, b""

    def encode(self, data: bytes) -> bytes:
        """Return ``data`` unchanged."""
        return data


def make_client_context() -> ssl.SSLContext:
    """Return a client's TLS context, which verifies no certificate, because Noise authenticates the peer."""
    context = ssl.SSLContext(ssl.PROTOCOL_TLS_CLIENT)
    context.check_hostname = False
    context.verify_mode = ssl.CERT_NONE
    _configure(context)
    return context


def make_server_context(pem: str) -> ssl.SSLContext:
    """Return the TLS context of a server; ``pem`` is a key with its certificate."""
    context = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER)
    _configure(context)
    # Python reads keys and certificates only from files; this file has mode 0600 and is deleted immediately.
    with NamedTemporaryFile("w", suffix=".pem") as file:
        file.write(pem)
        file.flush()
        context.load_cert_chain(file.name)
    # A tunnel is dialled once and stays open, so the 500 bytes of session tickets would be useless.
    context.num_tickets = 0
    context.options |= ssl.OP_NO_TICKET
    return context


def _configure(context: ssl.SSLContext) -> None:
    context.minimum_version = ssl.TLSVersion.TLSv1_2
    context.options |= ssl.OP_NO_RENEGOTIATION
    # The protocol that a browser offers for WebSocket: middleboxes filter by it.
    context.set_alpn_protocols(["http/1.1"])
