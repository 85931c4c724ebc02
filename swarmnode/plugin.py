"""The ``twistd swarm-node`` plugin: command line options and service; every error is one line and exit code 2."""

from __future__ import annotations

import sys
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import NoReturn

from twisted.application.service import IService
from twisted.logger import LoggingFile
from twisted.python import usage

from drivers.errors import DriverError
from middleware.admission.errors import BadKeyFile
from middleware.admission.keyfile import MAX_FILE, read_bytes
from middleware.config.settings import COMMAND_LINE, NodeSettings, Settings
from middleware.entangled.clock import use_monotonic_time
from middleware.entangled.errors import BadStore, PortInUse, TunnelPortInUse
from middleware.entangled.network.network import Network
from middleware.errors import BadSetting, MissingExtra, SwarmError, UnknownAgent
from middleware.node import SwarmNode
from swarmnode.assembly import FAULTS, assembled, checked_team
from swarmnode.ballast import STARTED_S, drop_tls, warmed_up
from swarmnode.ports import given_way
from swarmnode.service import NodeService
from swarmnode.web import web_page, with_code
from swarmnode.world import control_socket, real_network, real_seams, resolved
from webnode.errors import PortTaken

use_monotonic_time()

KEYS: Sequence[tuple[type[Exception], str]] = (
    (TunnelPortInUse, "[node] tunnel_port"),
    (PortInUse, "[node] port"),
    (BadStore, "[node] store"),
    (BadKeyFile, "[node] membership"),
    (UnknownAgent, "[agent] module"),
    (DriverError, "[driver]"),
    (PortTaken, "[web] port"),
    (MissingExtra, "[node] roles"),
)
"""Setting to name in the message of each error."""

KEY_FILE = "team-key-file"
TRIES = 5
"""Number of ports to try if programs that start at the same moment compete for them."""


class Options(usage.Options):
    """Command line of ``twistd swarm-node``; flags take precedence over the file."""

    synopsis = "[--config FILE] [flags]"
    longdesc = (
        "Run one node of a team: peer of the network, agent of a device, and page if it has the web role.\n\n"
        "Example: twistd --nodaemon swarm-node --config dog1.toml"
    )
    optParameters = [
        ["config", "c", None, "settings file of the node (TOML)"],
        ["name", "n", None, "name of the node"],
        ["kind", "k", None, "kind of the device"],
        ["host", None, None, "address to listen on"],
        ["port", "p", None, "UDP port; 0 picks any free one"],
        ["lan", None, None, "false: do not search for the team on the LAN"],
        ["known-nodes", None, None, "bootstrap nodes, as HOST:PORT,HOST:PORT"],
        ["store", "s", None, "path of the data store, or :memory:"],
        ["membership", None, None, "membership file of a closed team"],
        ["team-key-file", None, None, "file with the secret of an open team; - for standard input"],
        ["tunnels", None, None, "TLS tunnels to use where UDP is blocked, as wss://HOST:PORT,wss://HOST:PORT"],
        ["tunnel-port", None, None, "TCP port that accepts tunnels from other nodes; 0: none"],
        ["roles", "r", None, "roles of the node: edge, bootstrap, web, separated by commas"],
        ["agent-module", "a", None, "agent of the device"],
        ["driver-kind", "d", None, "driver of the robot"],
        ["web-host", None, None, "address of the page"],
        ["web-port", None, None, "TCP port of the page"],
        ["web-tls", None, None, "auto: also serve the page over TLS"],
        ["web-tls-port", None, None, "TCP port of the page over TLS"],
        ["web-yard", None, None, "robot simulator to show on the page's map, as HOST:PORT"],
    ]
    settings: Settings

    def opt_team_key(self, key: str) -> None:
        """Rejected, because all users of the computer can read command lines; use --team-key-file."""
        problem = "can be read by all users of this computer"
        remedy = "write a new secret to a file of mode 0600 and pass --team-key-file FILE; replace the one given here"
        _refuse(BadSetting(COMMAND_LINE, "--team-key", problem, remedy))

    def postOptions(self) -> None:
        """Read the file and the flags; an error is printed in one line, with exit code 2."""
        flags = {name.replace("-", "_"): value for name, value in self.items() if name not in ("config", KEY_FILE)}
        try:
            if self[KEY_FILE] is not None:
                flags["team_key"] = _read_team_key(self[KEY_FILE])
            if self["config"]:
                settings = Settings.load(self["config"])
            elif self["name"] is None:
                raise BadSetting(COMMAND_LINE, "--name", "is missing", "pass --name NAME, or --config FILE")
            else:
                settings = Settings.from_mapping({"node": {"name": "unnamed"}}, COMMAND_LINE)
            self.settings = settings.with_flags(**flags)
        except (SwarmError, BadKeyFile) as error:
            _refuse(error)
        # This is the last moment before the reactor is imported.
        if not ("web" in self.settings.node.roles and self.settings.web.tls):
            drop_tls()


def _read_team_key(file: str) -> str:
    """Return the secret in a private file, or from standard input, without the newline at its end."""
    content = sys.stdin.buffer.read(MAX_FILE + 1) if file == "-" else read_bytes(Path(file))
    try:
        return content.decode().rstrip("\r\n")
    except UnicodeDecodeError:
        raise BadKeyFile(f"{file} is not text; write the secret of the team into it") from None


def makeService(options: Options) -> IService:
    """Return the service that ``twistd`` runs."""
    from twisted.internet import reactor

    settings = options.settings
    try:
        settings = given_way(resolved(settings))
        checked_team(settings)
        seams = real_seams(settings, reactor)
        fronts: list[Callable[[SwarmNode], IService]] = [partial(control_socket, settings, reactor)]
        if "web" in settings.node.roles:
            settings = with_code(settings, seams.rng)
            fronts.append(partial(web_page, settings, seams, reactor))
        reactor.callLater(STARTED_S, warmed_up)
        return CheckedService(settings, seams, fronts)
    except FAULTS as error:
        _refuse(told(error, settings.origin))


class CheckedService(NodeService):
    """A node service that reports a failed start in one line, with exit code 2."""

    def startService(self) -> None:
        """Start; if the default port has been taken since it was checked, try the next ones."""
        try:
            for left in reversed(range(TRIES)):
                try:
                    super().startService()
                    return
                except PortInUse:
                    if not left or self.settings.is_given("node", "port"):
                        raise
                self.vanish()
                self.settings = given_way(self.settings)
                self._seams = replace(self._seams, network=self._network(self.settings.node))
                self.assembly = assembled(self.settings, self._seams)
        except FAULTS as error:
            _refuse(told(error, self.settings.origin))

    def _network(self, node: NodeSettings) -> Callable[[], Network]:
        return real_network(node, self._seams.clock, self._seams.rng)


def told(error: Exception, origin: str) -> str:
    """Return one line with file, key, problem and remedy."""
    if isinstance(error, BadSetting):
        return str(error)
    key = next((key for kind, key in KEYS if isinstance(error, kind)), "")
    return " ".join(": ".join(filter(None, (origin, key, str(error)))).split())


def _refuse(problem: object) -> NoReturn:
    # twistd redirects sys.stderr to its log, which the user does not see.
    stream = sys.__stderr__ if isinstance(sys.stderr, LoggingFile) else sys.stderr
    if stream is not None:
        stream.write(f"swarm-node: {problem}\n")
    raise SystemExit(2)
