"""The ``swarm`` command: the demonstration, the yard, the trials, and the verbs that are asked of a running node."""

from __future__ import annotations

import importlib
import sys
from collections.abc import Sequence
from importlib.util import find_spec

from middleware.errors import MissingExtra
from swarmnode.ballast import drop_tls

OURS = ("agents", "drivers", "formats", "middleware", "sim", "swarmnode", "webnode")
# A verb whose module is not here is not offered.
WORKS: dict[str, tuple[str, str]] = {
    "demo": ("sim.demo.demonstration", "three robots, a red target and the page, on this machine"),
    "yard": ("sim.robots.server", "the yard alone, and the robots that it plays"),
    "trials": ("swarmnode.rehearsal", "both experiments, many times"),
    "crowd": ("swarmnode.crowd", "a yard for many: agents by the hundred among robots by the thousand"),
    "chaos": ("swarmnode.faults", "let a device of a team fail, to see another take over"),
    "driver": ("swarmnode.driver.command", "find a robot, and try it in a terminal before it joins"),
    "deploy": ("swarmnode.deploy", "push a strategy or a behaviour to the team, see who runs it, go back"),
    "init": ("swarmnode.team.init", "make a closed team: the operator's key, and its first node"),
    "invite": ("swarmnode.team.invite", "a code that lets a newcomer into the team"),
    "join": ("swarmnode.team.join", "become a member of a team, by such a code"),
    "members": ("swarmnode.team.members", "who belongs to the team"),
    "invitations": ("swarmnode.team.invitations", "the codes that can be used, and the members that used them"),
    "revoke": ("swarmnode.team.revoke", "put a member out, or end an invitation"),
    "rotate": ("swarmnode.team.rotate", "a new secret for the team"),
    "renew": ("swarmnode.team.renew", "certify a member anew, also one that has expired"),
    "promote": ("swarmnode.team.promote", "let a member let others in"),
    "why": ("swarmnode.why", "who was chosen for a task, and why"),
    "doctor": ("swarmnode.doctor.command", "what keeps a node from its team, and what to do"),
    "links": ("swarmnode.links", "how a node reaches each of its peers, and how well"),
    "schema": ("swarmnode.schema", "the JSON schema of a settings file, for editors"),
    "service": ("swarmnode.systemd.command", "a node as a service of systemd: install, show, restart, remove"),
    "web": ("swarmnode.web_code", "where the page is, and the code to sign in with"),
    "password": ("swarmnode.password", "the hash of a password, for the settings of the page"),
}
GROUPS = {
    "dht": "get, put, find, watch, remove: the distributed hash table",
    "keyword": "publish, search, watch, remove: what is found by words",
    "tuple": "put, get, read: the tuple space",
    "rpc": "call a method of a node",
}


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the verb that the command line names; returns its exit code."""
    words = sys.argv[1:] if arguments is None else arguments
    verb = words[0] if words else ""
    if verb in GROUPS:
        # Asked of a node that runs: this needs the standard library alone, and answers at once.
        from middleware.entangled.control.command import main as command

        return command(verb, words[1:])
    works = {name: work for name, work in WORKS.items() if find_spec(work[0]) is not None}
    if verb not in works:
        about = {**{name: purpose for name, (_, purpose) in works.items()}, **GROUPS}
        if verb not in ("", "--help", "-h"):
            sys.stderr.write(f"swarm: no verb {verb!r}; there are {', '.join(about)}; swarm --help says more\n")
            return 2
        lines = "".join(f"  {name:13}{purpose}\n" for name, purpose in about.items())
        sys.stdout.write(f"usage: swarm VERB [options]\n\n{lines}\nswarm VERB --help says more.\n")
        return 0
    drop_tls()
    try:
        module = importlib.import_module(works[verb][0])
    except ModuleNotFoundError as error:
        if (error.name or "").split(".")[0] in OURS:
            raise
        sys.stderr.write(f"swarm {verb}: {MissingExtra(f'swarm {verb}', 'all')}\n")
        return 2
    return int(module.main(words[1:]) or 0)
