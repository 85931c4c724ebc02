"""The rules of the codebase as tests: imports, pure modules, packaging, and the form of tests."""

from __future__ import annotations

import ast
import configparser
import re
import subprocess
import sys
from collections.abc import Iterator
from importlib.metadata import packages_distributions
from pathlib import Path

from setuptools import find_namespace_packages
from twisted.trial.unittest import SynchronousTestCase

from tests.layers import LAYERS, TOP, is_within, may_import

ROOT = Path(__file__).resolve().parent.parent
# Modules without input and output: bytes and ``now`` are arguments, decisions are results.
PURE = (
    "agents.behaviour",
    "agents.decider",
    "agents.decision",
    "agents.task_group",
    "agents.task_queue",
    "agents.execution",
    "agents.formation",
    "agents.motion",
    "agents.behaviour_process",
    "agents.report",
    "agents.state",
    "drivers.aibo.menu",
    "drivers.aibo.picture",
    "drivers.aibo.sensors",
    "drivers.errors",
    "drivers.gate",
    "formats.jpeg",
    "drivers.reading",
    "drivers.rosbridge.websocket",
    "middleware.admission.certificate",
    "middleware.admission.join_code",
    "middleware.admission.errors",
    "middleware.admission.join_codec",
    "middleware.admission.membership_list",
    "middleware.admission.sealed_box",
    "middleware.admission.statement",
    "middleware.consensus.strategies.average",
    "middleware.consensus.strategies.capability_cost",
    "middleware.consensus.strategies.cbba",
    "middleware.consensus.conformance",
    "middleware.consensus.strategies.group_optimal",
    "middleware.consensus.strategies.hungarian",
    "middleware.consensus.assignment",
    "middleware.consensus.strategies.nearest",
    "middleware.consensus.remote_strategy",
    "middleware.consensus.strategies.rendezvous",
    "middleware.consensus.strategies.sequential",
    "middleware.consensus.strategy",
    "middleware.consensus.bidding.announcement",
    "middleware.consensus.bidding.auction",
    "middleware.consensus.bidding.recipients",
    "middleware.consensus.bidding.bid",
    "middleware.consensus.bidding.bid_delivery",
    "middleware.consensus.bidding.outgoing_message",
    "middleware.consensus.bidding.flood",
    "middleware.consensus.bidding.participant",
    "middleware.consensus.bidding.merge_rule",
    "middleware.consensus.bidding.path_choice",
    "middleware.consensus.bidding.summary",
    "middleware.consensus.bidding.announcer",
    "middleware.consensus.bidding.tree",
    "middleware.consensus.report_view",
    "middleware.consensus.strategies.weighted_vote",
    "middleware.consensus.deployed_modules",
    "middleware.deployment.module_channel",
    "middleware.deployment.manifest",
    "middleware.entangled.replication.cache",
    "middleware.entangled.bounded",
    "middleware.entangled.errors",
    "middleware.entangled.identity",
    "middleware.entangled.contact",
    "middleware.entangled.kademlia.lookup",
    "middleware.entangled.kademlia.routing_table",
    "middleware.entangled.network.layer",
    "middleware.entangled.network.network",
    "middleware.entangled.network.nat_router",
    "middleware.entangled.network.selfsigned",
    "middleware.entangled.network.url",
    "middleware.entangled.network.websocket",
    "middleware.entangled.nat.candidate",
    "middleware.entangled.nat.path_kind",
    "middleware.entangled.record",
    "middleware.entangled.kademlia.member_table",
    "middleware.entangled.space.take_codec",
    "middleware.entangled.quorum.acceptor",
    "middleware.entangled.quorum.ballot",
    "middleware.entangled.quorum.acceptor_log",
    "middleware.entangled.quorum.proposer",
    "middleware.entangled.quorum.register",
    "middleware.entangled.space.tuple_record",
    "middleware.entangled.space.template",
    "middleware.entangled.token_bucket",
    "middleware.entangled.wire.congestion",
    "middleware.entangled.wire.admission_check",
    "middleware.entangled.wire.message",
    "middleware.entangled.wire.noise",
    "middleware.entangled.wire.rejection",
    "middleware.entangled.wire.session",
    "middleware.errors",
    "middleware.faults.kinds",
    "middleware.frontend.team_view",
    "middleware.faults.stream",
    "middleware.faults.takeover",
    "middleware.entangled.control.link_quality",
    "middleware.directory.listing",
    "middleware.tasks.order",
    "middleware.consensus.bidding.reporters",
    "middleware.diagnostics.explanation",
    "middleware.directory.presence",
    "middleware.directory.prefix",
    "middleware.admission.roles",
    "middleware.config.settings",
    "middleware.tasks.task",
    "middleware.consensus.decision_record",
    "sim.robots.crowd.controller",
    "sim.robots.crowd.crowd",
    "sim.robots.crowd.camera",
    "sim.robots.crowd.sensor",
    "sim.robots.crowd.scene",
    "sim.robots.crowd.picture",
    "sim.robots.crowd.ray",
    "sim.robots.crowd.search",
    "sim.demo.configuration",
    "sim.demo.experiment",
    "sim.demo.state_changes",
    "sim.team.checker",
    "sim.team.event",
    "sim.team.faults.barrier",
    "sim.team.faults.settings",
    "sim.team.faults.timeline",
    "sim.team.metric",
    "sim.team.history",
    "sim.team.invariant",
    "sim.team.link",
    "sim.team.scale.curve",
    "sim.team.scale.drawing",
    "sim.team.scale.markdown",
    "sim.team.scale.theory",
    "sim.team.scenario",
    "sim.team.durations",
    "formats",
    "swarmnode.doctor.diagnosis",
    "swarmnode.doctor.facts",
    "swarmnode.doctor.team",
    "swarmnode.doctor.network_path",
    "swarmnode.systemd.unit",
    "webnode.errors",
    "webnode.sanitize",
    "webnode.request_guard",
    "webnode.state_journal",
    "webnode.route",
    "webnode.state",
)
PURE_LAST_NAMES = ("codec",)
NOT_IN_PURE = ("twisted", "time", "socket", "threading", "asyncio", "selectors", "subprocess", "secrets", "sqlite3")

# Of the lower layers, only these modules may use the machine's clock, sockets, threads or random generator.
EDGES = (
    "drivers.camera.picture_stream",
    "drivers.deadman.supervisor",
    "drivers.deadman.process",
    "drivers.link",
    "drivers.serial",
    "middleware.consensus.process_strategy",
    "middleware.deployment.process_channel",
    "middleware.entangled.control.command",
    "middleware.entangled.clock",
    "middleware.entangled.network.interface",
    "middleware.entangled.network.lan",
    "middleware.entangled.network.tcp",
    "middleware.entangled.network.udp",
    "middleware.entangled.data.writer_thread",
    "middleware.faults.process",
)
WORLD = ("time", "socket", "threading", "asyncio", "selectors", "subprocess", "secrets", "twisted.internet.reactor")
GUARDED = ("formats", "middleware", "agents", "drivers")

ON_DEMAND = (
    *("middleware.deployment", "middleware.diagnostics.explanation", "middleware.consensus.decision_record"),
    *("middleware.admission.team", "middleware.admission.membership_list"),
)
HEAVY = (
    *("flask", "jinja2", "segno", "prometheus_client", "OpenSSL", "cryptography"),
    *("cv2", "numpy", "pymunk", "serial", "playwright", "roslibpy", "autobahn"),
    *("wsproto", "h11"),
)


def _files() -> dict[str, Path]:
    found = {}
    for room in TOP:
        for path in sorted((ROOT / room).rglob("*.py")):
            parts = path.relative_to(ROOT).with_suffix("").parts
            found[".".join(parts[:-1] if parts[-1] == "__init__" else parts)] = path
    return found


FILES = _files()
TREES = {module: ast.parse(path.read_text(encoding="utf-8"), str(path)) for module, path in FILES.items()}


def _is_within_any(name: str, *packages: str) -> bool:
    return any(is_within(name, one) for one in packages)


def _imports(module: str) -> list[str]:
    return sorted(set(_import_names(module)))


def _import_names(module: str) -> Iterator[str]:
    """Yield each module that ``module`` imports, anywhere in the file; a name in a package is listed as its module."""
    for node in ast.walk(TREES[module]):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            source = node.module or ""
            for alias in node.names:
                whole = f"{source}.{alias.name}"
                yield whole if whole in FILES or whole in WORLD else source


def _ours(module: str) -> list[str]:
    return [name for name in _imports(module) if _is_within_any(name, "tests", *TOP)]


def _crosses(module: str, name: str) -> bool:
    """Return whether ``module`` must not import ``name``."""
    if module.startswith("drivers.") and name.startswith("drivers.") and module != "drivers.registry":
        # A kind of robot never imports a different kind; only the registry imports all kinds.
        kinds = {file.split(".")[1] for file in FILES if re.fullmatch(r"drivers\.\w+\.driver", file)}
        return name.split(".")[1] in kinds - {module.split(".")[1]}
    return not may_import(module, name)


class FloorPlanTests(SynchronousTestCase):
    """Imports only go to lower layers."""

    def test_imports_follow_the_floor_plan(self) -> None:
        """No module imports a package of a higher layer or a parallel branch, or one hidden behind an interface."""
        wrong = [f"{module} imports {name}" for module in FILES for name in _ours(module) if _crosses(module, name)]
        self.assertEqual(wrong, [])

    def test_every_layer_has_a_wall(self) -> None:
        """For each package except the topmost, the check above detects an import of a package in a higher layer."""
        above = [
            ("middleware.entangled.wire", "middleware.entangled.kademlia.overlay"),
            ("middleware.entangled.space", "middleware.entangled.node"),
            ("middleware.consensus.lease", "middleware.tasks.task"),
            ("middleware.tasks", "middleware.consensus.strategy"),
            ("middleware.consensus", "middleware.consensus.bidding.bid"),
            ("middleware", "middleware.config.settings"),
            *((package, "swarmnode.service") for package in LAYERS if package != "swarmnode"),
        ]
        self.assertEqual([pair for pair in above if not _crosses(f"{pair[0]}.new", pair[1])], [])

    def test_middleware_has_packages(self) -> None:
        """``middleware`` contains no modules except the node and the errors."""
        flat = {module for module in FILES if module.count(".") == 1 and module.startswith("middleware.")}
        modules = {module for module in flat if FILES[module].name != "__init__.py"}
        self.assertEqual(modules, {"middleware.errors", "middleware.node"})

    def test_imports_are_absolute(self) -> None:
        """No module uses a relative import, so the code can be searched by module name."""
        wrong = [
            f"{module} line {node.lineno}"
            for module, tree in TREES.items()
            for node in ast.walk(tree)
            if isinstance(node, ast.ImportFrom) and node.level
        ]
        self.assertEqual(wrong, [])

    def test_imports_make_no_circle(self) -> None:
        """No module imports itself indirectly; imports in functions and for types are included."""
        arrows = {module: sorted({name for name in _ours(module) if name in FILES} - {module}) for module in FILES}
        done: set[str] = set()
        circles: list[str] = []

        def walk(module: str, path: tuple[str, ...]) -> None:
            if module in path:
                circles.append(" -> ".join((*path[path.index(module) :], module)))
            elif module not in done:
                for name in arrows[module]:
                    walk(name, (*path, module))
                done.add(module)

        for module in FILES:
            walk(module, ())
        self.assertEqual(circles, [])


class PurityTests(SynchronousTestCase):
    """Logic depends only on its arguments; only listed modules access the outside world."""

    def test_pure_modules_touch_no_world(self) -> None:
        """The modules listed as pure do not import Twisted, the clock, sockets, threads or stores."""
        wrong = [
            f"{module} imports {name}"
            for module in FILES
            if _is_within_any(module, *PURE) or module.split(".")[-1] in PURE_LAST_NAMES
            for name in _imports(module)
            if _is_within_any(name, *NOT_IN_PURE)
        ]
        self.assertEqual(wrong, [])

    def test_world_enters_at_the_edges_only(self) -> None:
        """In the lower layers only the listed modules import the clock, sockets, threads or the reactor."""
        wrong = [
            f"{module} imports {name}; take it as an argument, or make it an edge"
            for module in FILES
            if _is_within_any(module, *GUARDED) and module not in EDGES
            for name in _imports(module)
            if _is_within_any(name, *WORLD)
        ]
        self.assertEqual(wrong, [])

    def test_dice_are_handed_in(self) -> None:
        """No module uses the global random generator (``random.random()``); only ``random.Random`` is permitted."""
        wrong = []
        for module in FILES:
            for node in ast.walk(TREES[module]):
                named = ""
                if isinstance(node, ast.Attribute) and isinstance(node.value, ast.Name) and node.value.id == "random":
                    named = node.attr
                elif isinstance(node, ast.ImportFrom) and node.module == "random":
                    named = next((alias.name for alias in node.names if alias.name != "Random"), "")
                if named not in ("", "Random") and (named != "SystemRandom" or _is_within_any(module, *GUARDED)):
                    wrong.append(f"{module} line {getattr(node, 'lineno', 0)}: random.{named}")
        self.assertEqual(wrong, [])

    def test_nobody_replaces_a_listener(self) -> None:
        """An attribute ``on_...`` is set only by its own object; other code adds a listener to its ``Listeners``."""
        wrong = []
        for module in FILES:
            for node in ast.walk(TREES[module]):
                targets = node.targets if isinstance(node, ast.Assign) else []
                for target in targets:
                    if not isinstance(target, ast.Attribute) or not target.attr.startswith("on_"):
                        continue
                    if not isinstance(target.value, ast.Name) or target.value.id != "self":
                        wrong.append(f"{module} line {target.lineno}: {target.attr}")
        self.assertEqual(wrong, [])

    def test_package_files_hold_only_a_docstring(self) -> None:
        """An ``__init__`` runs no code, so importing a module does not import the other modules of the package."""
        wrong = [
            str(path.relative_to(ROOT))
            for module, path in FILES.items()
            if path.name == "__init__.py"
            and not all(isinstance(n, ast.Expr) and isinstance(n.value, ast.Constant) for n in TREES[module].body)
        ]
        self.assertEqual(wrong, [])

    def test_edge_node_loads_nothing_heavy(self) -> None:
        """The service, the node and the simulated driver load no libraries of the page or the simulator."""
        wanted = [
            name
            for name in ("middleware.node", "agents.loop", "drivers.registry", "drivers.sim.driver")
            if name in FILES
        ]
        program = (
            f"import sys, importlib; [importlib.import_module(n) for n in {['swarmnode.plugin', *wanted]!r}]; "
            f"print(*[n for n in {HEAVY!r} if n in sys.modules])"
        )
        child = subprocess.run([sys.executable, "-c", program], cwd=ROOT, capture_output=True, text=True, timeout=60)
        self.assertEqual((child.returncode, child.stdout.strip()), (0, ""), child.stderr)

    def test_plain_node_loads_what_it_needs(self) -> None:
        """A node without agent, page and deployment loads neither decision records nor the runner of pushed modules."""
        program = "import sys, swarmnode.plugin; print(*[n for n in sys.modules if n.startswith(('middleware.',))])"
        child = subprocess.run([sys.executable, "-c", program], cwd=ROOT, capture_output=True, text=True, timeout=60)
        unwanted = [name for name in child.stdout.split() if _is_within_any(name, *ON_DEMAND)]
        self.assertEqual((child.returncode, unwanted), (0, []), child.stderr)

    def test_node_runs_no_pushed_code(self) -> None:
        """The modules loaded by a node with deployment do not import the module that runs pushed source."""
        known, left = set[str](), ["middleware.deployment.deployment", "middleware.deployment.process_channel"]
        while left:
            module = left.pop()
            known.add(module)
            left += [name for name in _ours(module) if name in FILES and name not in known]
        self.assertEqual(known & {"middleware.deployment.module_loader", "middleware.deployment.module_host"}, set())


class PackagingTests(SynchronousTestCase):
    """The installed packages are the packages in the source tree."""

    def setUp(self) -> None:
        self.setup = configparser.ConfigParser()
        self.setup.read(ROOT / "setup.cfg", encoding="utf-8")

    def test_wheel_has_every_package(self) -> None:
        """The wheel contains every package; in an editable install a missing package would not be noticed."""
        search = self.setup["options.packages.find"]
        wheel = find_namespace_packages(str(ROOT), search["exclude"].split(), search["include"].split())
        found = {".".join(path.parent.relative_to(ROOT).parts) for room in TOP for path in (ROOT / room).rglob("*.py")}
        self.assertEqual(set(wheel), found | {"twisted.plugins"})

    def test_every_room_is_marked_as_typed(self) -> None:
        """Each package contains ``py.typed``, without which type checkers ignore the package's annotations."""
        self.assertEqual([room for room in TOP if not (ROOT / room / "py.typed").exists()], [])

    def test_twisted_is_not_hidden(self) -> None:
        """The ``twisted`` folders have no ``__init__.py``, which would hide Twisted or the plugin."""
        self.assertEqual(list((ROOT / "twisted").rglob("__init__.py")), [])

    def test_nobody_else_owns_our_names(self) -> None:
        """No other installed distribution has a top-level package of the same name as ours; the files would mix."""
        owners = packages_distributions()
        foreign = {
            room: others
            for room in TOP
            if (others := sorted({name for name in owners.get(room, []) if name.lower() != "swarm-node"}))
        }
        self.assertEqual(foreign, {}, "give swarm-node a virtual environment of its own")


class TestCustomTests(SynchronousTestCase):
    """The form of tests."""

    def test_every_test_says_what_it_shows(self) -> None:
        """Each test method has a docstring, each test folder an ``__init__.py``, and no test uses ``unittest.mock``."""
        wrong = []
        for path in sorted((ROOT / "tests").rglob("*.py")):
            tree = ast.parse(path.read_text(encoding="utf-8"), str(path))
            where = path.relative_to(ROOT)
            if not (path.parent / "__init__.py").exists():
                wrong.append(f"{path.parent.relative_to(ROOT)} has no __init__.py")
            for node in ast.walk(tree):
                if isinstance(node, ast.FunctionDef) and node.name.startswith("test_") and not ast.get_docstring(node):
                    wrong.append(f"{where} line {node.lineno}: {node.name} has no docstring")
                if isinstance(node, ast.ImportFrom) and node.module in ("unittest", "unittest.mock"):
                    wrong.append(f"{where} line {node.lineno}: use a fake that ships, not a patch")
        self.assertEqual(wrong, [])

    def test_tests_wait_for_conditions(self) -> None:
        """No test sleeps; ``tests.live.until`` is the only function that waits for another process."""
        texts = {path: path.read_text(encoding="utf-8") for path in (ROOT / "tests").rglob("*.py")}
        sleeping = {
            path.relative_to(ROOT).as_posix()
            for path, text in texts.items()
            if "sleep" in text
            for node in ast.walk(ast.parse(text))
            if isinstance(node, ast.Call) and ast.unparse(node.func) in ("time.sleep", "sleep")
        }
        self.assertEqual(sleeping, {"tests/live/until.py"})
