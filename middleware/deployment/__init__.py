"""Deployment of strategies and behaviours that an operator signed to a running team (thesis, section 4.3.4)."""
