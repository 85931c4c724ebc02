"""What ``webnode.guard`` promises."""

from __future__ import annotations

from twisted.trial.unittest import SynchronousTestCase

from webnode.guard import HEADERS, is_local_host, is_own_origin


class GuardTests(SynchronousTestCase):
    def test_know_local_names(self) -> None:
        """Addresses, bare names, names of the local network and names of the settings are this machine's."""
        hosts = ["10.0.0.7:8080", "[::1]:8080", "[fe80::1]", "localhost:8080", "vaio", "vaio.local:80", "VAIO.LAN"]
        for host in hosts:
            self.assertTrue(is_local_host(host), host)
        self.assertTrue(is_local_host("robots.example.org:8080", {"robots.example.org"}))

    def test_refuse_public_names(self) -> None:
        """A name that somebody outside could point at this machine is refused, and so is nonsense."""
        for host in ("evil.example", "evil.example:8080", "", "a b", "[", "local.evil.com", "1.2.3.4.evil.com"):
            self.assertFalse(is_local_host(host), host)

    def test_compare_origins(self) -> None:
        """Only the page's own origin counts; programs send none."""
        self.assertTrue(is_own_origin(None, "vaio:8080"))
        self.assertTrue(is_own_origin("http://vaio:8080", "vaio:8080"))
        for origin in ("http://vaio:9090", "http://evil.example", "null", ""):
            self.assertFalse(is_own_origin(origin, "vaio:8080"), origin)

    def test_be_strict(self) -> None:
        """The content policy allows neither inline code nor other origins."""
        policy = HEADERS["Content-Security-Policy"]
        self.assertIn("default-src 'self'", policy)
        self.assertNotIn("unsafe", policy)
