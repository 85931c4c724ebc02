"""Assembly: one node with its agent and body, wired as its settings say and not yet started."""

from __future__ import annotations

import random
from dataclasses import dataclass
from functools import partial

from twisted.application.service import Service
from twisted.logger import Logger

from agents.registry import agent_named
from drivers.driver import MAX_FPS, Driver, Filming
from drivers.errors import DriverError
from drivers.registry import describe, driver_for
from middleware import setting
from middleware.entangled.data.store import Store
from middleware.entangled.errors import EntangledError
from middleware.entangled.identity import Identity
from middleware.errors import BadSetting, SwarmError
from middleware.halt import answer_halt
from middleware.node import SwarmNode
from middleware.presence import Device
from middleware.settings import Settings
from middleware.survey import answer_survey
from middleware.tuning import Knob, answer_tuning
from swarmnode.seams import Seams
from webnode.errors import WebError

FAULTS = (SwarmError, EntangledError, DriverError, WebError)
"""What a person can mend, and is told in one line."""

_log = Logger()


@dataclass
class Assembly:
    """One node with its agent and body, wired and not yet started."""

    node: SwarmNode
    agent: Service | None
    driver: Driver | None


def identity_in(store: Store, rng: random.Random) -> Identity:
    """The lasting identity that the store keeps, made at the first start."""
    seed = store.noted("identity")
    if seed is None or len(seed) != 32:
        if store.origin != "new":
            _log.warn("the data store has lost the node's identity: this node is a new one now")
        seed = rng.randbytes(32)
        store.note("identity", seed)
    return Identity(seed)


def assembled(settings: Settings, seams: Seams) -> Assembly:
    """Wire one node as ``settings`` say (thesis, Algorithm 4.1).

    Raises ``SwarmError`` or ``DriverError`` where they cannot be met.
    """
    node_settings, driver = settings.node, None
    if settings.agent.module and not settings.driver.kind:
        problem = f"is {settings.agent.module!r}, which has no robot to act with"
        raise BadSetting(settings.origin, "[agent] module", problem, "name its [driver] kind, or leave the agent out")
    frailty = None
    if settings.faults.allow:
        from swarmnode.frailty import Frailty  # any other node is spared the memory

        frailty = Frailty(seams)
        seams = frailty.seams
    capabilities = dict(node_settings.capabilities)
    kind = node_settings.kind
    if settings.driver.kind:
        body = describe(settings.driver.kind, settings.driver.options, node_settings.name)
        capabilities = {**body.capabilities, **capabilities}
        kind = kind if kind != "generic" else body.kind
        driver = driver_for(
            settings.driver.kind, settings.driver.options, node_settings.name, seams.clock, seams.connector
        )
        driver = driver if frailty is None else frailty.drained(driver)
    device = Device(
        uuid="",
        name=node_settings.name,
        kind=kind,
        description=node_settings.description,
        capabilities=capabilities,
        roles=tuple(node_settings.roles),
        position=node_settings.position,
    )
    node = SwarmNode(
        device,
        identity_in(seams.store, seams.rng),
        node_settings.team_secret,
        list(node_settings.known_nodes),
        seams.network(),
        seams.store,
        seams.clock,
        seams.rng,
        seams.wall,
        node_settings.presence_lease,
    )
    answer_survey(node)
    tuning = answer_tuning(node, settings, {} if driver is None else driver.description.capabilities)
    filming: object = driver
    if isinstance(filming, Filming) and "camera" in capabilities:
        tuning.add(_camera_knob(filming))
    node.halt = answer_halt(node.entangled)
    if frailty is not None:
        frailty.answer(node)
    if settings.deployment.allow:
        _deployable(node, settings, seams)
    agent = None
    if settings.agent.module and driver is not None:
        agent = agent_named(settings.agent.module)(node, driver, seams.clock, seams.rng)
    return Assembly(node, agent, driver)


def _camera_knob(driver: Filming) -> Knob:
    about, rule = "Pictures that the camera takes", setting.number(0.0, MAX_FPS)
    read = partial(getattr, driver, "camera_fps")
    return Knob("camera_fps", about, read, driver.set_camera_fps, rule, "per second", 0.0, MAX_FPS)


def _deployable(node: SwarmNode, settings: Settings, seams: Seams) -> None:
    """Let the node run what its operators push; a node that does not allow it loads none of this."""
    from middleware.deployment.deployment import Deployment
    from middleware.deployment.shelf import MemoryShelf

    shelf = MemoryShelf() if seams.shelf is None else seams.shelf
    deployment = Deployment(node.entangled, node.presence, node.wall, node.later, settings.deployment, shelf)
    node.deployed = deployment.modules
    deployment.open()

    def follow(_: None) -> None:
        if node.running:
            deployment.follow()

    node.joined.addCallback(follow)
