"""Tests of the read interface of a user interface."""
