"""Tests of the directory of devices."""
