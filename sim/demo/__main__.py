"""Starts the demonstration: ``python -m sim.demo``."""

from sim.demo.demonstration import main

if __name__ == "__main__":
    main()
