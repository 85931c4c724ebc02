"""The dead man's switch: a small process next to the node that halts the robot if the node freezes or dies."""
