"""The yard in place of robots: world, cameras, sensors, and the server that robots' drivers talk to."""
