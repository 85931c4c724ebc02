"""Settings of a node: the TOML file, checked and frozen; each setting is described with its unit and effect.

Tables: ``[node]``, ``[agent]``, ``[driver]``, ``[web]``, ``[faults]`` and ``[deployment]``, one dataclass each.
Any error is one ``BadSetting`` with the file and key, the problem and the remedy.
"""

from __future__ import annotations

import hashlib
import os
import tomllib
from collections.abc import Mapping
from dataclasses import dataclass, field, fields, replace
from typing import Annotated, Any, Literal

from msgspec import Meta

from formats.convert import InvalidValue, Secret, Unit, convert_field, convert_table, find_nearest, some_of
from middleware.config import types as setting
from middleware.entangled.data.store import MAX_BYTES, MAX_ROWS, Durability
from middleware.entangled.network.url import Url
from middleware.errors import BadSetting

IN_MEMORY = ":memory:"
ROLES = ("edge", "bootstrap", "web")
COMMAND_LINE = "command line"
NODE_PORT = 8484


@dataclass(frozen=True)
class NodeSettings:
    """``[node]``: the node and its connection to the network."""

    name: setting.Name
    """Name of the device; 1 to 40 letters, digits, ``_`` or ``-``.  Required."""

    kind: setting.ShortText = "generic"
    """Kind of device, for display and for matching; at most 40 characters."""

    description: setting.LongText = ""
    """One line about the device, shown on the page; at most 200 characters."""

    laptop: setting.ShortText = ""
    """Name of the computer that the node runs on, such as ``dog1_laptop``, shown on the page; at most 40 characters.
    One node and its computer belong to one device (thesis, Table 5.1)."""

    host: setting.ReachableHost = "127.0.0.1"
    """Numeric address to listen on, also announced to other nodes.  ``*`` means every interface, IPv4 and IPv6.  The
    default accepts only this machine."""

    port: setting.Port = NODE_PORT
    """UDP port; 0 selects any free port.  If no port is set and the default port is in use, for example by another node
    on this machine, the next free port is used.  Set the port on nodes that other nodes list in ``known_nodes``."""

    known_nodes: setting.Addresses = ()
    """Bootstrap nodes, as ``"host:port"``.  One that replies is enough; with several, the node can join even when some
    have failed.  Empty: the node finds its team on the LAN, or is the first node of its network."""

    lan: bool = True
    """Discover the team on the LAN by multicast, and be discovered.  False: use only ``known_nodes`` and incoming
    contacts.  No multicast is sent if ``host`` is a loopback address."""

    store: setting.File = IN_MEMORY
    """File of the data store, relative to the folder of the settings file.  ``:memory:``: no file; all data is lost
    when the node ends, so the node has a new identity at each start."""

    store_rows: Annotated[int, Meta(ge=100, le=1_000_000)] = MAX_ROWS
    """Maximum number of stored records.  A higher number supports a larger network; each record takes 1.2 KiB of memory
    in addition to its value."""

    store_bytes: Annotated[int, Meta(ge=100_000, le=2**31)] = MAX_BYTES
    """Maximum total size of the stored records, in bytes.  A higher limit allows more large values; a lower one saves
    memory and disk.  A full store drops expired records and old tombstones first; after that, it refuses writes and
    reports its usage."""

    durable: Durability = "power"
    """The failure that an acknowledged write survives: a loss of ``power``, or only a ``crash`` of the node.  With
    ``crash`` a write does not wait for the disk; a power failure can lose the last writes, but does not damage the
    file."""

    membership: setting.MaybeFile = ""
    """Membership file of a closed team, relative to the folder of the settings file; each node needs its own.  ``swarm
    init`` creates the first membership of a team, ``swarm join CODE`` the membership of a new member.  Empty: the team
    is open, and ``team_key`` is required."""

    team_key: Annotated[str, Meta(min_length=1, max_length=1000), Secret()] = field(default="", repr=False)
    """Shared secret of an open team, used instead of a membership, for example in a classroom: any long text; it is
    hashed. **Each node with the key is a member with all permissions, and can be removed only by giving all other nodes
    a new key.**"""

    roles: Annotated[tuple[str, ...], some_of(ROLES)] = ("edge",)
    """Roles of the node: ``edge`` carries a device, ``bootstrap`` admits other nodes, ``web`` serves the page."""

    capabilities: setting.Capabilities = field(default_factory=dict)
    """Capabilities of the device in addition to its driver's capabilities; each is a table of properties (numbers or
    text).  If the driver has the same capability, the tables are merged, and the values in this setting take
    precedence."""

    presence_lease: Annotated[float, Meta(ge=0.1, le=60.0), Unit("seconds")] = 1.0
    """Seconds until other nodes consider a silent device lost.  With a shorter time, a loss is detected sooner, but a
    slow radio may be mistaken for a loss.  With a longer time, the node sends fewer datagrams: three renewals per lease
    to each replica."""

    position: setting.Position = field(default_factory=dict)
    """Position of the device on the page's map: ``x`` and ``y`` in metres and ``heading`` in radians, or ``lat`` and
    ``lon`` in degrees and ``accuracy`` in metres.  A device that measures its position reports the measured one
    instead."""

    tunnels: setting.Tunnels = ("auto",)
    """TLS tunnels to use if no known node replies by UDP, as ``"wss://host:port"``; ``auto`` means port 443 of each
    known node that is on a different machine.  Empty: no tunnel; the node cannot join where UDP is blocked."""

    tunnel_port: setting.Port = 0
    """TCP port at which this node accepts tunnels from nodes with blocked UDP, preferably 443; 0: no tunnels."""

    tunnel_tls: bool = True
    """False: the tunnel port does not use TLS and accepts only connections from this machine, for use behind a reverse
    proxy that provides TLS."""

    @property
    def tunnel_urls(self) -> tuple[Url, ...]:
        """``tunnels`` with ``auto`` replaced by the URLs of the known nodes."""
        urls = [Url.parse(text) for text in self.tunnels if text != "auto"]
        if "auto" in self.tunnels:
            urls += [Url("wss", known.host, 443) for known in self.known_nodes if not _is_loopback(known.host)]
        return tuple(dict.fromkeys(urls))

    @property
    def team_secret(self) -> bytes:
        """The 32-byte key of the team's datagrams: the BLAKE2s hash of ``team_key``."""
        return hashlib.blake2s(self.team_key.encode()).digest()


@dataclass(frozen=True)
class AgentSettings:
    """``[agent]``: the agent of the device."""

    module: setting.Module = ""
    """Agent module, by name or dotted path; empty: no agent."""

    name: setting.ShortText = ""
    """Name of the agent, such as ``dog1_agent``, shown on the page and in the log; at most 40 characters."""


@dataclass(frozen=True)
class DriverSettings:
    """``[driver]``: the driver of the robot."""

    kind: setting.Module = ""
    """Name of the kind of robot, or its driver as ``module:Class``; empty: no driver."""

    options: setting.Options = field(default_factory=dict)
    """Options that are passed to the driver, which checks them."""

    parts: setting.Parts = ()
    """Additional sensors on the robot, such as a camera board or a compass, at most 8.  Each is a table
    ``[[driver.parts]]`` with ``kind`` and ``options``.  If the robot and a sensor have the same capability, the robot's
    capability takes precedence."""


@dataclass(frozen=True)
class WebSettings:
    """``[web]``: the page; used if the node has the role ``web``."""

    host: setting.Host = "127.0.0.1"
    """Numeric address to listen on.  The default serves only browsers on this machine; ``0.0.0.0`` also serves phones
    and tablets."""

    port: setting.Port = 8080
    """TCP port of the page; 0 selects any free port."""

    yard: setting.MaybeAddress = None
    """Control address of the robot simulator, as ``"host:port"``; empty: none."""

    tls: Literal["", "auto"] = ""
    """``auto``: also serve the page over TLS, with a certificate that the node creates; this needs the extra ``tls``
    and 13 MiB more memory.  Empty: no TLS; browsers then deny the page access to a phone's camera."""

    tls_port: setting.Port = 8443
    """TCP port of the page over TLS; 0 selects any free port."""

    code: setting.SignInCode = field(default="", repr=False)
    """Sign-in code for operators; 6 to 40 lower-case letters, digits and ``-``.  Empty: the node creates a new code at
    each start."""

    password: Annotated[str, Meta(max_length=200), Secret()] = field(default="", repr=False)
    """Hash of the sign-in password, as printed by ``swarm password``.  Empty: operators can sign in only with the
    code."""

    names: setting.HostNames = ()
    """Additional host names by which browsers may open the page, at most 8.  The page can always be opened by the
    addresses of this machine, by its host name (also with ``.local`` and ``.lan``) and by the node's name."""

    sign_in: bool = True
    """False: no sign-in; anyone who opens the page is an operator.  Allowed only if ``host`` is a loopback address."""


@dataclass(frozen=True)
class FaultSettings:
    """``[faults]``: permission for operators to inject faults into this node, for demonstrations and tests."""

    allow: bool = False
    """False: the node refuses fault injection."""


@dataclass(frozen=True)
class DeploymentSettings:
    """``[deployment]``: permission to run code on this node that operators push to the running team."""

    allow: bool = False
    """**The author of a behaviour controls the motion of this robot.**  The signature proves the author of a module,
    not that the module is harmless.  The module runs in a separate process without privileges, if the operating system
    supports this (``docs/how-to/push-code-to-a-team.md``).  False: modules are never fetched, loaded or run."""

    operators: setting.PublicKeys = ()
    """Public keys of the nodes that may push modules, each 64 hexadecimal digits; in a closed team these nodes also
    need the role operator.  Empty: no node may push modules."""

    modules: setting.ModuleNames = ()
    """Names of the modules that may run on this node, at most 8.  All others are refused."""


TABLES: dict[str, type[Any]] = {
    "node": NodeSettings,
    "agent": AgentSettings,
    "driver": DriverSettings,
    "web": WebSettings,
    "faults": FaultSettings,
    "deployment": DeploymentSettings,
}


@dataclass(frozen=True)
class Settings:
    """All settings of one node; ``origin`` is the path of the settings file."""

    node: NodeSettings
    agent: AgentSettings = AgentSettings()
    driver: DriverSettings = DriverSettings()
    web: WebSettings = WebSettings()
    faults: FaultSettings = FaultSettings()
    deployment: DeploymentSettings = DeploymentSettings()
    origin: str = ""
    given: frozenset[tuple[str, str]] = field(default=frozenset(), compare=False, repr=False)
    """Tables and keys that were set by the file or the command line; all others have their defaults."""

    def is_given(self, table: str, key: str) -> bool:
        """Return whether the file or the command line set that key."""
        return (table, key) in self.given

    @classmethod
    def load(cls, path: str) -> Settings:
        """Load the TOML file at ``path``; raises ``BadSetting``."""
        try:
            with open(path, "rb") as file:
                mapping = tomllib.load(file)
        except OSError as error:
            remedy = "use a settings file that can be read"
            raise BadSetting(path, "", f"cannot be read: {error.strerror or error}", remedy) from error
        except UnicodeDecodeError as error:
            raise BadSetting(path, "", f"is not UTF-8 text at byte {error.start}", "save it as UTF-8") from error
        except tomllib.TOMLDecodeError as error:
            raise BadSetting(path, "", f"is not TOML: {error}", "fix that line") from error
        return cls.from_mapping(mapping, path)

    @classmethod
    def from_mapping(cls, mapping: Mapping[str, object], origin: str) -> Settings:
        """Check ``mapping`` (table name to table); raises ``BadSetting``.

        ``origin`` is the path of the file: it appears in errors, and relative paths in the file are relative to its
        folder.
        """
        for name, value in mapping.items():
            if name in TABLES:
                continue
            if isinstance(value, Mapping):
                remedy = f"the nearest table is [{find_nearest(name, TABLES)}]"
                raise BadSetting(origin, f"[{name}]", "is not a table of the node settings", remedy)
            key = find_nearest(name, [key for _, key in _keys()])
            tables = " or ".join(f"[{table}]" for table, known in _keys() if known == key)
            remedy = f"write it below {tables}" if key == name else f"the nearest setting is {key}, below {tables}"
            raise BadSetting(origin, name, "is outside of any table", remedy)
        tables_by_name: dict[str, Any] = {}
        for name, kind in TABLES.items():
            try:
                tables_by_name[name] = convert_table(mapping.get(name, {}), kind)
            except InvalidValue as error:
                raise BadSetting(origin, f"[{name}] {error.key}".strip(), error.problem, error.remedy) from None
        node, folder = tables_by_name["node"], os.path.dirname(origin)
        if node.store != IN_MEMORY:
            node = replace(node, store=os.path.join(folder, node.store))
        if node.membership:
            node = replace(node, membership=os.path.join(folder, node.membership))
        tables_by_name["node"] = node
        given = frozenset((name, key) for name, table in mapping.items() if isinstance(table, Mapping) for key in table)
        return cls(**tables_by_name, origin=origin, given=given)

    def with_flags(self, **flags: object) -> Settings:
        """Return these settings with changes from the command line.

        The flag of a setting in ``[node]`` has the name of its key (``port``); in other tables the name of the table
        comes first (``web_port``).  The value None leaves a setting unchanged.  A text value is converted to the
        setting's type, with commas between list items.  A relative path of a store refers to the working directory.
        """
        known = {key if table == "node" else f"{table}_{key}": (table, key) for table, key in _keys()}
        changed: dict[str, dict[str, Any]] = {}
        for flag, value in flags.items():
            shown = "--" + flag.replace("_", "-")
            if flag not in known:
                remedy = "the nearest is --" + find_nearest(flag, known).replace("_", "-")
                raise BadSetting(COMMAND_LINE, shown, "is not a setting", remedy)
            if value is not None:
                table, key = known[flag]
                try:
                    new = convert_field(value, TABLES[table], key, is_text=isinstance(value, str))
                except InvalidValue as error:
                    raise BadSetting(COMMAND_LINE, shown, error.problem, error.remedy) from None
                changed.setdefault(table, {})[key] = new
        given = self.given | {(table, key) for table, keys in changed.items() for key in keys}
        tables = {table: replace(getattr(self, table), **keys) for table, keys in changed.items()}
        return replace(self, **tables, given=given)


def _is_loopback(host: str) -> bool:
    return host.startswith("127.") or host in ("::1", "localhost")


def _keys() -> list[tuple[str, str]]:
    return [(table, f.name) for table, kind in TABLES.items() for f in fields(kind)]
