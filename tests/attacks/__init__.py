"""Attacks S1 to S25 by outsiders, malicious members and thieves, one module per attack, with the defence against it."""
