"""Tests of ``agents.registry``."""

from __future__ import annotations

from twisted.trial.unittest import SynchronousTestCase

from agents.loop import Agent
from agents.registry import load_agent
from middleware.errors import UnknownAgent


class RegistryTests(SynchronousTestCase):
    def test_agents_are_found_by_name_or_path(self) -> None:
        """A built-in agent is found by its name; any other agent by its module and class."""
        self.assertIs(load_agent("search"), Agent)
        self.assertIs(load_agent("agents.loop:Agent"), Agent)

    def test_unknown_agent_is_refused_with_the_known(self) -> None:
        """An unknown name is refused; the error lists the known agents."""
        error = self.assertRaises(UnknownAgent, load_agent, "serch")
        self.assertEqual(str(error), "unknown agent 'serch'; use search, or module:Class")

    def test_agent_that_cannot_be_loaded_says_why(self) -> None:
        """The error for a missing module or class contains its name."""
        for name in ("no_such_module:Mind", "agents.loop:Mind"):
            error = self.assertRaises(UnknownAgent, load_agent, name)
            self.assertIn("cannot be loaded", str(error))
            self.assertIn(name.partition(":")[name.startswith("agents") * 2], str(error))
