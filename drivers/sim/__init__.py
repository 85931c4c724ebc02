"""The simulated dog: options, codec, link and driver, and the operator's client of the simulator."""
