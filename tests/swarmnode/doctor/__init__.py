"""Tests of ``swarmnode.doctor``."""
