"""Tests of swarm-node; Hypothesis generates the same examples in each run, without a time limit."""

from hypothesis import settings

settings.register_profile("repeatable", deadline=None, derandomize=True, database=None)
settings.load_profile("repeatable")
