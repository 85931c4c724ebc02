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
from middleware.admission.keyfile import MAX_FILE_BYTES, read_bytes
from middleware.config.settings import COMMAND_LINE, NodeSettings, Settings
from middleware.entangled.clock import use_monotonic_time
from middleware.entangled.errors import BadStore, PortInUse, TunnelPortInUse
from middleware.entangled.network.network import Network
from middleware.errors import BadSetting, MissingExtra, SwarmError, UnknownAgent
from middleware.node import SwarmNode
from swarmnode.assembly import EXPECTED_ERRORS, assemble_node, check_team
from swarmnode.environment import create_control_socket, make_dependencies, make_network_factory, resolve_hosts
from swarmnode.memory_savings import STARTUP_S, block_tls_import, release_memory
from swarmnode.ports import replace_busy_ports
from swarmnode.service import NodeService
from swarmnode.web import add_sign_in_code, make_web_page
from webnode.errors import PortTaken

use_monotonic_time()

ERROR_KEYS: Sequence[tuple[type[Exception], str]] = (
    (TunnelPortInUse, "[node] tunnel_port"),
    (PortInUse, "[node] port"),
    (BadStore, "[node] store"),
    (BadKeyFile, "[node] membership"),
    (UnknownAgent, "[agent] module"),
    (DriverError, "[driver]"),
    (PortTaken, "[web] port"),
    (MissingExtra, "[node] roles"),
)
"""The setting that the message of each error mentions."""

KEY_FILE_OPTION = "team-key-file"
MAX_PORT_TRIES = 5
"""Number of ports to try if programs that start at the same moment compete for them."""


class Options(usage.Options):
    """Command line of ``twistd swarm-node``; flags take precedence over the file."""

    synopsis = "[--config FILE] [flags]"
    longdesc = (
        "Run one node of a team: a network peer, the agent of a device, and the page if the role is web.\n\n"
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
        _exit_with_error(BadSetting(COMMAND_LINE, "--team-key", problem, remedy))

    def postOptions(self) -> None:
        """Read the settings file and the flags; on an error print one line and exit with code 2."""
        flags = {
            name.replace("-", "_"): value for name, value in self.items() if name not in ("config", KEY_FILE_OPTION)
        }
        try:
            if self[KEY_FILE_OPTION] is not None:
                flags["team_key"] = _read_team_key(self[KEY_FILE_OPTION])
            if self["config"]:
                settings = Settings.load(self["config"])
            elif self["name"] is None:
                raise BadSetting(COMMAND_LINE, "--name", "is missing", "pass --name NAME, or --config FILE")
            else:
                settings = Settings.from_mapping({"node": {"name": "unnamed"}}, COMMAND_LINE)
            self.settings = settings.with_flags(**flags)
        except (SwarmError, BadKeyFile) as error:
            _exit_with_error(error)
        # This is the last moment before the reactor is imported.
        if not ("web" in self.settings.node.roles and self.settings.web.tls):
            block_tls_import()


def _read_team_key(file: str) -> str:
    """Return the secret in a private file, or from standard input, without the newline at its end."""
    content = sys.stdin.buffer.read(MAX_FILE_BYTES + 1) if file == "-" else read_bytes(Path(file))
    try:
        return content.decode().rstrip("\r\n")
    except UnicodeDecodeError:
        raise BadKeyFile(f"{file} is not text; write the secret of the team into it") from None


def makeService(options: Options) -> IService:
    """Return the service that ``twistd`` runs."""
    from twisted.internet import reactor

    settings = options.settings
    try:
        settings = replace_busy_ports(resolve_hosts(settings))
        check_team(settings)
        dependencies = make_dependencies(settings, reactor)
        fronts: list[Callable[[SwarmNode], IService]] = [partial(create_control_socket, settings, reactor)]
        if "web" in settings.node.roles:
            settings = add_sign_in_code(settings, dependencies.rng)
            fronts.append(partial(make_web_page, settings, dependencies, reactor))
        reactor.callLater(STARTUP_S, release_memory)
        return CheckedService(settings, dependencies, fronts)
    except EXPECTED_ERRORS as error:
        _exit_with_error(format_error(error, settings.origin))


class CheckedService(NodeService):
    """A node service that reports a failed start in one line, with exit code 2."""

    def startService(self) -> None:
        """Start the node; if another program has taken the default port since the check, try the next ports."""
        try:
            for left in reversed(range(MAX_PORT_TRIES)):
                try:
                    super().startService()
                    return
                except PortInUse:
                    if not left or self.settings.is_given("node", "port"):
                        raise
                self.vanish()
                self.settings = replace_busy_ports(self.settings)
                self._dependencies = replace(self._dependencies, network=self._make_network(self.settings.node))
                self.assembly = assemble_node(self.settings, self._dependencies)
        except EXPECTED_ERRORS as error:
            _exit_with_error(format_error(error, self.settings.origin))

    def _make_network(self, node: NodeSettings) -> Callable[[], Network]:
        return make_network_factory(node, self._dependencies.clock, self._dependencies.rng)


def format_error(error: Exception, origin: str) -> str:
    """Return one line with file, key, problem and remedy."""
    if isinstance(error, BadSetting):
        return str(error)
    key = next((key for kind, key in ERROR_KEYS if isinstance(error, kind)), "")
    return " ".join(": ".join(filter(None, (origin, key, str(error)))).split())


def _exit_with_error(problem: object) -> NoReturn:
    # twistd redirects sys.stderr to its log, which the user does not see.
    stream = sys.__stderr__ if isinstance(sys.stderr, LoggingFile) else sys.stderr
    if stream is not None:
        stream.write(f"swarm-node: {problem}\n")
    raise SystemExit(2)
