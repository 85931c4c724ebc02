"""Tests of the conversion of settings and options."""
