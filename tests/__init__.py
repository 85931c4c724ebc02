"""Tests of swarm-node. Hypothesis generates the same examples in every run and has no time limit."""

from hypothesis import settings

settings.register_profile("repeatable", deadline=None, derandomize=True, database=None)
settings.load_profile("repeatable")
