"""The device directory: the presence record of each device, and the list of all, split by prefix in a large team."""
