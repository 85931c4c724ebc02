"""A digital compass on a robot's back: a part that tells where north is, by NMEA 0183."""
