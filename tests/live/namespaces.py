"""A test case that needs network namespaces.

If the machine does not support them, the tests are skipped with a prominent message. With ``SWARM_CI=1`` missing
support is a failure, because a skipped test proves nothing.
"""

from __future__ import annotations

import os
import sys
from functools import cache

from twisted.trial.unittest import SkipTest, SynchronousTestCase

from sim.namespaces.internet import Internet, Site
from sim.namespaces.namespace import find_unavailable_reason


class NamespaceCase(SynchronousTestCase):
    """A test that needs network namespaces."""

    def setUp(self) -> None:
        super().setUp()
        why = refused()
        if why and os.environ.get("SWARM_CI") == "1":
            self.fail(f"SWARM_CI=1, and the tests in namespaces cannot run: {why}")
        if why:
            raise SkipTest(why)

    def internet(self, *sites: Site) -> Internet:
        """Return a simulated internet of these sites, which is removed after the test."""
        net = Internet(sites)
        net.__enter__()
        self.addCleanup(net.close)
        return net


@cache
def refused() -> str:
    """Return the reason why namespaces are unavailable, or an empty string; print the reason once."""
    why = find_unavailable_reason()
    if why:
        stream = sys.__stderr__ or sys.stderr
        stream.write(f"\n!!!\n!!! THE TESTS IN NETWORK NAMESPACES ARE SKIPPED: {why}\n!!!\n")
    return why
