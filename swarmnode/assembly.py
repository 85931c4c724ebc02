"""Composition of one node with its agent and driver from its settings."""

from __future__ import annotations

import random
from dataclasses import dataclass, replace
from functools import partial
from typing import TYPE_CHECKING

from twisted.application.service import Service
from twisted.logger import Logger

from agents.registry import load_agent
from drivers.driver import MAX_FPS, Driver, Filming
from drivers.errors import DriverError
from drivers.option import Fps
from drivers.registry import create_driver, describe
from formats.convert import convert_value
from middleware.config.settings import Settings
from middleware.config.tuning import TunableSetting, expose_tuning
from middleware.diagnostics.node_diagnostics import expose_diagnostics
from middleware.directory.presence import Device
from middleware.entangled.data.store import Store
from middleware.entangled.errors import EntangledError
from middleware.entangled.identity import Identity
from middleware.entangled.wire.admission_check import OPEN_ADMISSION, OPEN_TEAM_WARNING
from middleware.errors import BadSetting, SwarmError
from middleware.node import SwarmNode
from middleware.stop.stop_state import expose_stops
from swarmnode.dependencies import Dependencies
from webnode.errors import WebError

if TYPE_CHECKING:
    from middleware.admission.team import Team

EXPECTED_ERRORS = (SwarmError, EntangledError, DriverError, WebError)
"""Errors that an operator can fix; they are shown in one line."""

_log = Logger()


@dataclass
class Assembly:
    """One node with its agent and driver, connected to each other and not yet started."""

    node: SwarmNode
    agent: Service | None
    driver: Driver | None


def load_identity(store: Store, rng: random.Random) -> Identity:
    """Return the node's permanent identity from the store; at the first start create and store it."""
    seed = store.get_note("identity")
    if seed is None or len(seed) != 32:
        if store.origin != "new":
            _log.warn("the data store has lost the node's identity: the node has a new identity now")
        seed = rng.randbytes(32)
        store.set_note("identity", seed)
    return Identity(seed)


def check_team(settings: Settings) -> None:
    """Raise ``BadSetting`` unless the settings have either a membership or a team key."""
    node = settings.node
    if not node.membership and not node.team_key:
        problem = "is missing: this node has no team"
        remedy = "create a team (swarm init), join a team (swarm join CODE), or set team_key to a secret (open team)"
        raise BadSetting(settings.origin, "[node] membership", problem, remedy)
    if node.membership and node.team_key:
        problem = "is set in addition to a membership: a team is either closed or open"
        raise BadSetting(settings.origin, "[node] team_key", problem, "remove team_key, or the membership")


def assemble_node(settings: Settings, dependencies: Dependencies) -> Assembly:
    """Connect one node, agent and driver as ``settings`` require (thesis, Algorithm 4.1).

    Raises ``SwarmError`` or ``DriverError`` if that is not possible.
    """
    if dependencies.membership is None:
        check_team(settings)
    _check_robot(settings)
    injector = None
    if settings.faults.allow:
        from agents.catalogue import create_task
        from middleware.faults.injector import FaultInjector  # imported on demand, to save memory

        injector = FaultInjector(
            dependencies.clock, dependencies.wall, dependencies.rng, dependencies.network, dependencies.process
        )
        dependencies = replace(dependencies, network=injector.open_network, wall=injector.wall)
    device, driver = _make_device(settings), _make_driver(settings, dependencies)
    node = _make_node(device, settings, dependencies)
    _expose_methods(node, settings, driver)
    if injector is not None:
        driver = None if driver is None else injector.wrap_driver(driver)
        injector.expose(node, create_task)
    if settings.deployment.allow:
        _enable_deployment(node, settings, dependencies)
    return Assembly(node, _make_agent(node, settings, driver, dependencies), driver)


def _check_robot(settings: Settings) -> None:
    """Raise ``BadSetting`` if the settings have an agent or driver parts, but no robot."""
    if settings.agent.module and not settings.driver.kind:
        problem = f"is {settings.agent.module!r}, but there is no robot"
        raise BadSetting(settings.origin, "[agent] module", problem, "set [driver] kind, or remove [agent] module")
    if settings.driver.parts and not settings.driver.kind:
        raise BadSetting(settings.origin, "[driver] parts", "are set, but there is no robot", "set [driver] kind")


def _make_device(settings: Settings) -> Device:
    """Return the device as set in ``settings``; its driver provides the default kind and capabilities."""
    node, wanted = settings.node, settings.driver
    kind, capabilities = node.kind, dict(node.capabilities)
    if wanted.kind:
        body = describe(wanted.kind, wanted.options, node.name, wanted.parts)
        capabilities = {**body.capabilities, **capabilities}
        kind = kind if kind != "generic" else body.kind
    return Device(
        uuid="",
        name=node.name,
        kind=kind,
        description=node.description,
        capabilities=capabilities,
        roles=tuple(node.roles),
        position=node.position,
        laptop=node.laptop,
        agent=settings.agent.name,
    )


def _make_driver(settings: Settings, dependencies: Dependencies) -> Driver | None:
    """Return the driver of the robot, not yet connected, or None if the settings have no robot."""
    wanted = settings.driver
    if not wanted.kind:
        return None
    return create_driver(
        wanted.kind, wanted.options, settings.node.name, dependencies.clock, dependencies.connector, wanted.parts
    )


def _make_node(device: Device, settings: Settings, dependencies: Dependencies) -> SwarmNode:
    """Return the node of ``device``, with the identity and the secret of its team."""
    team = _load_team(dependencies)
    known = [] if team is None else team.membership.known_nodes
    node = SwarmNode(
        device,
        load_identity(dependencies.store, dependencies.rng) if team is None else team.identity,
        settings.node.team_secret if team is None else team.secret,
        list(dict.fromkeys([*settings.node.known_nodes, *known])),
        dependencies.network(),
        dependencies.store,
        dependencies.clock,
        dependencies.rng,
        dependencies.wall,
        settings.node.presence_lease,
        lan=None if dependencies.lan is None else dependencies.lan(),
        admission=OPEN_ADMISSION if team is None else team.admission,
    )
    if team is None:
        _log.warn("{name} is in an open team: {open}", name=device.name, open=OPEN_TEAM_WARNING)
    else:
        team.attach(node.entangled, dependencies.clock)
        node.team = team
    return node


def _expose_methods(node: SwarmNode, settings: Settings, driver: Driver | None) -> None:
    """Let peers query the node's diagnostics, change its settings, and stop its robot."""
    expose_diagnostics(node)
    tuning = expose_tuning(node, settings, {} if driver is None else driver.description.capabilities)
    filming: object = driver
    if isinstance(filming, Filming) and "camera" in node.presence.device.capabilities:
        tuning.add(_make_camera_knob(filming))
    node.stop_state = expose_stops(node.entangled, node.rng, node.later, node.presence.announce_stops)


def _make_agent(
    node: SwarmNode, settings: Settings, driver: Driver | None, dependencies: Dependencies
) -> Service | None:
    """Return the agent of the device, or None if the settings have no agent."""
    if not settings.agent.module or driver is None:
        return None
    agent = load_agent(settings.agent.module)(node, driver, dependencies.clock, dependencies.rng)
    if settings.agent.name:
        place = f" on {settings.node.laptop}" if settings.node.laptop else ""
        _log.info(
            "agent of {device}: {agent}{place}", device=settings.node.name, agent=settings.agent.name, place=place
        )
    return agent


def _load_team(dependencies: Dependencies) -> Team | None:
    """Return the closed team of the node; in an open team return None and import no modules for closed teams."""
    if dependencies.membership is None:
        return None
    from middleware.admission.team import Team

    return Team(dependencies.membership, dependencies.store, dependencies.wall, dependencies.rng)


def _make_camera_knob(driver: Filming) -> TunableSetting:
    about, check = "Frame rate of the camera", partial(convert_value, hint=Fps)
    read = partial(getattr, driver, "camera_fps")
    return TunableSetting("camera_fps", about, read, driver.set_camera_fps, check, "per second", 0.0, MAX_FPS)


def _enable_deployment(node: SwarmNode, settings: Settings, dependencies: Dependencies) -> None:
    """Let the node run modules that its operators push; the code for this is imported here, to save memory."""
    from middleware.deployment.deployment import Author, Deployment
    from middleware.deployment.module_store import MemoryModuleStore
    from middleware.deployment.process_channel import ProcessChannel

    def author_of(public: bytes) -> Author:
        if node.team is None:
            return Author("", None)
        member = node.team.admission.find_member(public)
        return Author("" if member is None else member.name, node.team.admission.roles_of(public))

    deployment = Deployment(
        node.entangled,
        node.presence,
        node.wall,
        node.later,
        settings.deployment,
        MemoryModuleStore() if dependencies.shelf is None else dependencies.shelf,
        author_of,
        ProcessChannel if dependencies.spawn is None else dependencies.spawn,
        node.clock.seconds,
    )
    node.deployed, node.stop_deployed = deployment.modules, deployment.stop
    node.later(0.0, deployment.load_stored)  # after daemonization, because module processes end with their parent

    def follow(_: None) -> None:
        if node.running:
            deployment.follow()

    node.joined.addCallback(follow)
