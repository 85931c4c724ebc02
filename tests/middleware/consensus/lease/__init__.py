"""Tests of ``middleware.consensus.lease``."""
