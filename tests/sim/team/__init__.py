"""Tests of the team simulator."""
