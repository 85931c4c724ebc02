"""A yard for many: round robots by the thousand, whose rays, moves and controllers are computed as arrays."""
