"""Tests of ``middleware.lease``."""
