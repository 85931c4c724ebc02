"""Tests of ``swarmnode.systemd``."""
