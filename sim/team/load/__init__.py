"""Load: what the clients of a team do in a simulation, and the figures that it comes to."""
