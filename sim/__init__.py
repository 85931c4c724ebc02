"""The yard in place of robots, the demonstration that starts a team in it, and the trials of both experiments."""
