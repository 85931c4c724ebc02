"""Tests of ``middleware.commitment``."""
