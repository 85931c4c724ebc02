"""Attacks S1 to S25 by outsiders, malicious members and thieves, one module each, with the defence that stops them."""
