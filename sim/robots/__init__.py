"""The simulator of robots: a map with bodies, cameras and sensors, and the robots' side of each driver's wire."""
