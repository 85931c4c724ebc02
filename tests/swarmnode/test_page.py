"""Tests of ``swarmnode.page``: the host names that a page accepts."""

from __future__ import annotations

from importlib.util import find_spec

from twisted.trial.unittest import SynchronousTestCase

from middleware.config.settings import Settings

MISSING = [name for name in ("flask",) if find_spec(name) is None]
if not MISSING:
    from swarmnode.page import list_host_names


class HostsTests(SynchronousTestCase):
    if MISSING:
        skip = f"THE PAGE IS NOT TESTED: missing {', '.join(MISSING)}"

    def test_name_the_machine(self) -> None:
        """The page accepts the names of machine and node, with or without the LAN's suffix, and configured names."""
        web = {"names": ["robots.lan", "page.example.org"]}
        settings = Settings.from_mapping({"node": {"name": "Dog1", "team_key": "t"}, "web": web}, "")
        found = list_host_names(settings, "Vaio.corp.example")
        for name in ("vaio.corp.example", "vaio", "vaio.local", "vaio.lan", "dog1", "dog1.local", *web["names"]):
            self.assertIn(name, found)
        for name in ("evil.local", ".local", "corp.example", "vaio.example"):
            self.assertNotIn(name, found)
