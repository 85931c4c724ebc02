"""Tests of the interface from which a user interface reads the team."""
