"""Tests of ``middleware.entangled.quorum``."""
