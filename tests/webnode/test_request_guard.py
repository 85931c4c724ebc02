"""Tests of ``webnode.request_guard``."""

from __future__ import annotations

from twisted.trial.unittest import SynchronousTestCase

from webnode.request_guard import (
    HEADERS,
    choose_token,
    find_refusal,
    is_local_name,
    is_own_host,
    is_own_origin,
    make_headers,
)


class GuardTests(SynchronousTestCase):
    def test_know_local_names(self) -> None:
        """An IP address, a name without a dot, and a name of the local network can belong to a local machine."""
        hosts = ["10.0.0.7:8080", "[::1]:8080", "[fe80::1]", "localhost:8080", "vaio", "vaio.local:80", "VAIO.LAN"]
        for host in hosts:
            self.assertTrue(is_local_name(host), host)

    def test_know_own_names(self) -> None:
        """An address, localhost and the machine's names are hosts of this node; other names in the LAN are not."""
        for host in ("10.0.0.7:8080", "[::1]:8080", "localhost:80", "a.localhost", "VAIO.local", "vaio.local."):
            self.assertTrue(is_own_host(host, {"vaio.local"}), host)
        for host in ("evil.local", "vaio", "evil.lan:8080", "vaio.local.evil.lan", "evil-vaio.local", "", "a b", "["):
            self.assertFalse(is_own_host(host, {"vaio.local"}), host)

    def test_refuse_public_names(self) -> None:
        """Public names, which can point at any address, and invalid names are rejected."""
        for host in ("evil.example", "evil.example:8080", "", "a b", "[", "local.evil.com", "1.2.3.4.evil.com"):
            self.assertFalse(is_local_name(host), host)

    def test_compare_origins(self) -> None:
        """A request is accepted only if it has the page's own origin or no origin."""
        self.assertTrue(is_own_origin(None, "vaio:8080"))
        self.assertTrue(is_own_origin("http://vaio:8080", "vaio:8080"))
        for origin in ("http://vaio:9090", "http://evil.example", "null", ""):
            self.assertFalse(is_own_origin(origin, "vaio:8080"), origin)

    def test_be_strict(self) -> None:
        """The content security policy permits neither inline code nor other origins."""
        policy = HEADERS["Content-Security-Policy"]
        self.assertIn("default-src 'self'", policy)
        self.assertNotIn("unsafe", policy)
        self.assertIn("frame-ancestors 'none'", policy)
        self.assertEqual(HEADERS["Cross-Origin-Opener-Policy"], "same-origin")

    def test_read_the_token(self) -> None:
        """A bearer header takes precedence over a ticket in the query."""
        self.assertEqual(choose_token("Bearer abc", "t"), "abc")
        self.assertEqual(choose_token("bearer  abc ", ""), "abc")
        for header in ("", "Basic abc", "Bearer ", "abc"):
            self.assertEqual(choose_token(header, "t"), "t")

    def test_let_in(self) -> None:
        """A change needs the origin of the page or of another page of the team, and the header ``X-Swarm``.

        A read only needs a host of this node.
        """

        def refused(method: str, origin: str | None = None, is_marked: bool = True, host: str = "vaio") -> str:
            no = find_refusal(method, host, origin, is_marked, ("vaio",), lambda origin: origin == "http://other")
            return "" if no is None else no.field

        self.assertEqual(refused("GET", "http://evil", False), "")
        self.assertEqual(refused("GET", host="evil.example"), "Host")
        self.assertEqual(refused("POST", "http://vaio"), "")
        self.assertEqual(refused("POST", "http://other"), "")
        self.assertEqual(refused("POST", "http://evil"), "Origin")
        self.assertEqual(refused("POST", None, False), "X-Swarm")
        self.assertEqual(refused("OPTIONS", "http://other", False), "")
        self.assertEqual(make_headers("vaio", "http://evil", lambda origin: False), HEADERS)
