"""The invariants: each is a function of what happened, and gives its violations, a line each."""
