"""Compare the strategies on the same seeded missions, with failures, from 3 to 1,000 agents."""
