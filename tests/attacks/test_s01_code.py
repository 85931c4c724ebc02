"""Attack S1: execute code from received content, such as pickles, marshalled code, YAML tags and format strings."""

from __future__ import annotations

import ast
import marshal
import pickle
import random
from collections.abc import Iterator
from pathlib import Path

from twisted.logger import formatEvent
from twisted.trial.unittest import SynchronousTestCase

from middleware.entangled.record import hash_key
from middleware.entangled.wire.message import Answer, Notification, Request, decode, encode
from tests.attacks.siege import events_of
from tests.fleet import FleetCase

ROOT = Path(__file__).resolve().parents[2]
ROOMS = ("formats", "middleware", "webnode", "agents", "swarmnode", "drivers")
UNSAFE = (
    *("pickle", "cPickle", "_pickle", "marshal", "shelve", "dill", "cloudpickle", "joblib", "yaml", "jsonpickle"),
    *("code", "codeop", "runpy", "xmlrpc", "imp"),
)
CALLS = ("eval", "exec", "compile", "__import__", "execfile", "input")
ALLOWED = {
    # The content is signed by an operator that the owner of the node allowed; see tests/swarmnode/test_deploy.py.
    ("middleware.deployment.module_loader", "exec"),
    ("middleware.deployment.module_loader", "compile"),
}
LOADERS = {
    # The name of the imported module comes from the settings of the node's owner, or from a table in the source.
    "swarmnode.sandbox",
    *("agents.behaviour", "agents.registry", "drivers.registry", "middleware.consensus.strategy_worker"),
    *("middleware.consensus.strategy", "swarmnode.driver.catalogue", "swarmnode.command"),
    "webnode.routes.registry",
}
HOOKS = {("middleware.entangled.wire.message", hook) for hook in ("ext_hook", "object_hook")}
"""Permitted hooks: the first one rejects every extension type, the second one counts the entries of a map."""
LOG = ("debug", "info", "warn", "error", "critical", "failure")
FIRED: list[str] = []


def fire(what: str) -> str:
    """Record a call; the pickles in the corpus call this function when they are loaded."""
    FIRED.append(what)
    return what


class Mine:
    """An object with a pickle that calls ``fire`` when it is loaded."""

    def __reduce__(self) -> tuple[object, tuple[str]]:
        return fire, ("a pickle was read",)


CORPUS: tuple[bytes, ...] = (
    *(pickle.dumps(Mine(), protocol) for protocol in range(6)),
    b"ctests.attacks.test_s01_code\nfire\n(S'by name'\ntR.",
    marshal.dumps(compile("import tests.attacks.test_s01_code as s; s.fire('code')", "<wire>", "exec")),
    b"!!python/object/apply:tests.attacks.test_s01_code.fire ['yaml']",
    b"__import__('tests.attacks.test_s01_code').attacks.test_s01_code.fire('text')",
    b"{0.__class__.__init__.__globals__} {self} {log_source} %s%n%x ${7*7} {{7*7}} {% raw %}",
    b'{"py/object": "tests.attacks.test_s01_code.Mine", "__class__": "Mine", "$type": "Mine"}',
    b"\xc7\x04\x05code",  # an extension of msgpack
    b"\xd6\xff\x00\x00\x00\x00",
    b"; DROP TABLE record; --",
)
TEXTS = tuple(each.decode("latin-1") for each in CORPUS)


def trees() -> Iterator[tuple[str, ast.Module]]:
    """Return every module that runs on a node."""
    for room in ROOMS:
        for path in sorted((ROOT / room).rglob("*.py")):
            parts = path.relative_to(ROOT).with_suffix("").parts
            yield ".".join(parts), ast.parse(path.read_text(encoding="utf-8"), str(path))


def faults_of(module: str, tree: ast.Module) -> list[str]:
    """Return the lines of a module that could execute received content."""
    fixed = _constants(tree)
    return [
        f"{module} line {getattr(node, 'lineno', 0)}: {why}"
        for node in ast.walk(tree)
        for why in _whys(module, node, fixed)
    ]


def _constants(tree: ast.Module) -> set[str]:
    """Return the names to which a module assigns only constants."""
    given: dict[str, bool] = {}
    for node in ast.walk(tree):
        if isinstance(node, ast.Assign):
            for target in node.targets:
                if isinstance(target, ast.Name):
                    given[target.id] = given.get(target.id, True) and _is_fixed(node.value, set())
    return {name for name, is_fixed in given.items() if is_fixed}


def _whys(module: str, node: ast.AST, fixed: set[str]) -> Iterator[str]:
    if isinstance(node, ast.Import):
        yield from (f"imports {alias.name}" for alias in node.names if alias.name.partition(".")[0] in UNSAFE)
    elif isinstance(node, ast.ImportFrom):
        if (node.module or "").partition(".")[0] in UNSAFE:
            yield f"imports from {node.module}"
    elif isinstance(node, ast.Name) and node.id in CALLS and (module, node.id) not in ALLOWED:
        yield f"names {node.id}"
    elif isinstance(node, ast.Call):
        yield from _of_call(module, node, fixed)


def _of_call(module: str, call: ast.Call, fixed: set[str]) -> Iterator[str]:
    called = call.func.attr if isinstance(call.func, ast.Attribute) else getattr(call.func, "id", "")
    of = call.func.value if isinstance(call.func, ast.Attribute) else None
    first = call.args[0] if call.args else None
    named = {keyword.arg: keyword.value for keyword in call.keywords}
    if called == "import_module" and module not in LOADERS and not _is_fixed(first, fixed):
        yield "loads a module by a name that is no constant"
    if called in ("system", "popen", "spawnl", "spawnv") and isinstance(of, ast.Name) and of.id == "os":
        yield f"calls os.{called}"
    shell = named.get("shell")
    if shell is not None and not (isinstance(shell, ast.Constant) and shell.value is False):
        yield "starts a shell"
    if called in ("format", "format_map") and of is not None and not _is_fixed(of, fixed):
        yield "formats by a text that is no constant"
    is_log = called in LOG and isinstance(of, ast.Attribute | ast.Name) and _last(of) in ("_log", "log")
    if is_log and call.args and not _is_fixed(first, fixed):
        yield "logs by a format that is no constant"
    if called in ("unpackb", "Unpacker"):
        for hook in ("object_hook", "ext_hook", "object_pairs_hook"):
            if hook in named and (module, hook) not in HOOKS:
                yield f"unpacks with {hook}"
        strict = named.get("strict_map_key")
        if strict is not None and not (isinstance(strict, ast.Constant) and strict.value is True):
            yield "unpacks with keys of any kind"
    is_statement = called in ("execute", "executescript", "executemany")
    if is_statement and isinstance(first, ast.BinOp | ast.JoinedStr) and not _is_fixed(first, fixed):
        yield "makes SQL of parts"


def _is_fixed(node: ast.AST | None, fixed: set[str]) -> bool:
    """Return whether a string is constant in the source, as a whole or in all of its parts."""
    if isinstance(node, ast.IfExp):
        return _is_fixed(node.body, fixed) and _is_fixed(node.orelse, fixed)
    if isinstance(node, ast.BinOp):
        return _is_fixed(node.left, fixed) and _is_fixed(node.right, fixed)
    if isinstance(node, ast.JoinedStr):
        return all(_is_fixed(part, fixed) for part in node.values)
    if isinstance(node, ast.FormattedValue | ast.Subscript):
        return _is_fixed(node.value, fixed)
    return isinstance(node, ast.Constant) or (isinstance(node, ast.Name) and (node.id.isupper() or node.id in fixed))


def _last(node: ast.AST) -> str:
    return node.attr if isinstance(node, ast.Attribute) else getattr(node, "id", "")


class TreeTests(SynchronousTestCase):
    def test_nothing_in_the_tree_runs_content(self) -> None:
        """No module of a node evaluates, unpickles or imports received content, or uses it as a format string."""
        found = [fault for module, tree in trees() for fault in faults_of(module, tree)]
        self.assertEqual(found, [])

    def test_the_check_bites(self) -> None:
        """The check finds each forbidden construct."""
        for source in (
            "import pickle",
            "from yaml import load",
            "import marshal as m",
            "eval(wire)",
            "[exec][0](wire)",
            "__import__(name)",
            "importlib.import_module(name)",
            "os.system(wire)",
            "subprocess.run(wire, shell=True)",
            "wire.format(self)",
            "self._log.info(wire)",
            "_log.warn(wire + '')",
            "msgpack.unpackb(wire, ext_hook=made)",
            "msgpack.unpackb(wire, strict_map_key=False)",
            "db.execute('select ' + name)",
        ):
            self.assertEqual(len(faults_of("webnode.x", ast.parse(source))), 1, source)
        for source in ("'{}'.format(1)", "self._log.info('{text}', text=wire)", "import_module('agents.search')"):
            self.assertEqual(faults_of("webnode.x", ast.parse(source)), [], source)


class ContentTests(FleetCase):
    def setUp(self) -> None:
        super().setUp()
        FIRED.clear()
        self.events = events_of(self)

    def test_the_corpus_fires(self) -> None:
        """The corpus is effective: unpickling it calls ``fire``."""
        pickle.loads(CORPUS[0])
        self.assertEqual(FIRED, ["a pickle was read"])

    def test_values_stay_bytes(self) -> None:
        """The corpus survives as the value of a record unchanged, and no code in it is executed."""
        fleet = self.fleet(3)
        for place, value in enumerate(CORPUS):
            key = hash_key(f"corpus {place}")
            self.done(fleet, fleet.nodes[0].put(key, f"{place}", value), 1.0)
            found = self.done(fleet, fleet.nodes[2].get(key), 1.0)
            self.assertEqual([record.value for record in found], [value])
        self.assertEqual(FIRED, [])

    def test_messages_stay_data(self) -> None:
        """As methods, arguments, answers and reasons, the corpus is data or malformed; no code in it is executed."""
        for text, raw in zip(TEXTS, CORPUS, strict=True):
            for message in (
                Request(1, text[:60], (raw, text, [raw])),
                Answer(1, {text: raw}),
                Notification("t", (raw,)),
            ):
                self.assertEqual(decode(encode(message)), message)
            try:
                decode(raw)
            except Exception as error:
                self.assertEqual(type(error).__name__, "Malformed")
        self.assertEqual(FIRED, [])

    def test_a_team_hears_them(self) -> None:
        """As text messages, the corpus arrives unchanged, and no log line expands it."""
        swarm = self.swarm(2)
        heard: list[str] = []
        swarm.nodes[1].on_message(heard.append)
        texts = [text[:100] for text in TEXTS if text.isprintable()]
        for text in texts:
            self.done(
                swarm,
                swarm.nodes[0].entangled.call(swarm.nodes[1].entangled.contact, "device.message", text, changes=True),
                0.5,
            )
        self.assertEqual(heard, texts)
        self.assertEqual(FIRED, [])
        logged = [formatEvent(event) for event in self.events]
        self.assertFalse([line for line in logged if "<class" in line or "49" in line and "7*7" in line])

    def test_any_bytes_as_methods(self) -> None:
        """A method that is not exposed is rejected, whatever its name is."""
        fleet = self.fleet(2)
        dice = random.Random(3)
        names = ["__class__", "endpoint.stop", "eval", *(dice.randbytes(8).hex() for _ in range(20))]
        for name in names:
            asked = fleet.nodes[0].endpoint.ask(fleet.nodes[1].contact, name, CORPUS[0])
            fleet.run(1.0)
            self.assertIn("no such method here", str(self.failureResultOf(asked).value))
        self.assertEqual(FIRED, [])
