# Every door of the project.  `make` alone prints them.

PYTHON ?= python3
VENV   := .venv
PY     := $(VENV)/bin/python
SEED   ?= 1
ROBOT  ?= aibo
LOSE   ?= node
N      ?= 20
REAL   ?= 0
HEADLESS ?=
WEB_HOST ?= 127.0.0.1
WEB_PORT ?=
TLS    ?=
NODES  ?= 8,32
SECONDS ?= 5
JOBS   ?= $(shell nproc 2>/dev/null || echo 1)
PEERS  ?=
QUICK  ?=
DOCS   ?=
LOG    ?=
SCHEDULER ?=
NAT    ?=

# Wheels only: nothing is ever compiled here.  Our own tree is installed without a build sandbox,
# so that a second run needs no network.
PIP     := $(PY) -m pip --disable-pip-version-check --quiet install --only-binary :all:
INSTALL := $(PIP) --no-build-isolation --editable
RUNTIME := $(VENV)/.stamp-runtime
DEV     := $(VENV)/.stamp-dev
BROWSER := $(VENV)/.stamp-browser
BENCH   := $(VENV)/.stamp-bench
DOCUMENTS := $(VENV)/.stamp-docs
CONTRACT := $(VENV)/contract
UNIT    := $(filter-out tests.live,$(sort $(subst /,.,$(patsubst %/__init__.py,%,$(wildcard tests/*/__init__.py))) \
    $(subst /,.,$(patsubst %.py,%,$(wildcard tests/test_*.py)))))

.PHONY: help demo test trials check format cov live contract schedules stops bugs slice browser \
    live-nat bench-demo bench-page bench-dht bench-consensus bench-takeover bench-flood bench-robots bench-crowd \
    bench-scale docs dist clean

help:
	@echo 'make demo [HEADLESS=1] [SEED=1]       three robots, a red target and the page; HEADLESS: both experiments, then exit'
	@echo '          [ROBOT=aibo|bittle|create2|mixed|rosbridge|sim]   what the three are; mixed: an AIBO, a Create 2, a Bittle'
	@echo '          [LOSE=node|link]                             what experiment 2 takes: the node, or the link to its robot'
	@echo '          [NAT=1]   across an internet of network namespaces: two robots behind routers of their own'
	@echo '          [WEB_HOST=0.0.0.0] [WEB_PORT=8080] [TLS=1]   whom the page is open to, and where; TLS: on this machine alone, too'
	@echo 'make test                             every test'
	@echo 'make trials [N=20] [SEED=1] [REAL=3]  both experiments N times in memory, and REAL times as processes'
	@echo 'make check                            format, lint, types, and the rules of the house'
	@echo 'make format                           write the format that "make check" asks for'
	@echo 'make cov                              the tests with coverage of lines and branches'
	@echo 'make schedules [N=2000] [SEED=1]      so many random schedules of faults, and the invariants of the library'
	@echo '          [LOG=docs/scale/schedules.jsonl]   log them, and leave out those that are logged'
	@echo '          [SCHEDULER=tcp://HOST:8786]        on the machines that wait there: dask scheduler, dask worker'
	@echo 'make stops [N=10000] [SEED=1]         so many random sequences of stops, releases, faults and hostile messages'
	@echo 'make bugs                             each of the seeded bugs in turn, until a schedule shows it'
	@echo 'make slice                            a thousand simulated nodes, a tenth of which are killed'
	@echo 'make live                             only the tests with real sockets and processes'
	@echo 'make live-nat [N=5]                   real nodes behind every pair of routers, in network namespaces: who reaches whom'
	@echo 'make contract                         the API against its own document: every route, asked in every way'
	@echo 'make browser                          only the tests of the page in Chromium'
	@echo 'make bench-demo                       what the demonstration costs: memory, datagrams, seconds'
	@echo 'make bench-page                       the page under load: streams, cameras, dribblers, requests, a slow line'
	@echo 'make bench-dht [NODES=8,32] [SECONDS=5] [PEERS=..]   the peer-to-peer library beside others of its kind'
	@echo 'make bench-takeover [N=200] [REAL=20]   seconds to take over, for each way to lose who acts'
	@echo 'make bench-consensus [QUICK=1]        every strategy over the same missions: cost, messages, time to agree'
	@echo 'make bench-flood                      20,000 forged datagrams a second at a node, while two call each other'
	@echo 'make bench-robots                     three AIBOs driven at once: frames, pictures, command to wheel, memory'
	@echo 'make bench-crowd [QUICK=1]            a yard for many: 3 to 10,000 robots, a hundred agents attached, a task; QUICK: no agents'
	@echo 'make bench-scale [NODES=3,10,30]      teams of 3 to 10,000 nodes, simulated: hops, bytes, memory, seconds; resumable'
	@echo 'make docs                             the documentation as a site with search and API reference, in build/docs'
	@echo 'make dist                             sdist and wheel, installed into a fresh environment and asked for help'
	@echo 'make clean                            remove what the above left behind, the environment included'

demo: $(RUNTIME)
	@exec $(PY) -m $(if $(filter-out 0,$(NAT)),sim.namespaces.demo,sim.demo) --seed $(SEED) --robot $(ROBOT) --lose $(LOSE) $(if $(filter-out 0,$(HEADLESS)),--headless) $(if $(filter-out 0,$(TLS)),--tls) \
	    --web-host $(WEB_HOST) $(if $(WEB_PORT),--web-port $(WEB_PORT))

# The tests with sockets, processes and browsers mostly wait, and a delay can make them fail.  The others compute meanwhile,
# at a lower priority, and print their results at the end.
test: $(DEV)
	@mkdir -p build; nice -n 10 $(PY) -m twisted.trial -j$(JOBS) $(UNIT) >build/unit.log 2>&1 & unit=$$!; \
	trap 'trap - TERM; kill 0' INT TERM; \
	$(PY) -m twisted.trial -j$(JOBS) tests.live; live=$$?; \
	wait $$unit; unit=$$?; cat build/unit.log; exit $$((live | unit))

trials: $(RUNTIME)
	$(VENV)/bin/swarm trials --count $(N) --seed $(SEED) --real $(REAL)

check: $(DEV)
	$(PY) -m ruff format --check .
	$(PY) -m ruff check .
	$(PY) -m mypy
	$(PY) -m twisted.trial --reporter=summary tests.test_house tests.test_prose

format: $(DEV)
	$(PY) -m ruff check --fix --select I .
	$(PY) -m ruff format .

cov: $(DEV)
	$(PY) -m coverage run -m twisted.trial tests
	$(PY) -m coverage report

schedules: $(DEV)
	$(PY) -m tests.invariants --schedules $(if $(filter file,$(origin N)),2000,$(N)) --seed $(SEED) --jobs $(JOBS) \
	    $(if $(LOG),--log $(LOG) --resume) $(if $(SCHEDULER),--scheduler $(SCHEDULER))

stops: $(DEV)
	$(PY) -m tests.invariants.stops --sequences $(if $(filter file,$(origin N)),10000,$(N)) --seed $(SEED)

# A thousand nodes, a tenth of which are killed.
slice: $(RUNTIME)
	$(VENV)/bin/sim run --scenario slice --seed $(SEED)

bugs: $(DEV)
	$(PY) -m tests.invariants --bugs --jobs $(JOBS) $(if $(SCHEDULER),--scheduler $(SCHEDULER))

live: $(DEV)
	$(PY) -m twisted.trial tests.live

# Wants root, or namespaces for users, and says so.
live-nat: $(RUNTIME)
	$(PY) -m benchmarks.nat --count $(if $(filter file,$(origin N)),5,$(N)) $(if $(filter-out 0,$(DOCS)),--docs)

contract: $(CONTRACT)/.stamp
	$(CONTRACT)/bin/python -m twisted.trial tests.live.test_contract

browser: $(BROWSER)
	$(PY) -m twisted.trial tests.live.test_page

bench-demo: $(RUNTIME)
	$(PY) -m benchmarks.demo --seed $(SEED)

bench-page: $(RUNTIME)
	$(PY) -m benchmarks.page

# In a network of its own, where that is allowed, the counted datagrams are those of the nodes alone.
bench-dht: $(BENCH)
	@mkdir -p build
	@set -- $(PY) -m benchmarks.dht --nodes $(NODES) --seconds $(SECONDS) $(if $(PEERS),--peers $(PEERS)) \
	    --out build/bench-dht.json --plot build/bench-dht.svg; \
	if unshare -rn ip link set lo up 2>/dev/null; \
	then exec unshare -rn sh -c 'ip link set lo up; exec "$$@"' sh "$$@"; else exec "$$@"; fi

bench-takeover: $(RUNTIME)
	$(PY) -m benchmarks.takeover --count $(if $(filter file,$(origin N)),200,$(N)) --real $(REAL) --seed $(SEED)

bench-consensus: $(BENCH)
	@mkdir -p build
	$(PY) -m benchmarks.consensus $(if $(filter-out 0,$(QUICK)),--quick) \
	    --out build/bench-consensus.json --plot build/bench-consensus.svg

bench-robots: $(RUNTIME)
	$(PY) -m benchmarks.robots

bench-crowd: $(RUNTIME)
	@mkdir -p build
	$(PY) -m benchmarks.crowd $(if $(filter-out 0,$(QUICK)),--agents 0 --tasks 0) --out build/bench-crowd.json

# Sizes that stand in docs/scale/scale.json already are not measured again.
bench-scale: $(RUNTIME)
	$(VENV)/bin/sim scale $(if $(filter file,$(origin NODES)),,--nodes $(NODES)) --seed $(SEED) --out docs/scale

bench-flood: $(RUNTIME)
	@mkdir -p build
	$(PY) -m benchmarks.flood --out build/bench-flood.json

# Builds without the network once set up.  A warning is an error.
docs: $(DOCUMENTS)
	$(PY) -m sphinx -W --keep-going -q -b html docs build/docs
	@echo 'open build/docs/index.html'

dist: $(DEV)
	rm -rf build dist
	$(PIP) 'build>=1.2,<2'
	$(PY) -m build --quiet --outdir dist .
	rm -rf build/fresh && $(PYTHON) -m venv build/fresh
	build/fresh/bin/python -m pip --disable-pip-version-check --quiet install --only-binary :all: dist/*.whl
	cd build && fresh/bin/twistd --help | grep swarm-node && fresh/bin/swarm --help >/dev/null
	@ls -l dist

clean:
	rm -rf $(VENV) build dist run _trial_temp* *.egg-info .coverage .mypy_cache .ruff_cache .hypothesis
	find . -name __pycache__ -prune -exec rm -rf {} +
	rm -f twisted/plugins/dropin.cache twistd.pid twistd.log*

$(PY):
	@command -v $(PYTHON) >/dev/null || { \
	    echo "swarm-node: $(PYTHON) is not here; install it (apt install python3 python3-venv) or say make PYTHON=/path/to/python3" >&2; exit 1; }
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11))' || { \
	    echo "swarm-node: needs Python 3.11 or later, $(PYTHON) is `$(PYTHON) -V 2>&1`; say make PYTHON=python3.11" >&2; exit 1; }
	@$(PYTHON) -c 'import ensurepip, venv' 2>/dev/null || { \
	    echo "swarm-node: $(PYTHON) cannot make virtual environments; install them: apt install python3-venv" >&2; exit 1; }
	@echo "making $(VENV) with `$(PYTHON) -V`; needs the network this once"
	@$(PYTHON) -m venv $(VENV)

$(RUNTIME): setup.cfg pyproject.toml | $(PY)
	@$(PIP) 'setuptools>=77'
	@$(INSTALL) '.[all]'
	@touch $@

$(DEV): setup.cfg pyproject.toml | $(PY)
	@$(PIP) 'setuptools>=77'
	@$(INSTALL) '.[all,dev]'
	@touch $@ $(RUNTIME)

$(BROWSER): setup.cfg pyproject.toml | $(PY)
	@$(PIP) 'setuptools>=77'
	@$(INSTALL) '.[all,dev,browser]'
	@touch $@ $(DEV) $(RUNTIME)

$(BENCH): setup.cfg pyproject.toml | $(PY)
	@$(PIP) 'setuptools>=77'
	@$(INSTALL) '.[all,bench]'
	@touch $@ $(RUNTIME)

$(DOCUMENTS): setup.cfg pyproject.toml | $(PY)
	@$(PIP) 'setuptools>=77'
	@$(INSTALL) '.[all,docs]'
	@touch $@ $(RUNTIME)

# Its tool brings a test runner of its own along, so it has an environment of its own.
$(CONTRACT)/.stamp: setup.cfg pyproject.toml | $(PY)
	@$(PYTHON) -m venv $(CONTRACT)
	@$(subst $(PY),$(CONTRACT)/bin/python,$(PIP)) 'setuptools>=77'
	@$(subst $(PY),$(CONTRACT)/bin/python,$(INSTALL)) '.[all,contract]'
	@touch $@
