"""Deployment: an operator's signed strategies and behaviours for a team that runs (thesis, section 4.3.4)."""
