"""Tests of how nodes reach each other through routers."""
