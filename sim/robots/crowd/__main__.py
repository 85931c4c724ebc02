"""Entry point of ``python -m sim.robots.crowd``: a crowd without agents."""

import sys

from sim.robots.crowd.command import main

if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
