"""The strategies side by side: the same seeded missions, with failures, from 3 to 1,000 agents."""
