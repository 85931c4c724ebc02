"""The commands ``swarm dht``, ``swarm tuple``, ``swarm keyword`` and ``swarm rpc``.

The commands send requests to the node of this machine, and import only the standard library to start fast.
"""

from __future__ import annotations

import argparse
import json
import socket
import struct
import sys
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any, TextIO

from middleware.entangled.control import conversion
from middleware.entangled.control.socket_path import NoControl, check_owner, check_socket, find_socket

EXIT_FAILED, EXIT_USAGE = 1, 2
FIELDS_HELP = """fields:     7  1.5  true  null  "7"  words       valid JSON, otherwise text
templates:  _  any;  ?int ?float ?str ?bytes ?bool  a type;  >5  <=5  !=red  in:a,b  prefix:job-  a predicate
example:    swarm tuple get job ?int --wait 10"""
KEYS_HELP = "A key is any text, or id: followed by 40 hexadecimal digits.  Example: swarm dht put greeting hello"
KEYWORD_HELP = "Example: swarm keyword search red ball"

SendRequest = Callable[[Path, dict[str, Any]], Iterator[dict[str, Any]]]


def make_parser(group: str) -> argparse.ArgumentParser:
    """Return the argument parser of one group of verbs."""
    common = argparse.ArgumentParser(add_help=False)
    common.add_argument("--node", metavar="NAME", help="name of the node, if several run on this machine")
    common.add_argument("--json", action="store_true", help="print JSON, one line per answer")
    if group == "rpc":
        rpc = argparse.ArgumentParser(
            prog="swarm rpc",
            parents=[common],
            description="Call a method of a node.  Example: swarm rpc 192.168.1.10:8484 ping",
        )
        rpc.add_argument("node_asked", metavar="NODE", help="HOST:PORT, or the first digits of a known node's id")
        rpc.add_argument("method", help="name of the method, such as ping")
        rpc.add_argument("arguments", nargs="*", default=[], help="valid JSON, otherwise text")
        rpc.add_argument("--changes", action="store_true", help="the method changes state and must run only once")
        rpc.set_defaults(verb="rpc")
        return rpc
    build = {"dht": _add_dht_commands, "tuple": _add_tuple_commands, "keyword": _add_keyword_commands}[group]
    top = argparse.ArgumentParser(
        prog=f"swarm {group}",
        epilog={"tuple": FIELDS_HELP, "dht": KEYS_HELP, "keyword": KEYWORD_HELP}[group],
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    verbs = top.add_subparsers(dest="verb", required=True, metavar="VERB")

    def verb(name: str, purpose: str, example: str) -> argparse.ArgumentParser:
        epilog = f"Example: swarm {group} {name} {example}"
        subparser = verbs.add_parser(name, help=purpose, description=purpose, epilog=epilog, parents=[common])
        subparser.set_defaults(verb=f"{group} {name}")
        return subparser

    build(verb)
    return top


def _add_dht_commands(verb: Callable[[str, str, str], argparse.ArgumentParser]) -> None:
    get = verb("get", "Print the records under a key.", "greeting")
    get.add_argument("key")
    get.add_argument(
        "--concern", choices=("fast", "majority"), default="majority", help="number of replicas that must reply"
    )
    put = verb("put", "Store a value under a key, in this node's own slot.", "greeting hello")
    put.add_argument("key")
    put.add_argument("value", help="text, - for standard input, or @FILE")
    put.add_argument("--name", default="", help="name of this node's slot under the key")
    put.add_argument(
        "--lifetime",
        choices=("team", "leased"),
        default="team",
        help="team: keep the value when this node leaves; leased: remove it",
    )
    put.add_argument(
        "--concern",
        choices=("one", "majority", "all"),
        default="majority",
        help="number of replicas that must store the value",
    )
    put.add_argument(
        "--expect",
        type=int,
        metavar="SEQUENCE",
        help="store only if the slot has this sequence number; 0: only if it is empty",
    )
    remove = verb("remove", "Remove this node's value under a key.", "greeting")
    remove.add_argument("key")
    remove.add_argument("--name", default="")
    verb("find", "Print the nodes closest to a key.", "greeting").add_argument("key")
    verb("watch", "Print the records under a key on each change, until Ctrl-C.", "greeting").add_argument("key")


def _add_keyword_commands(verb: Callable[[str, str, str], argparse.ArgumentParser]) -> None:
    publish = verb("publish", "Publish data under every word of a name.", "'red ball' @ball.json")
    publish.add_argument("name")
    publish.add_argument("value", help="text, - for standard input, or @FILE")
    verb("search", "Print the publications whose names contain all of the words.", "red ball").add_argument(
        "words", nargs="+"
    )
    verb("watch", "Print the publications with a word on each change, until Ctrl-C.", "ball").add_argument("words")
    verb("remove", "Remove this node's publication under a name.", "'red ball'").add_argument("name")


def _add_tuple_commands(verb: Callable[[str, str, str], argparse.ArgumentParser]) -> None:
    put = verb("put", "Put a tuple into the space.", "job 7 --ttl 60")
    put.add_argument("fields", nargs="+", metavar="FIELD")
    put.add_argument("--ttl", type=float, metavar="SECONDS", help="remove the tuple after this time")
    get = verb("get", "Take a matching tuple out of the space.", "job ?int --wait 10")
    read = verb("read", "Print a matching tuple without taking it.", "job ?int --all")
    for each in (get, read):
        each.add_argument("template", nargs="+", metavar="FIELD")
        each.add_argument("--wait", type=float, metavar="SECONDS", help="wait for a matching tuple for that time")
    read.add_argument("--all", action="store_true", help="print all matching tuples")


def make_request(options: argparse.Namespace) -> dict[str, Any]:
    """Return the request of a command line; raise ``conversion.InvalidValue``, also for an unreadable file."""
    given = {name: value for name, value in vars(options).items() if name not in ("verb", "node", "json")}
    if "node_asked" in given:
        given["node"] = given.pop("node_asked")
    if isinstance(given.get("words"), list):
        given["words"] = " ".join(given["words"])
    for name, read in (
        ("fields", conversion.parse_field),
        ("arguments", _json_or_text),
        ("template", conversion.parse_template_field),
    ):
        if name in given:
            given[name] = [read(each) for each in given[name]]
    if "value" in given:
        given["value"] = _read_value(given["value"])
    return {"verb": options.verb, "with": {name: value for name, value in given.items() if value is not None}}


def send_request(path: Path, request: dict[str, Any]) -> Iterator[dict[str, Any]]:
    """Send ``request`` to the socket at ``path`` and yield the answer's lines; raise ``NoControl`` on failure."""
    check_socket(path)
    with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as connection:
        try:
            connection.connect(str(path))
            check_peer(connection, path)
            connection.sendall(json.dumps(request).encode() + b"\n")
            with connection.makefile("rb") as lines:
                for line in lines:
                    yield json.loads(line)
        except (OSError, ValueError) as error:
            why = getattr(error, "strerror", None) or error
            raise NoControl(
                f"the node of {path} does not answer ({why}); start the node, or remove this file"
            ) from error


def check_peer(connection: socket.socket, path: Path) -> None:
    """Raise ``NoControl`` if a process of another user listens; systems without ``SO_PEERCRED`` are not checked."""
    option = getattr(socket, "SO_PEERCRED", None)
    if option is None:
        return
    credentials = struct.Struct("3i")
    _, user, _ = credentials.unpack(connection.getsockopt(socket.SOL_SOCKET, option, credentials.size))
    if user not in (check_owner(path.parent), 0):
        raise NoControl(f"another user's process listens at {path}; remove this file and restart the node")


def main(group: str, words: Sequence[str], out: TextIO | None = None, ask: SendRequest = send_request) -> int:
    """Run one command; return 0, 1 (nothing found, or the node rejected the request), or 2 (wrong command)."""
    out = out or sys.stdout
    options = make_parser(group).parse_args(words)
    try:
        request = make_request(options)
        path = find_socket(options.node)
        for line in ask(path, request):
            if "error" in line:
                if options.json:
                    out.write(conversion.format_json(line) + "\n")
                return _fail(group, line["text"], EXIT_USAGE if line["error"] == "BadRequest" else EXIT_FAILED)
            answer = line["answer"] if "answer" in line else line.get("event")
            out.write("".join(f"{text}\n" for text in _format_answer(options.verb, answer, options.json)))
            out.flush()
            if "answer" in line:
                return EXIT_FAILED if _is_empty(options.verb, answer) else 0
    except KeyboardInterrupt:
        return 0
    except (NoControl, conversion.InvalidValue, OSError) as problem:
        return _fail(group, problem, EXIT_USAGE)
    return _fail(group, "the node closed the connection without an answer", EXIT_FAILED)


def _format_answer(verb: str, answer: Any, is_json: bool) -> list[str]:
    if is_json:
        return [conversion.format_json(answer)]
    if answer is None:
        return []
    if verb == "dht find":
        return [conversion.remove_control_characters(f"{each['id']}  {each['host']}:{each['port']}") for each in answer]
    if verb in ("dht get", "dht watch", "keyword search", "keyword watch"):
        rows = [f"{each['owner'][:10]}  {each['name'] or '-'}  {_format_value(each['value'])}" for each in answer]
        lines = [conversion.remove_control_characters(row) for row in rows]
        return [*lines, *([""] if verb.endswith("watch") else [])]
    if verb == "tuple read" and answer and isinstance(answer[0], list):
        return [conversion.format_tuple(each) for each in answer]
    if verb in ("tuple get", "tuple read"):
        return [conversion.format_tuple(answer)]
    if isinstance(answer, dict) and "replicas" in answer:
        return [f"stored at {answer['replicas']} replicas"]
    return [conversion.format_json(answer)]


def _is_empty(verb: str, answer: Any) -> bool:
    return verb in ("dht get", "tuple get", "tuple read", "keyword search") and not answer


def _format_value(value: Any) -> str:
    return value if isinstance(value, str) else json.dumps(value)


def _json_or_text(text: str) -> Any:
    try:
        return json.loads(text)
    except (ValueError, RecursionError):
        return text


def _read_value(text: str) -> Any:
    if text == "-":
        return conversion.to_json(sys.stdin.buffer.read())
    if text.startswith("@"):
        try:
            return conversion.to_json(Path(text[1:]).read_bytes())
        except OSError as error:
            raise conversion.InvalidValue(f"{text[1:]} cannot be read: {error.strerror or error}") from error
    return text


def _fail(group: str, problem: object, code: int) -> int:
    sys.stderr.write(conversion.remove_control_characters(f"swarm {group}: {problem}") + "\n")
    return code
