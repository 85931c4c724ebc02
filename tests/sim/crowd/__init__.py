"""Tests of the simulator for large numbers of robots."""
