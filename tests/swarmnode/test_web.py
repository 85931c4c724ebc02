"""Tests of ``swarmnode.web``: the web role."""

from __future__ import annotations

import sys
from dataclasses import replace

from twisted.internet import reactor
from twisted.trial.unittest import SynchronousTestCase

from middleware.errors import BadSetting, MissingExtra
from swarmnode.plugin import format_error
from swarmnode.web import make_web_page
from tests.swarmnode.team import MemoryTeam


class WebRoleTests(SynchronousTestCase):
    def test_tls_without_its_libraries_names_the_extra(self) -> None:
        """If the libraries for TLS are missing, TLS is rejected; the error contains the command that installs them."""
        loaded = [name for name in sys.modules if name == "webnode.tls" or name.split(".")[0] == "OpenSSL"]
        hidden = {name: sys.modules.pop(name) for name in loaded}

        def restore() -> None:
            sys.modules.pop("OpenSSL")
            sys.modules.update(hidden)

        sys.modules["OpenSSL"] = None  # type: ignore[assignment]
        self.addCleanup(restore)
        team = MemoryTeam()
        service = team.service("a", 7000)
        settings = replace(service.settings, web=replace(service.settings.web, tls="auto"))
        error = self.assertRaises(
            BadSetting, make_web_page, settings, team.make_dependencies("a", 7000), reactor, service.assembly.node
        )
        for words in ("[web] tls", "the library OpenSSL is not installed", "pip install 'swarm-node[tls]'"):
            self.assertIn(words, str(error))

    def test_web_role_without_flask_names_the_extra(self) -> None:
        """If Flask is not installed, the web role is rejected; the error contains the command that installs Flask."""

        def needing() -> list[str]:
            return [n for n in sys.modules if n.split(".")[0] in ("flask", "webnode") or n == "swarmnode.page"]

        hidden = {name: sys.modules.pop(name) for name in needing()}
        sys.modules["flask"] = None  # type: ignore[assignment]

        def restore() -> None:
            for name in needing():
                del sys.modules[name]
            sys.modules.update(hidden)

        self.addCleanup(restore)
        team = MemoryTeam()
        service = team.service("a", 7000)
        settings, dependencies = service.settings, team.make_dependencies("a", 7000)
        error = self.assertRaises(MissingExtra, make_web_page, settings, dependencies, reactor, service.assembly.node)
        self.assertEqual(
            format_error(error, "x.toml"),
            "x.toml: [node] roles: the web role needs libraries that are not installed; "
            "run: pip install 'swarm-node[web]'",
        )
