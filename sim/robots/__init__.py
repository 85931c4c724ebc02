"""The robot simulator: a map with robots, cameras and sensors, and the robots' side of each driver's protocol."""
