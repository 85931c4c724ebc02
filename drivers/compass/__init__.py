"""A digital compass mounted on a robot: a part that measures the heading, over NMEA 0183."""
