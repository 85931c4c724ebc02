"""Measure the time without an acting robot after a failure of the acting one, by cause."""
