"""``python -m sim.crowd``: the yard for many alone, without agents."""

import sys

from sim.crowd.command import main

if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
