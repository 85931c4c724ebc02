"""Tests of standard formats."""
