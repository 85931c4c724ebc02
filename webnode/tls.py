"""Serve the page over TLS on a second port, with a certificate that the node creates, stores and renews.

Both ports serve the same site with the same deadlines.  The deadlines start with the connection, so a client that is
slow with its handshake is disconnected as well.  This module loads pyOpenSSL and is imported only if TLS is used.
"""

from __future__ import annotations

import random
from collections.abc import Callable, Collection
from pathlib import Path
from typing import Any

from OpenSSL.crypto import X509, PKey
from OpenSSL.SSL import Connection
from twisted.internet.interfaces import IListeningPort, IOpenSSLServerConnectionCreator
from twisted.internet.ssl import CertificateOptions, TLSVersion
from twisted.logger import Logger
from twisted.protocols.tls import BufferingTLSTransport, TLSMemoryBIOFactory
from twisted.web.server import Site
from zope.interface import implementer

from middleware.config.settings import IN_MEMORY, Settings
from middleware.entangled.data.store import Store
from webnode.certificate import Authority, Leaf, filter_names, make_authority, make_leaf, normalize_name, parse_leaf
from webnode.keyfile import UnsafeFile, read_key_file, write_key_file
from webnode.server import open_port

FILE_SUFFIX = ".tls"
"""Suffix of the file with the certificate and its key, next to the node's store."""
SEED_NOTE = "page/authority"
"""Key of the note in the node's store with the seed of its authority."""
SEED_BYTES = 32
CHECK_S = 60.0
"""Minimum interval in seconds between two checks of the certificate, made when a client connects."""
MAX_REACHED = 8

Names = Callable[[], Collection[str]]
"""Returns the current addresses and names of this machine in the network."""

_log = Logger()


@implementer(IOpenSSLServerConnectionCreator)
class CertificateProvider:
    """The certificate for connections: from the file, or a new one.

    If ``path`` is None, the certificate is not stored.  ``wall`` returns unix time, ``names`` this machine's names.
    """

    def __init__(
        self,
        signer: Authority,
        title: str,
        path: Path | None,
        names: Names,
        wall: Callable[[], float],
        rng: random.Random,
    ) -> None:
        self._signer = signer
        self._title = title
        self._path = path
        self._names = names
        self._wall = wall
        self._rng = rng
        self._reached: list[str] = []
        self._checked_at = 0.0
        self._leaf = self._load() or self._create("no certificate exists yet")
        self._options: Any = None

    @property
    def names(self) -> list[str]:
        """The addresses and names in the certificate."""
        return self._leaf.names

    def add_reached(self, host: str) -> None:
        """Add an address of this machine, to which a client has connected, to the certificate."""
        for name in filter_names([host]):
            if name not in self._leaf.names:
                self._reached = [*self._reached, name][-MAX_REACHED:]
                self._checked_at = 0.0

    def serverConnectionForTLS(self, protocol: object) -> Connection:  # noqa: N802
        """Return the TLS state of the next connection."""
        now = self._wall()
        # A clock that was set back is another reason to repeat the check.
        if not 0.0 <= now - self._checked_at < CHECK_S:
            self._checked_at = now
            flaw = self._leaf.find_flaw(self._signer, self._required_names(), now)
            if flaw:
                self._leaf, self._options = self._create(flaw), None
        if self._options is None:
            self._options = CertificateOptions(
                privateKey=PKey.from_cryptography_key(self._leaf.key),
                certificate=X509.from_cryptography(self._leaf.certificate),
                raiseMinimumTo=TLSVersion.TLSv1_2,
            )
        return Connection(self._options.getContext(), None)

    def _required_names(self) -> list[str]:
        return [*self._reached, *self._names()]

    def _load(self) -> Leaf | None:
        """Return the certificate of the file, if it is still usable."""
        if self._path is None:
            return None
        try:
            pem = read_key_file(self._path)
            if pem is None:
                return None
            stored = parse_leaf(pem)
            flaw = stored.find_flaw(self._signer, self._required_names(), self._wall())
        except (UnsafeFile, ValueError) as error:
            flaw = str(error)
        if not flaw:
            return stored
        _log.warn("the certificate in {path} is replaced: {flaw}", path=str(self._path), flaw=flaw)
        return None

    def _create(self, why: str) -> Leaf:
        """Create a certificate and store it in the file."""
        created = make_leaf(self._signer, self._title, self._required_names(), self._wall(), self._rng)
        _log.info("new certificate for {names}: {why}", names=", ".join(created.names), why=why)
        excluded = [name for name in self._required_names() if name and not normalize_name(name)]
        if excluded:
            warning = "{names}: not local names, so not in the certificate; open the page by another name"
            _log.warn(warning, names=", ".join(excluded))
        if self._path is not None:
            try:
                write_key_file(self._path, created.pem_with_key)
            except OSError as error:
                _log.warn(
                    "cannot store the certificate in {path} ({error}): the next start creates another",
                    path=str(self._path),
                    error=error,
                )
        return created


class _TlsProtocol(BufferingTLSTransport):
    factory: Any

    def makeConnection(self, transport: Any) -> None:  # noqa: N802
        # The address that the client dialled has to be in the certificate.
        self.factory.provider.add_reached(str(getattr(transport.getHost(), "host", "")))
        super().makeConnection(transport)


class _TlsFactory(TLSMemoryBIOFactory):
    protocol = _TlsProtocol
    noisy = False

    def __init__(self, provider: CertificateProvider, site: Site, clock: Any) -> None:
        super().__init__(provider, False, site, clock)
        self.provider = provider


class TlsPort:
    """The TLS port; ``signer`` is the authority that a user's browser should trust."""

    def __init__(self, reactor: Any, host: str, port: int, signer: Authority, provider: CertificateProvider) -> None:
        self.signer = signer
        self._reactor = reactor
        self._host = host
        self._port = port
        self._provider = provider

    def open(self, site: Site) -> IListeningPort:
        """Open the port for ``site``; raises ``PortTaken``."""
        connections = _TlsFactory(self._provider, site, self._reactor)
        return open_port(self._reactor, self._host, self._port, connections, "tls_port")


def make_tls_port(
    settings: Settings, store: Store, reactor: Any, wall: Callable[[], float], rng: random.Random, names: Names
) -> TlsPort:
    """Return the TLS port of the page for the node with this ``store``."""
    web, node = settings.web, settings.node
    signer = make_authority(_load_seed(store, rng), node.name)
    path = None if node.store == IN_MEMORY else Path(f"{node.store}{FILE_SUFFIX}")
    provider = CertificateProvider(signer, node.name, path, names, wall, rng)
    _log.info("phones that trust the authority {fingerprint} trust this node's page", fingerprint=signer.fingerprint)
    return TlsPort(reactor, web.host, web.tls_port, signer, provider)


def _load_seed(store: Store, rng: random.Random) -> bytes:
    """Return the seed of this node's authority, drawn at the first start."""
    seed = store.get_note(SEED_NOTE)
    if seed is None or len(seed) != SEED_BYTES:
        seed = rng.randbytes(SEED_BYTES)
        store.set_note(SEED_NOTE, seed)
    return seed
