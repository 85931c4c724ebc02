"""Tests of ``webnode.failover``."""

from __future__ import annotations

from twisted.trial.unittest import SynchronousTestCase

from middleware.directory.presence import Device
from tests.fleet import FleetCase, SwarmTeam
from webnode.failover import ORIGIN_KEPT_S, Page, TeamFallbacks, find_pages, get_origin, make_urls


class UrlTests(SynchronousTestCase):
    def test_name_an_origin_as_browsers_do(self) -> None:
        """Case, default ports and the names of this machine do not change an origin.

        A URL with a path is not an origin.
        """
        for url, origin in (
            ("http://192.168.0.5:8080", "http://192.168.0.5:8080"),
            ("http://VAIO.local:8080/", "http://vaio.local:8080"),
            ("https://192.168.0.5", "https://192.168.0.5:443"),
            ("http://localhost:8080", "http://127.0.0.1:8080"),
            ("http://[fe80::1]:8080", "http://[fe80::1]:8080"),
        ):
            self.assertEqual(get_origin(url), origin)

    def test_follow_no_url_out_of_the_house(self) -> None:
        """A URL that is not the page of a machine in the local network is ignored."""
        for url in (
            "https://evil.example",
            "javascript:alert(1)",
            "http://192.168.0.5/elsewhere",
            "http://dog@192.168.0.5",
            "http://192.168.0.5:99999",
            "http://192.168.0.5:8080?x=1",
            "http://192.168.0.5:8080\n",
            "http://" + "a" * 100,
            "",
            "null",
        ):
            self.assertEqual(get_origin(url), "", url)
        device = Device("01", "dog1", pages=("https://evil.example", "http://192.168.0.5:8080"))
        self.assertEqual(find_pages([device]), [Page("01", "http://192.168.0.5:8080")])

    def test_give_every_name_of_an_open_page(self) -> None:
        """A page on one address has one URL; a page on all interfaces has one URL for each name of the machine."""
        self.assertEqual(make_urls("127.0.0.1", 8080, ["vaio.local"]), ["http://127.0.0.1:8080"])
        self.assertEqual(
            make_urls("0.0.0.0", 80, ["10.0.0.5", "", "v.local"]), ["http://10.0.0.5:80", "http://v.local:80"]
        )
        self.assertEqual(make_urls("::1", 8443, [], is_secure=True), ["https://[::1]:8443"])


class TeamFallbacksTests(FleetCase):
    def web_nodes(self) -> tuple[SwarmTeam, list[TeamFallbacks]]:
        """Return a team of two nodes and the web fallbacks of each; each node serves the page on its own port."""
        swarm = self.swarm(2)
        webs = [TeamFallbacks(node, swarm.clock.seconds) for node in swarm.nodes]
        for place, web in enumerate(webs):
            web.publish([f"http://127.0.0.1:808{place}"])
        swarm.run(2)
        return swarm, webs

    def test_know_each_other(self) -> None:
        """Each web node lists its own page first, then the page of the other node, from which it accepts requests."""
        _, (first, second) = self.web_nodes()
        self.assertEqual([page.url for page in first.list_pages()], ["http://127.0.0.1:8080", "http://127.0.0.1:8081"])
        self.assertEqual([page.is_self for page in second.list_pages()], [True, False])
        self.assertTrue(first.is_allowed_origin("http://127.0.0.1:8081"))
        self.assertTrue(second.is_allowed_origin("http://localhost:8080"))
        self.assertFalse(first.is_allowed_origin("https://127.0.0.1:8081"))
        self.assertFalse(first.is_allowed_origin("http://192.168.0.9:8081"))

    def test_vouch_in_an_open_team(self) -> None:
        """In an open team a node may vouch for sessions if it serves the page, or has served it in the last hour."""
        swarm = self.swarm(3)
        first, second = (TeamFallbacks(node, swarm.clock.seconds) for node in swarm.nodes[:2])
        for place, web in enumerate((first, second)):
            web.publish([f"http://127.0.0.1:808{place}"])
        swarm.run(2)
        dog = swarm.nodes[2]
        keys = [node.entangled.identity.public for node in swarm.nodes[:2]]
        self.assertEqual([web.can_authenticate(key) for web in (first, second) for key in keys], [True] * 4)
        self.assertFalse(first.can_authenticate(dog.entangled.identity.public))
        self.assertFalse(first.can_authenticate(bytes(32)))
        swarm.nodes[0].stop_silently()
        swarm.run(3)
        self.assertTrue(second.can_authenticate(keys[0]))
        swarm.run(ORIGIN_KEPT_S)
        self.assertFalse(second.can_authenticate(keys[0]))

    def test_let_in_the_page_of_the_dead(self) -> None:
        """A failed web node is not listed.

        Its page can still be open in a browser, so requests from that page are accepted for an hour.
        """
        swarm, (first, second) = self.web_nodes()
        swarm.nodes[0].stop_silently()
        swarm.run(3)
        self.assertEqual([page.url for page in second.list_pages()], ["http://127.0.0.1:8081"])
        self.assertTrue(second.is_allowed_origin("http://127.0.0.1:8080"))
        swarm.run(ORIGIN_KEPT_S)
        self.assertFalse(second.is_allowed_origin("http://127.0.0.1:8080"))
        self.assertTrue(second.is_allowed_origin("http://127.0.0.1:8081"))
