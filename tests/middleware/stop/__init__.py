"""Tests of stops of the team."""
