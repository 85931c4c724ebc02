"""The demonstration: a team of processes in the yard, the judge of both experiments, and the trials of them."""
