"""Tests of what others have standardised."""
