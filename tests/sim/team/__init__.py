"""Tests of whole teams in one process."""
