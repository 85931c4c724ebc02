"""Scale: the curves of what a team costs and takes against the number of its nodes."""
