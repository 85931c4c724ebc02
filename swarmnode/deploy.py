"""Deploy: ``swarm deploy``, the operator's side of deployment, through a node of this machine.

What is pushed is signed by that node, in whose slot it is stored: its key is the operator's key.
"""

from __future__ import annotations

import argparse
import re
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any, TextIO

from middleware.consensus.deployed import KINDS, PREFIX
from middleware.deployment.manifest import (
    DEPLOYMENTS,
    MAX_SOURCE,
    MAX_VERSION,
    NAME,
    Manifest,
    manifest_of,
    newest,
    pushed,
    rolled_back,
    source_key,
)
from middleware.deployment.module import compiled
from middleware.entangled.control.command import Ask, asked
from middleware.entangled.control.word import printable
from middleware.entangled.record import Record
from middleware.errors import Undeployable
from swarmnode.asker import Asker, Refusal
from swarmnode.team.office import Answer, Desk, Wrong, run

SOURCE = "source"
"""The slot of a source under its key."""


def parser() -> argparse.ArgumentParser:
    """The command line."""
    common = argparse.ArgumentParser(add_help=False)
    common.add_argument("--node", metavar="NAME", help="which node of this machine, where several run")
    common.add_argument("--json", action="store_true", help="answer in JSON, on one line")
    whole = argparse.ArgumentParser(
        prog="swarm deploy",
        description="Push a strategy or a behaviour to the running team.",
        epilog="Nodes run it where their [deployment] allows it, lists the name, and this node's key as an operator.",
    )
    verbs = whole.add_subparsers(dest="verb", required=True, metavar="VERB")

    def verb(name: str, purpose: str) -> argparse.ArgumentParser:
        return verbs.add_parser(name, help=purpose, description=purpose, parents=[common])

    push = verb("push", "Publish a new version of a module, signed by this node.")
    push.add_argument("file", metavar="FILE", help="the Python source, one file")
    push.add_argument("--name", required=True, help=f"what tasks call it, after {PREFIX}")
    push.add_argument("--kind", required=True, choices=KINDS)
    push.add_argument("--version", type=int, metavar="N", help="a higher one than before; the next one if left out")
    back = verb("rollback", "Go back to the version before.")
    back.add_argument("name", metavar="NAME")
    verb("status", "Print what is pushed, and which device runs what.")
    verb("keys", "Print the public key of each device, as [deployment] operators takes it.")
    return whole


def main(words: Sequence[str] | None = None, out: TextIO | None = None, ask: Ask = asked) -> int:
    """Run the command; returns 0, 1 where the node refused, 2 where the command is wrong."""
    verbs = {"push": _push, "rollback": _rollback, "status": _status, "keys": _keys}

    def work(wishes: argparse.Namespace, desk: Desk) -> Answer:
        answer, lines = verbs[wishes.verb](wishes, desk.ask)
        return answer, [printable(line) for line in lines]

    return run(parser(), words, Desk(out or sys.stdout, ask), work)


def _push(wishes: argparse.Namespace, ask: Ask) -> Answer:
    try:
        source = Path(wishes.file).read_bytes()
    except OSError as error:
        raise Wrong(f"{wishes.file} cannot be read: {error.strerror or error}") from error
    if not re.fullmatch(NAME, wishes.name, re.ASCII):
        raise Wrong(f"--name must match {NAME}, is {wishes.name!r}")
    if not 0 < len(source) <= MAX_SOURCE:
        raise Wrong(f"{wishes.file} has {len(source)} bytes; a module has 1 to {MAX_SOURCE}")
    try:
        compiled(source, wishes.name)
    except Undeployable as error:
        raise Wrong(f"{wishes.file}: {error.problem}") from error
    asker = Asker(wishes.node, ask)
    held = newest(each for each, _ in _manifests(asker) if each.name == wishes.name)
    manifest = pushed(wishes.name, wishes.kind, source, held, wishes.version)
    if held is not None and manifest.kind != held.kind:
        raise Refusal(f"{held.name} is a {held.kind}; push it under another name")
    if held is not None and manifest.rank <= held.rank:
        raise Refusal(f"version {manifest.version} is not above {held.rank[0]}, which there was already")
    if not 0 < manifest.version <= MAX_VERSION:
        raise Refusal(f"a version is 1 to {MAX_VERSION}, this one {manifest.version}")
    # The source first: whoever hears of the manifest asks for it at once.
    asker.put(source_key(manifest.digest), SOURCE, source)
    return _published(asker, manifest, "pushed")


def _rollback(wishes: argparse.Namespace, ask: Ask) -> Answer:
    asker = Asker(wishes.node, ask)
    manifests = [each for each, _ in _manifests(asker)]
    held = newest(each for each in manifests if each.name == wishes.name)
    if held is None:
        there = ", ".join(sorted({each.name for each in manifests})) or "nothing at all"
        raise Refusal(f"nothing called {wishes.name!r} was pushed; there is {there}")
    manifest = rolled_back(held)
    if manifest is None:
        raise Refusal(f"there is nothing before version {held.version} of {held.name}")
    return _published(asker, manifest, f"went back from version {held.version}:")


def _status(wishes: argparse.Namespace, ask: Ask) -> Answer:
    asker = Asker(wishes.node, ask)
    devices = asker.devices()
    names = {record.owner: device.name for device, record in devices}
    rows: list[dict[str, Any]] = []
    lines = []
    pairs = _manifests(asker)
    for name in sorted({manifest.name for manifest, _ in pairs}):
        manifest, record = max((p for p in pairs if p[0].name == name), key=lambda p: (p[0].rank, p[0].digest))
        runs = {device.name: device.deployed.get(name, "") for device, _ in devices}
        by = names.get(record.owner, record.owner.hex()[:8])
        rows.append({**_told(manifest), "by": by, "operator": record.owner.hex(), "devices": runs})
        lines.append(f"{name}  {manifest.kind}  {manifest.label}  pushed by {by}{_past(manifest)}")
        width = max(map(len, runs), default=0)
        lines += [f"  {device:{width}}  {label or '-'}" for device, label in runs.items()]
    return rows, lines or ["nothing was pushed"]


def _keys(wishes: argparse.Namespace, ask: Ask) -> Answer:
    keys = {device.name: record.owner.hex() for device, record in Asker(wishes.node, ask).devices()}
    width = max(map(len, keys), default=0)
    return keys, [f"{name:{width}}  {key}" for name, key in keys.items()]


def _manifests(asker: Asker) -> list[tuple[Manifest, Record]]:
    records = asker.records(DEPLOYMENTS)
    return [(manifest, record) for record in records if (manifest := manifest_of(record)) is not None]


def _published(asker: Asker, manifest: Manifest, verb: str) -> Answer:
    replicas = asker.put(DEPLOYMENTS, manifest.name, manifest.packed())
    line = f"{verb} {manifest.kind} {manifest.name} {manifest.label}; {replicas} replicas have it"
    return {**_told(manifest), "replicas": replicas}, [line]


def _told(manifest: Manifest) -> dict[str, Any]:
    before = [edition.version for edition in manifest.before]
    about = {"name": manifest.name, "kind": manifest.kind, "version": manifest.version, "digest": manifest.digest}
    return {**about, "size": manifest.size, "before": before, "withdrawn": manifest.withdrawn}


def _past(manifest: Manifest) -> str:
    taken_back = f", {manifest.withdrawn} was taken back" if manifest.withdrawn > manifest.version else ""
    before = f", before it {manifest.before[0].version}" if manifest.before else ""
    return taken_back + before
