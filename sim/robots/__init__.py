"""The robot simulator: a map with robots, cameras and sensors, and emulators of the robots' protocols."""
