"""The demonstration of the thesis: a team of processes, a judge of both experiments, and repeated trials."""
