"""Makes ``twistd swarm-node`` known; names only, so that an error in our modules cannot spoil ``twistd --help``."""

from twisted.application.service import ServiceMaker

swarm_node = ServiceMaker(
    "swarm node",
    "swarmnode.plugin",
    "A node of a swarm: peer-to-peer store, agent and driver of one device, and the page where it is asked for.",
    "swarm-node",
)
