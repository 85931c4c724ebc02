"""Settings: a node's TOML file, checked and frozen; every knob with its unit and what more and less of it do.

Tables: ``[node]``, ``[agent]``, ``[driver]``, ``[web]``, ``[faults]`` and ``[deployment]``, one dataclass each.
Whatever is wrong is one ``BadSetting``, which says where, what, and what to write instead.
"""

from __future__ import annotations

import hashlib
import os
import tomllib
from collections.abc import Mapping
from dataclasses import dataclass, field, fields, replace
from typing import Annotated, Any, Literal

from msgspec import Meta

from formats.convert import Invalid, Secret, Unit, convert_field, convert_table, nearest_of, some_of
from middleware.config import types as setting
from middleware.entangled.data.store import MAX_BYTES, MAX_ROWS, Durable
from middleware.entangled.network.url import Url
from middleware.errors import BadSetting

IN_MEMORY = ":memory:"
ROLES = ("edge", "bootstrap", "web")
COMMAND_LINE = "command line"
NODE_PORT = 8484


@dataclass(frozen=True)
class NodeSettings:
    """``[node]``: the node itself and its way into the network."""

    name: setting.Name
    """What people call the device; 1 to 40 letters, digits, ``_`` or ``-``.  Required."""

    kind: setting.Word = "generic"
    """What sort of device it is, for people and for matching; at most 40 characters."""

    description: setting.Sentence = ""
    """A line about the device, shown on the page; at most 200 characters."""

    laptop: setting.Word = ""
    """What people call the computer that the node runs on, such as ``dog1_laptop``, shown on the page; at most 40
    characters.  One node and its computer belong to one device (thesis, Table 5.1)."""

    host: setting.ReachableHost = "127.0.0.1"
    """The numeric address to listen at; the others are told it too.  ``*`` is every interface, of IPv4 and IPv6.  The
    default hears this machine alone."""

    port: setting.Port = NODE_PORT
    """The UDP port; 0 takes any free one.  Where none is set and the usual one is in use, as by another node of this
    machine, the next free one is taken.  Nodes that others name in ``known_nodes`` had better set theirs."""

    known_nodes: setting.Addresses = ()
    """Nodes to enter the network through, as ``"host:port"``.  Any one that answers is enough; more survive more
    losses.  None: this node finds its team on the LAN, or is the first of its network."""

    lan: bool = True
    """Whether the node looks for its team on its LAN, by multicast, and is found there.  False: only ``known_nodes``
    and who comes by itself.  Nothing is sent where ``host`` is an address of this machine alone."""

    store: setting.File = IN_MEMORY
    """The data store's file, relative to the folder of the settings file; ``:memory:`` forgets all when the node ends,
    and so gives the node a new identity each time."""

    store_rows: Annotated[int, Meta(ge=100, le=1_000_000)] = MAX_ROWS
    """Records that the node holds.  More serves a larger network; fewer spare memory: 1.2 KiB each, and their bytes."""

    store_bytes: Annotated[int, Meta(ge=100_000, le=2**31)] = MAX_BYTES
    """Bytes that the records may have together.  More holds more large values; fewer spare memory and card.  What has
    run out and old tombstones make room; then the writer is refused, with figures."""

    durable: Durable = "power"
    """What a stored record has outlived before its writer is told: the loss of ``power``, or only a ``crash`` of the
    node.  ``crash`` waits for no disk, and may lose the last moments with the power; the file stays whole."""

    membership: setting.MaybeFile = ""
    """The file by which this node is a member of a closed team, relative to the folder of the settings file; ``swarm
    init`` makes the first one of a team, ``swarm join CODE`` that of a newcomer.  One node a file.  Empty: the team is
    an open one, and ``team_key`` is needed."""

    team_key: Annotated[str, Meta(min_length=1, max_length=1000), Secret()] = field(default="", repr=False)
    """Instead of a membership, for a classroom: what all nodes of an open team know.  **Whoever knows it is a member,
    may do everything, and can be put out by another key for all the others only.**  Any long text will do; it is
    hashed."""

    roles: Annotated[tuple[str, ...], some_of(ROLES)] = ("edge",)
    """What the node does: ``edge`` carries a device, ``bootstrap`` lets others in, ``web`` serves the page."""

    capabilities: setting.Capabilities = field(default_factory=dict)
    """What the device can do beyond what its driver says: a table of properties (numbers or text) for each
    capability.  A capability that the driver names, too, is merged, and what stands here wins."""

    presence_lease: Annotated[float, Meta(ge=0.1, le=60.0), Unit("seconds")] = 1.0
    """Seconds for which the others believe in the device without a sign of it.  Less notices a loss sooner, and takes
    a slow radio for a loss; more costs fewer datagrams (three are sent to each holder in that time)."""

    position: setting.Position = field(default_factory=dict)
    """Where the device stands, for the page's map: ``x`` and ``y`` in metres and ``heading`` in radians, or ``lat`` and
    ``lon`` in degrees and ``accuracy`` in metres.  A device that moves and knows where it is says so itself."""

    tunnels: setting.Tunnels = ("auto",)
    """Tunnels over TLS by which to enter where no known node answers by UDP, as ``"wss://host:port"``; ``auto`` stands
    for port 443 of each known node that is not this machine.  Empty: none, and where UDP is blocked the node stays
    outside."""

    tunnel_port: setting.Port = 0
    """The TCP port at which this node lets those in to whom UDP is blocked, best 443; 0: it does not."""

    tunnel_tls: bool = True
    """False: the port speaks no TLS, and only to this machine: for a reverse proxy that has a certificate."""

    @property
    def tunnel_urls(self) -> tuple[Url, ...]:
        """``tunnels``, those of the known nodes included."""
        urls = [Url.of(text) for text in self.tunnels if text != "auto"]
        if "auto" in self.tunnels:
            urls += [Url("wss", known.host, 443) for known in self.known_nodes if not _is_here(known.host)]
        return tuple(dict.fromkeys(urls))

    @property
    def team_secret(self) -> bytes:
        """The 32 bytes that seal the team's datagrams: the BLAKE2s hash of ``team_key``."""
        return hashlib.blake2s(self.team_key.encode()).digest()


@dataclass(frozen=True)
class AgentSettings:
    """``[agent]``: the mind of the device."""

    module: setting.Module = ""
    """The agent's module, by its name or its dotted path; none where empty."""

    name: setting.Word = ""
    """What people call the agent, such as ``dog1_agent``, shown on the page and in the log; at most 40 characters."""


@dataclass(frozen=True)
class DriverSettings:
    """``[driver]``: the body of the device."""

    kind: setting.Module = ""
    """The sort of robot, by its name, or the place of its driver as ``module:Class``; none where empty."""

    options: setting.Options = field(default_factory=dict)
    """Handed on to the driver as they stand; it checks them."""

    parts: setting.Parts = ()
    """What rides on the robot and only senses, as a camera board or a compass: a table ``[[driver.parts]]`` with
    ``kind`` and ``options`` for each, at most 8.  What the robot itself can do stays the robot's."""


@dataclass(frozen=True)
class WebSettings:
    """``[web]``: the page; read where the node has the role ``web``."""

    host: setting.Host = "127.0.0.1"
    """The numeric address to serve at.  The default serves this machine alone; ``0.0.0.0`` also phones and tablets."""

    port: setting.Port = 8080
    """The TCP port of the page; 0 takes any free one."""

    yard: setting.MaybeAddress = None
    """Where the simulated yard takes its operator's commands, as ``"host:port"``; none where empty."""

    tls: Literal["", "auto"] = ""
    """``auto``: the page is also served over TLS, with a certificate that the node makes (extra ``tls``; 13 MiB more).
    Empty: not, and a phone gives such a page no camera."""

    tls_port: setting.Port = 8443
    """The TCP port of the page over TLS; 0 takes any free one."""

    code: setting.SignInCode = field(default="", repr=False)
    """What operators sign in with; 6 to 40 small letters, digits and ``-``.  Empty: one is made at each start."""

    password: Annotated[str, Meta(max_length=200), Secret()] = field(default="", repr=False)
    """The hash of a password to sign in with, as ``swarm password`` prints it.  Empty: the code alone lets in."""

    names: setting.HostNames = ()
    """Further names of this machine by which the page may be opened, at most 8.  Its addresses, its host name (also
    with ``.local`` and ``.lan``) and the node's name always may."""

    sign_in: bool = True
    """False: whoever can open the page is an operator; only where ``host`` is an address of this machine alone."""


@dataclass(frozen=True)
class FaultSettings:
    """``[faults]``: whether operators may make this node fail, to see the team go on; for demonstrations and tests."""

    allow: bool = False
    """False: nobody can, whoever asks."""


@dataclass(frozen=True)
class DeploymentSettings:
    """``[deployment]``: whether code that operators push into the running team may run on this node."""

    allow: bool = False
    """**The author of a behaviour decides where this robot goes.**  The signature says from whom a module comes, not
    that it is harmless.  It runs in a process of its own without rights, as far as the system allows
    (``docs/how-to/push-code-to-a-team.md``).  False: nothing is ever fetched, loaded or run."""

    operators: setting.PublicKeys = ()
    """Public keys of the nodes that may push, each 64 hexadecimal digits; in a closed team they need the role operator
    as well.  Empty: none may."""

    modules: setting.ModuleNames = ()
    """Names of the modules that may run here, at most 8.  Any other is refused, whoever pushes it."""


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
    """All settings of one node; ``origin`` names the file they come from."""

    node: NodeSettings
    agent: AgentSettings = AgentSettings()
    driver: DriverSettings = DriverSettings()
    web: WebSettings = WebSettings()
    faults: FaultSettings = FaultSettings()
    deployment: DeploymentSettings = DeploymentSettings()
    origin: str = ""
    given: frozenset[tuple[str, str]] = field(default=frozenset(), compare=False, repr=False)
    """Which keys of which tables were set, by the file or the command line; the others are as usual."""

    def is_given(self, table: str, key: str) -> bool:
        """Whether that key was set."""
        return (table, key) in self.given

    @classmethod
    def load(cls, path: str) -> Settings:
        """The settings in the TOML file at ``path``; raises ``BadSetting`` with the line to mend."""
        try:
            with open(path, "rb") as file:
                mapping = tomllib.load(file)
        except OSError as error:
            remedy = "name a settings file that can be read"
            raise BadSetting(path, "", f"cannot be read: {error.strerror or error}", remedy) from error
        except UnicodeDecodeError as error:
            raise BadSetting(path, "", f"is not UTF-8 text at byte {error.start}", "save it as UTF-8") from error
        except tomllib.TOMLDecodeError as error:
            raise BadSetting(path, "", f"is not TOML: {error}", "mend that line") from error
        return cls.from_mapping(mapping, path)

    @classmethod
    def from_mapping(cls, mapping: Mapping[str, object], origin: str) -> Settings:
        """The settings in ``mapping`` (table name to table); raises ``BadSetting``.

        ``origin`` names the file they come from: errors name it, and a relative store lies in its folder.
        """
        for name, value in mapping.items():
            if name in TABLES:
                continue
            if isinstance(value, Mapping):
                remedy = f"the nearest table is [{nearest_of(name, TABLES)}]"
                raise BadSetting(origin, f"[{name}]", "is not a table that a node has", remedy)
            key = nearest_of(name, [key for _, key in _keys()])
            tables = " or ".join(f"[{table}]" for table, known in _keys() if known == key)
            remedy = f"write it below {tables}" if key == name else f"the nearest setting is {key}, below {tables}"
            raise BadSetting(origin, name, "stands outside of any table", remedy)
        made: dict[str, Any] = {}
        for name, kind in TABLES.items():
            try:
                made[name] = convert_table(mapping.get(name, {}), kind)
            except Invalid as error:
                raise BadSetting(origin, f"[{name}] {error.key}".strip(), error.problem, error.remedy) from None
        node, folder = made["node"], os.path.dirname(origin)
        if node.store != IN_MEMORY:
            node = replace(node, store=os.path.join(folder, node.store))
        if node.membership:
            node = replace(node, membership=os.path.join(folder, node.membership))
        made["node"] = node
        given = frozenset((name, key) for name, table in mapping.items() if isinstance(table, Mapping) for key in table)
        return cls(**made, origin=origin, given=given)

    def with_flags(self, **flags: object) -> Settings:
        """These settings with some of them replaced from the command line.

        A flag of ``[node]`` is called as its key (``port``), those of other tables have the table before it
        (``web_port``).  None leaves a setting as it is; text is read as the setting needs it, lists separated by
        commas; a store is relative to where one stands.
        """
        known = {key if table == "node" else f"{table}_{key}": (table, key) for table, key in _keys()}
        changed: dict[str, dict[str, Any]] = {}
        for flag, value in flags.items():
            shown = "--" + flag.replace("_", "-")
            if flag not in known:
                remedy = "the nearest is --" + nearest_of(flag, known).replace("_", "-")
                raise BadSetting(COMMAND_LINE, shown, "is not a setting", remedy)
            if value is not None:
                table, key = known[flag]
                try:
                    new = convert_field(value, TABLES[table], key, is_text=isinstance(value, str))
                except Invalid as error:
                    raise BadSetting(COMMAND_LINE, shown, error.problem, error.remedy) from None
                changed.setdefault(table, {})[key] = new
        given = self.given | {(table, key) for table, keys in changed.items() for key in keys}
        tables = {table: replace(getattr(self, table), **keys) for table, keys in changed.items()}
        return replace(self, **tables, given=given)


def _is_here(host: str) -> bool:
    return host.startswith("127.") or host in ("::1", "localhost")


def _keys() -> list[tuple[str, str]]:
    return [(table, f.name) for table, kind in TABLES.items() for f in fields(kind)]
