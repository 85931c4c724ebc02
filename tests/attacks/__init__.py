"""Attacks by outsiders, malicious members and thieves, one module each, numbered as in the threat model."""
