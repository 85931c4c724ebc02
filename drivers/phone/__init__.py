"""A visitor's phone: options and driver of a device that sees and measures, and cannot move by itself."""
