"""Petoi's Bittle, a robot dog, over serial or Wi-Fi: codec, gaits, options, links and driver."""
