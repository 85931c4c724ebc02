"""The systemd unit of one node, with minimal permissions.

A system unit runs as a dynamic user with a private state folder.  A unit of a user's manager cannot use mount
namespaces, so it has only the restrictions that do not need them.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import PurePosixPath

from middleware.config.settings import Settings

PREFIX = "swarm-node-"
MEMORY_LIMIT = "256M"
"""Memory limit of a node; without page and camera it uses 40 MiB."""
LOWEST_FREE_PORT = 1024
SETTINGS_FILE = "node.toml"
HOME_FOLDERS = ("/home/", "/root/", "/run/user/")
"""Folders that ``ProtectHome=`` hides (systemd.exec(5))."""


@dataclass(frozen=True)
class Unit:
    """The parameters of a unit: ``twistd`` and ``settings`` are paths, ``name`` is the node's.

    ``interpreter`` is the real path of the Python that runs ``twistd``.
    """

    name: str
    twistd: str
    settings: str
    is_user: bool = False
    memory: str = MEMORY_LIMIT
    devices: tuple[str, ...] = ()
    needs_low_port: bool = False
    """Whether the node listens on a port below 1024, which needs a capability."""
    interpreter: str = ""

    @property
    def label(self) -> str:
        """The name of the unit without its suffix; the unit's folders have the same name."""
        return PREFIX + self.name

    @property
    def text(self) -> str:
        """The unit file."""
        return "\n".join(self._format_lines()) + "\n"

    def _format_lines(self) -> Iterator[str]:
        yield "[Unit]"
        yield f"Description=Swarm node {self.name}"
        if not self.is_user:
            yield "Wants=network-online.target"
            yield "After=network-online.target"
        # No restart after exit code 2 (invalid settings): the operator fixes them and starts the unit again.
        yield from ("StartLimitIntervalSec=60", "StartLimitBurst=10", "", "[Service]", "Type=exec")
        yield f"ExecStart={_quote(self.twistd)} --nodaemon --pidfile= swarm-node --config {_quote(self._config_path)}"
        yield from ("Restart=always", "RestartSec=2", "RestartPreventExitStatus=2", "TimeoutStopSec=10")
        yield from ("UMask=0077", f"MemoryMax={self.memory}", "TasksMax=128", "LimitCORE=0")
        yield from _COMMON_RESTRICTIONS
        if self.is_user:
            yield f"WorkingDirectory={PurePosixPath(self.settings).parent}"
        else:
            yield from self._format_confinement()
        yield from ("", "[Install]", f"WantedBy={'default' if self.is_user else 'multi-user'}.target")

    def _format_confinement(self) -> Iterator[str]:
        yield from ("DynamicUser=yes", f"StateDirectory={self.label}", "StateDirectoryMode=0700")
        yield from (f"WorkingDirectory=%S/{self.label}", f"RuntimeDirectory={self.label}", "RuntimeDirectoryMode=0700")
        # The folder in which `swarm` looks for the node's control socket.
        yield f"Environment=XDG_RUNTIME_DIR=%t/{self.label}"
        low = "CAP_NET_BIND_SERVICE" if self.needs_low_port else ""
        yield from (f"CapabilityBoundingSet={low}", f"AmbientCapabilities={low}")
        is_at_home = any(path.startswith(HOME_FOLDERS) for path in (self.twistd, self.interpreter))
        yield f"ProtectHome={'read-only' if is_at_home else 'yes'}"
        yield from _MOUNT_RESTRICTIONS
        if self.devices:
            yield from ("DevicePolicy=closed", *(f"DeviceAllow={device} rw" for device in self.devices))
            yield "SupplementaryGroups=dialout video"
        else:
            yield "PrivateDevices=yes"

    @property
    def _config_path(self) -> str:
        return self.settings if self.is_user else f"%S/{self.label}/{SETTINGS_FILE}"


_COMMON_RESTRICTIONS = (
    "NoNewPrivileges=yes",
    # UNIX for the control socket, NETLINK to list the interfaces.
    "RestrictAddressFamilies=AF_INET AF_INET6 AF_UNIX AF_NETLINK",
    "RestrictNamespaces=yes",
    "RestrictRealtime=yes",
    "RestrictSUIDSGID=yes",
    "LockPersonality=yes",
    "MemoryDenyWriteExecute=yes",
    "SystemCallArchitectures=native",
    "SystemCallFilter=@system-service",
    "SystemCallFilter=~@privileged",
    "SystemCallErrorNumber=EPERM",
)
_MOUNT_RESTRICTIONS = (
    "ProtectSystem=strict",
    "PrivateTmp=yes",
    "PrivateMounts=yes",
    "ProtectProc=invisible",
    "ProcSubset=all",
    "ProtectClock=yes",
    "ProtectControlGroups=yes",
    "ProtectHostname=yes",
    "ProtectKernelLogs=yes",
    "ProtectKernelModules=yes",
    "ProtectKernelTunables=yes",
    "RemoveIPC=yes",
    "KeyringMode=private",
)


def make_unit(
    settings: Settings, twistd: str, is_user: bool, memory: str = MEMORY_LIMIT, interpreter: str = ""
) -> Unit:
    """Return the unit of the node with these settings; ``settings.origin`` is the path of the settings file."""
    node, web = settings.node, settings.web
    ports = [node.port, node.tunnel_port]
    if "web" in node.roles:
        ports += [web.port, web.tls_port if web.tls else 0]
    options = [settings.driver.options, *(options for _, options in settings.driver.parts)]
    devices = tuple(dict.fromkeys(device for each in options for device in _list_devices(each)))
    is_low = any(0 < port < LOWEST_FREE_PORT for port in ports)
    return Unit(node.name, twistd, settings.origin, is_user, memory, devices, is_low, interpreter)


def _list_devices(options: Mapping[str, object]) -> Iterator[str]:
    for value in options.values():
        if isinstance(value, str) and value.startswith("/dev/"):
            yield value


def _quote(path: str) -> str:
    """Quote a path for systemd, with % doubled except for a specifier at the beginning."""
    head, rest = (path[:2], path[2:]) if path.startswith(("%S", "%t")) else ("", path)
    rest = rest.replace("%", "%%").replace("\\", "\\\\").replace('"', '\\"').replace("$", "$$")
    return f'"{head}{rest}"' if any(c.isspace() for c in rest) else head + rest
