"""``swarm deploy``: push modules to a team, roll them back and show their state.

The node on this machine signs each pushed module and stores it under the node's key.  Other nodes run the module if
their settings list this node's key in ``[deployment] operators``.
"""

from __future__ import annotations

import argparse
import re
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any, TextIO

from middleware.consensus.deployed_modules import KINDS, PREFIX
from middleware.deployment.manifest import (
    DEPLOYMENTS,
    MAX_SOURCE_BYTES,
    MAX_VERSION,
    NAME_PATTERN,
    Manifest,
    find_newest,
    make_next_manifest,
    make_rollback,
    parse_manifest,
    source_key,
)
from middleware.deployment.module_loader import compile_source
from middleware.entangled.control.command import SendRequest, send_request
from middleware.entangled.control.conversion import remove_control_characters
from middleware.entangled.record import Record
from middleware.errors import Undeployable
from swarmnode.control_client import ControlClient, Rejection
from swarmnode.team.common import Answer, CommandContext, InvalidCommand, run_verb

SOURCE_SLOT = "source"
"""Name of the slot of a source under its key."""


def make_parser() -> argparse.ArgumentParser:
    """Return the parser of the command line."""
    common = argparse.ArgumentParser(add_help=False)
    common.add_argument("--node", metavar="NAME", help="name of the node, if several run on this machine")
    common.add_argument("--json", action="store_true", help="print JSON, on one line")
    main_parser = argparse.ArgumentParser(
        prog="swarm deploy",
        description="Push a strategy or a behaviour to the running team, signed by the node on this machine.",
        epilog="A node runs a module only if [deployment] in its settings allows deployment, lists the module's name, "
        "and lists this node's key in operators.  Example: swarm deploy push follow.py --name follow --kind behaviour",
    )
    verbs = main_parser.add_subparsers(dest="verb", required=True, metavar="VERB")

    def verb(name: str, purpose: str, example: str) -> argparse.ArgumentParser:
        epilog = f"Example: swarm deploy {name}{example}"
        return verbs.add_parser(name, help=purpose, description=purpose, epilog=epilog, parents=[common])

    example = " nearest.py --name nearest-left --kind strategy"
    push = verb("push", "Publish a new version of a module, signed by this node.", example)
    push.add_argument("file", metavar="FILE", help="Python source, one file")
    push.add_argument("--name", required=True, help=f"name of the module; tasks refer to it as {PREFIX}NAME")
    push.add_argument("--kind", required=True, choices=KINDS, help="kind of the module")
    push.add_argument("--version", type=int, metavar="N", help="version number (default: the newest plus 1)")
    back = verb("rollback", "Roll a module back to the previous version.", " nearest-left")
    back.add_argument("name", metavar="NAME", help="name of the module")
    verb("status", "Show the pushed modules and the devices that run them.", " --json")
    verb("keys", "Print the public key of each device, for the setting [deployment] operators.", "")
    return main_parser


def main(words: Sequence[str] | None = None, out: TextIO | None = None, ask: SendRequest = send_request) -> int:
    """Run the command; returns 0, 1 if the node rejected the request, 2 if the command is wrong."""
    verbs = {"push": _push, "rollback": _rollback, "status": _status, "keys": _keys}

    def work(options: argparse.Namespace, context: CommandContext) -> Answer:
        answer, lines = verbs[options.verb](options, context.ask)
        return answer, [remove_control_characters(line) for line in lines]

    return run_verb(make_parser(), words, CommandContext(out or sys.stdout, ask), work)


def _push(options: argparse.Namespace, ask: SendRequest) -> Answer:
    try:
        source = Path(options.file).read_bytes()
    except OSError as error:
        raise InvalidCommand(f"cannot read {options.file}: {error.strerror or error}") from error
    if not re.fullmatch(NAME_PATTERN, options.name, re.ASCII):
        raise InvalidCommand(f"--name {options.name!r} does not match {NAME_PATTERN}")
    if not 0 < len(source) <= MAX_SOURCE_BYTES:
        raise InvalidCommand(f"{options.file} has {len(source)} bytes; a module must have 1 to {MAX_SOURCE_BYTES}")
    try:
        compile_source(source, options.name)
    except Undeployable as error:
        raise InvalidCommand(f"{options.file}: {error.problem}") from error
    client = ControlClient(options.node, ask)
    held = find_newest(each for each, _ in _list_manifests(client) if each.name == options.name)
    manifest = make_next_manifest(options.name, options.kind, source, held, options.version)
    if held is not None and manifest.kind != held.kind:
        raise Rejection(f"{held.name} is a {held.kind}; use another name for a {manifest.kind}")
    if held is not None and manifest.rank <= held.rank:
        raise Rejection(f"version {manifest.version} is not higher than {held.rank[0]}, which was already pushed")
    if not 0 < manifest.version <= MAX_VERSION:
        raise Rejection(f"--version {manifest.version} is not between 1 and {MAX_VERSION}")
    # Store the source first: nodes request it as soon as they receive the manifest.
    client.put(source_key(manifest.digest), SOURCE_SLOT, source)
    return _publish(client, manifest, "pushed")


def _rollback(options: argparse.Namespace, ask: SendRequest) -> Answer:
    client = ControlClient(options.node, ask)
    manifests = [each for each, _ in _list_manifests(client)]
    held = find_newest(each for each in manifests if each.name == options.name)
    if held is None:
        there = ", ".join(sorted({each.name for each in manifests})) or "none"
        raise Rejection(f"no module {options.name!r} was pushed; pushed modules: {there}")
    manifest = make_rollback(held)
    if manifest is None:
        raise Rejection(f"{held.name} has no version before {held.version}")
    return _publish(client, manifest, f"rolled back from version {held.version}:")


def _status(options: argparse.Namespace, ask: SendRequest) -> Answer:
    client = ControlClient(options.node, ask)
    devices = client.list_devices()
    names = {record.owner: device.name for device, record in devices}
    rows: list[dict[str, Any]] = []
    lines = []
    pairs = _list_manifests(client)
    for name in sorted({manifest.name for manifest, _ in pairs}):
        manifest, record = max((p for p in pairs if p[0].name == name), key=lambda p: (p[0].rank, p[0].digest))
        runs = {device.name: device.deployed.get(name, "") for device, _ in devices}
        by = names.get(record.owner, record.owner.hex()[:8])
        rows.append({**_to_json(manifest), "by": by, "operator": record.owner.hex(), "devices": runs})
        lines.append(f"{name}  {manifest.kind}  {manifest.label}  pushed by {by}{_format_history(manifest)}")
        width = max(map(len, runs), default=0)
        lines += [f"  {device:{width}}  {label or '-'}" for device, label in runs.items()]
    return rows, lines or ["no module was pushed"]


def _keys(options: argparse.Namespace, ask: SendRequest) -> Answer:
    keys = {device.name: record.owner.hex() for device, record in ControlClient(options.node, ask).list_devices()}
    width = max(map(len, keys), default=0)
    return keys, [f"{name:{width}}  {key}" for name, key in keys.items()]


def _list_manifests(client: ControlClient) -> list[tuple[Manifest, Record]]:
    records = client.get_records(DEPLOYMENTS)
    return [(manifest, record) for record in records if (manifest := parse_manifest(record)) is not None]


def _publish(client: ControlClient, manifest: Manifest, verb: str) -> Answer:
    replicas = client.put(DEPLOYMENTS, manifest.name, manifest.pack())
    line = f"{verb} {manifest.kind} {manifest.name} {manifest.label}; stored by {replicas} replicas"
    return {**_to_json(manifest), "replicas": replicas}, [line]


def _to_json(manifest: Manifest) -> dict[str, Any]:
    before = [edition.version for edition in manifest.before]
    about = {"name": manifest.name, "kind": manifest.kind, "version": manifest.version, "digest": manifest.digest}
    return {**about, "size": manifest.size, "before": before, "withdrawn": manifest.withdrawn}


def _format_history(manifest: Manifest) -> str:
    withdrawn = f", {manifest.withdrawn} was withdrawn" if manifest.withdrawn > manifest.version else ""
    before = f", previous version {manifest.before[0].version}" if manifest.before else ""
    return withdrawn + before
