"""Register ``twistd swarm-node``; names only, so that an import error cannot break ``twistd --help``."""

from twisted.application.service import ServiceMaker

swarm_node = ServiceMaker(
    "swarm node",
    "swarmnode.plugin",
    "A node of a swarm: peer-to-peer store, the agent and driver of one device, and optionally the web page.",
    "swarm-node",
)
