"""The demonstration of the thesis: a team of processes, a check of both experiments, and repeated trials."""
