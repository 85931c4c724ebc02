"""A simulator for thousands of round robots; rays, motion and controllers are computed with arrays."""
