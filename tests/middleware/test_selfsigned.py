"""Tests of ``middleware.entangled.network.selfsigned`` and ``layer``: a certificate out of nothing, and TLS with it."""

from __future__ import annotations

from importlib.util import find_spec

from twisted.trial.unittest import SynchronousTestCase

from middleware.entangled.network.layer import Tls, client_context, server_context
from middleware.entangled.network.selfsigned import selfsigned

PEM = selfsigned(b"s" * 32, b"number 1", "node.example")


class CertificateTests(SynchronousTestCase):
    if find_spec("cryptography") is None:
        skip = "the certificate is not read by another library: no cryptography"

    def test_others_read_it(self) -> None:
        """Another library reads key and certificate: they belong together, and the signature is right."""
        from cryptography import x509
        from cryptography.hazmat.primitives.serialization import Encoding, PublicFormat, load_pem_private_key

        key = load_pem_private_key(PEM.encode(), None)
        certificate = x509.load_pem_x509_certificate(PEM.encode())
        raw = Encoding.Raw, PublicFormat.Raw
        self.assertEqual(key.public_key().public_bytes(*raw), certificate.public_key().public_bytes(*raw))
        certificate.verify_directly_issued_by(certificate)
        self.assertEqual(certificate.serial_number, int.from_bytes(b"\x01number 1"))
        self.assertEqual(certificate.subject.rfc4514_string(), "CN=node.example")
        names = certificate.extensions.get_extension_for_class(x509.SubjectAlternativeName).value
        self.assertEqual([name.value for name in names], ["node.example"])


class TlsTests(SynchronousTestCase):
    def setUp(self) -> None:
        self.client = Tls(client_context(), "node.example")
        self.server = Tls(server_context(PEM), is_server=True)

    def shake(self) -> None:
        said = self.client.opening()
        while not (self.client.is_open and self.server.is_open):
            _, answer = self.server.received(said)
            _, said = self.client.received(answer)
            self.assertEqual((self.client.fault, self.server.fault), ("", ""))
        self.server.received(said)

    def test_carry(self) -> None:
        """After the handshake bytes come out as they went in, cut anyhow, and cannot be read in between."""
        self.shake()
        for source, sink in ((self.client, self.server), (self.server, self.client)):
            wrapped = source.wrapped(b"in the clear" * 3000)
            self.assertNotIn(b"clear", wrapped)
            came = b"".join(sink.received(wrapped[at : at + 997])[0] for at in range(0, len(wrapped), 997))
            self.assertEqual(came, b"in the clear" * 3000)

    def test_fault(self) -> None:
        """What is no TLS, and a record that was changed, end it with a reason; nothing is raised."""
        self.server.received(b"GET / HTTP/1.1\r\n\r\n")
        self.assertIn("TLS", self.server.fault)
        self.assertEqual(self.server.received(b"more")[0], b"")
        self.setUp()
        self.shake()
        wrapped = bytearray(self.client.wrapped(b"x" * 100))
        wrapped[-1] ^= 1
        self.assertEqual(self.server.received(bytes(wrapped))[0], b"")
        self.assertIn("TLS", self.server.fault)
        self.assertEqual(self.server.wrapped(b"late")[:0], b"")
