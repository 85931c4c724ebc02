"""Deployment to a running team of strategies and behaviours that an operator has signed (thesis, section 4.3.4)."""
