"""Tests of the yard for many."""
