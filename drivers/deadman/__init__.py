"""The dead man's switch: a small process beside the node that halts the robot when the node stands still or is gone."""
