"""Tests of real web nodes that serve the page over TLS, with a client that trusts only the team's authority."""

from __future__ import annotations

import json
import select
import socket
import ssl
import time
import urllib.error
import urllib.request
from importlib.util import find_spec
from itertools import chain, repeat
from typing import Any

from sim.demo import free_ports
from tests.live.node import NodeCase
from tests.live.until import takes, until

MISSING = [name for name in ("flask", "OpenSSL", "cryptography") if find_spec(name) is None]
DRIBBLED_S = 20.0
"""The time limit for a loaded machine; an idle machine needs 12 s."""
CODE = "quiet-otter"


class SecureNode:
    """A web node in a child process; its page is at ``plain`` (HTTP) and ``secure`` (HTTPS)."""

    def __init__(self, test: NodeCase, name: str, known: str = "") -> None:
        http, https = free_ports.find_free_ports("tcp", "127.0.0.1", 2)
        (udp,) = free_ports.find_free_ports("udp", "127.0.0.1", 1)
        path = test.file(
            f'[node]\nname = "{name}"\nport = {udp}\nroles = ["web"]\nstore = "{name}.sqlite"\nteam_key = "t"\n'
            f"known_nodes = {json.dumps([known] if known else [])}\n"
            f'[web]\nport = {http}\ntls = "auto"\ntls_port = {https}\ncode = "{CODE}"\n',
            name,
        )
        self.address = f"127.0.0.1:{udp}"
        self.plain, self.secure = f"http://127.0.0.1:{http}", f"https://127.0.0.1:{https}"
        self.port = https
        self.process = test.node("--config", path).process
        until(lambda: takes(http))
        self.authority = asked(f"{self.plain}/api/v1/ca.crt").decode()


def asked(url: str, trust: ssl.SSLContext | None = None, body: object = None, token: str = "") -> bytes:
    """Return the body of the response."""
    data = None if body is None else json.dumps(body).encode()
    headers = {"Content-Type": "application/json", **({"Authorization": f"Bearer {token}"} if token else {})}
    with urllib.request.urlopen(urllib.request.Request(url, data, headers), timeout=10, context=trust) as answer:
        content: bytes = answer.read()
    return content


class HttpsTests(NodeCase):
    if MISSING:
        skip = f"THE PAGE OVER TLS IS NOT TESTED: missing {', '.join(MISSING)} (pip install 'swarm-node[tls]')"

    def trusting(self, node: SecureNode, **versions: Any) -> ssl.SSLContext:
        """Return an SSL context that trusts the authority of the node's team and checks the address."""
        trust = ssl.create_default_context(cadata=node.authority)
        for name, version in versions.items():
            setattr(trust, name, version)
        return trust

    def test_serve_the_page_to_who_trusts_it(self) -> None:
        """A node serves the whole page over TLS, with the same checks as over HTTP, and closes slow handshakes."""
        node = SecureNode(self, "vaio")
        self.serve_all_of_the_page(node)
        self.keep_the_guard(node)
        self.let_go_who_dribbles_a_handshake(node)

    def serve_all_of_the_page(self, node: SecureNode) -> None:
        """Check that page, scripts, API and stream need TLS 1.2 or newer and trust in the team's authority."""
        trust = self.trusting(node)
        self.assertIn(b"<title>Swarm</title>", asked(node.secure, trust))
        self.assertIn(b"import", asked(f"{node.secure}/static/page.js", trust))
        session = json.loads(asked(f"{node.secure}/api/v1/session", trust, {"code": CODE}))
        state = json.loads(asked(f"{node.secure}/api/v1/state", trust, token=session["token"]))
        self.assertEqual([device["name"] for device in state["devices"]], ["vaio"])
        pages = json.loads(asked(f"{node.plain}/api/v1/node"))["pages"]
        self.assertEqual(
            {(page["url"], page["is_secure"]) for page in pages}, {(node.plain, False), (node.secure, True)}
        )
        stream = urllib.request.urlopen(
            f"{node.secure}/events?whole=1&ticket={session['ticket']}", timeout=10, context=trust
        )
        self.addCleanup(stream.close)
        heard = b""
        while b"event: beat" not in heard:
            heard += stream.readline()
        self.assertIn(b'"vaio"', heard)
        self.assertNotIn("Strict-Transport-Security", stream.headers)
        self.assertIn("default-src 'self'", stream.headers["Content-Security-Policy"])
        error = self.assertRaises(urllib.error.URLError, asked, node.secure, ssl.create_default_context())
        self.assertIn("CERTIFICATE_VERIFY_FAILED", str(error))
        old = self.trusting(node, minimum_version=ssl.TLSVersion.TLSv1, maximum_version=ssl.TLSVersion.TLSv1_1)
        self.assertRaises(urllib.error.URLError, asked, node.secure, old)
        self.assertIn(b"vaio", asked(node.secure, self.trusting(node, maximum_version=ssl.TLSVersion.TLSv1_2)))

    def keep_the_guard(self, node: SecureNode) -> None:
        """Check that requests that the HTTP port refuses, such as requests for another host, are refused over TLS."""
        trust = self.trusting(node)
        for path, headers, body, status in (
            ("/api/v1/state", {}, None, 401),
            ("/api/v1/node", {"Host": "evil.example.org"}, None, 403),
            ("/api/v1/demo", {"Origin": "https://evil.example.org", "X-Swarm": "1"}, b"{}", 403),
            ("/api/v1/demo", {"X-Swarm": "1"}, bytes(70_000), 413),
        ):
            request = urllib.request.Request(node.secure + path, body, headers)
            error = self.assertRaises(
                urllib.error.HTTPError, urllib.request.urlopen, request, timeout=10, context=trust
            )
            told = json.loads(error.read())
            self.assertEqual((error.code, set(told["error"])), (status, {"field", "problem", "remedy"}))

    def test_trust_each_node_once(self) -> None:
        """Trust in the authority of one web node does not include other nodes.

        A restarted node keeps its certificate.
        """
        first, second = SecureNode(self, "vaio"), SecureNode(self, "pi")
        self.assertNotEqual(first.authority, second.authority)
        self.assertIn(b"pi", asked(second.secure, self.trusting(second)))
        self.assertRaises(urllib.error.URLError, asked, second.secure, self.trusting(first))
        before = ssl.get_server_certificate(("127.0.0.1", first.port))
        first.process.terminate()
        first.process.wait()
        again = SecureNode(self, "vaio")
        self.assertEqual(ssl.get_server_certificate(("127.0.0.1", again.port)), before)

    def let_go_who_dribbles_a_handshake(self, node: SecureNode) -> None:
        """Check that forty clients with slow, silent or invalid handshakes are closed, while others are served."""
        began = time.monotonic()
        slow = [socket.create_connection(("127.0.0.1", node.port), 5.0) for _ in range(40)]
        for client in slow:
            self.addCleanup(client.close)
            client.setblocking(False)
        slow[0].send(b"GET / HTTP/1.1\r\nHost: 127.0.0.1\r\n\r\n")
        left = set(slow)
        octets = chain(b"\x16\x03\x01\x02\x00\x01\x00\x01\xfc\x03\x03", repeat(ord("x")))

        def all_closed() -> bool:
            octet = bytes([next(octets)])
            select.select(list(left), [], [], 1.0)
            for client in list(left):
                try:
                    if client is not slow[1]:
                        client.send(octet)
                    if client.recv(100) == b"":
                        left.discard(client)
                except BlockingIOError:
                    continue
                except OSError:
                    left.discard(client)
            self.assertIn(b"Swarm", asked(node.secure, self.trusting(node)))
            return not left

        until(all_closed)
        self.assertLess(time.monotonic() - began, DRIBBLED_S)
