"""The ``swarm`` command: dispatch to the modules of its verbs."""

from __future__ import annotations

import importlib
import sys
from collections.abc import Sequence
from importlib.util import find_spec

from middleware.errors import MissingExtra
from swarmnode.memory_savings import block_tls_import

OWN_PACKAGES = ("agents", "drivers", "formats", "middleware", "sim", "swarmnode", "webnode")
# Verbs without an installed module are not listed.
VERB_MODULES: dict[str, tuple[str, str]] = {
    "demo": ("sim.demo.demonstration", "run a demo on this machine: three robots, a red target and the page"),
    "simulator": ("sim.robots.server", "run the robot simulator alone"),
    "trials": ("swarmnode.simulated_team", "repeat both experiments of the thesis"),
    "crowd": ("swarmnode.crowd", "simulate hundreds of agents and thousands of robots"),
    "faults": ("swarmnode.faults", "inject faults into a team, and measure the takeover"),
    "driver": ("swarmnode.driver.command", "find and test a robot before it joins a team"),
    "deploy": ("swarmnode.deploy", "push a strategy or behaviour to the team, show its state, roll it back"),
    "init": ("swarmnode.team.init", "create a closed team: operator key and first node"),
    "invite": ("swarmnode.team.invite", "create a code with which a newcomer joins the team"),
    "join": ("swarmnode.team.join", "join a team with a code"),
    "members": ("swarmnode.team.members", "list the members of the team"),
    "invitations": ("swarmnode.team.invitations", "list the valid codes and the members that used them"),
    "revoke": ("swarmnode.team.revoke", "revoke a member or an invitation"),
    "rotate": ("swarmnode.team.rotate", "replace the team's secret"),
    "renew": ("swarmnode.team.renew", "renew the certificate of a member, even after its expiry"),
    "promote": ("swarmnode.team.promote", "give a member the right to admit newcomers"),
    "why": ("swarmnode.why", "explain why a device was assigned to a task"),
    "doctor": ("swarmnode.doctor.command", "diagnose why a node does not reach its team"),
    "links": ("swarmnode.links", "show the path and quality of a node's link to each peer"),
    "schema": ("swarmnode.schema", "print the JSON schema of a settings file, for editors"),
    "service": ("swarmnode.systemd.command", "run a node as a systemd service: install, show, restart, remove"),
    "web": ("swarmnode.web_code", "show the address of the page and the sign-in code"),
    "password": ("swarmnode.password", "hash a password for the settings of the page"),
}
RENAMED_VERBS = {"yard": "simulator", "chaos": "faults"}
"""Old names of verbs; accepted in version 0.2 with a warning."""
NODE_VERBS = {
    "dht": "get, put, find, watch or remove records of the distributed hash table",
    "keyword": "publish, search, watch or remove keywords",
    "tuple": "put, get or read tuples of the tuple space",
    "rpc": "call a method of a node",
}


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the verb in ``arguments``; returns its exit code."""
    words = sys.argv[1:] if arguments is None else arguments
    verb = words[0] if words else ""
    if verb in RENAMED_VERBS:
        sys.stderr.write(f"swarm: {verb} is now called {RENAMED_VERBS[verb]}; the old name will be removed\n")
        verb = RENAMED_VERBS[verb]
    if verb in NODE_VERBS:
        # Fast path for requests to a running node: needs only the standard library.
        from middleware.entangled.control.command import main as command

        return command(verb, words[1:])
    works = {name: work for name, work in VERB_MODULES.items() if find_spec(work[0]) is not None}
    if verb not in works:
        about = {**{name: purpose for name, (_, purpose) in works.items()}, **NODE_VERBS}
        if verb not in ("", "--help", "-h"):
            sys.stderr.write(f"swarm: no verb {verb!r}; verbs: {', '.join(about)}; see swarm --help\n")
            return 2
        lines = "".join(f"  {name:13}{purpose}\n" for name, purpose in about.items())
        example = "swarm init lab --first vaio --page\n  swarm demo"
        sys.stdout.write(f"usage: swarm VERB [options]\n\n{lines}\nexamples:\n  {example}\n\nSee swarm VERB --help.\n")
        return 0
    block_tls_import()
    try:
        module = importlib.import_module(works[verb][0])
    except ModuleNotFoundError as error:
        if (error.name or "").split(".")[0] in OWN_PACKAGES:
            raise
        sys.stderr.write(f"swarm {verb}: {MissingExtra(f'swarm {verb}', 'all')}\n")
        return 2
    return int(module.main(words[1:]) or 0)
