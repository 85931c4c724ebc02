"""Tests of ``middleware.deployment``."""
