# make demo | make test: each does all set-up by itself on a machine that has make and a Python (find-python says which).
PYTHON ?=
UV := .venv/bin/uv
READY := .venv/.ready
# a module stays in one process, so that its diagnoses are made once
PARALLEL_TESTS := --numprocesses=2 --dist=loadscope
# each process has emulated cells on addresses of its own; a third process takes the time that the rest beside them needs
WIRES := --numprocesses=2 --dist=worksteal
# what has an emulated cell goes before the rest, and before other work of a busy machine, as the unit lets the daemon; where the user may
# not ask for that, the rest gives way
URGENT := $(shell nice -n -10 true 2>&1 | grep -q . || echo nice -n -10)
unexport PYTHONDONTWRITEBYTECODE # with it every process that is started compiles numpy and scipy anew: seconds each, and tests start hundreds

.PHONY: setup demo quick test test-waiting test-wires test-rest test-service test-browser test-deb coverage lint bench bench-long minutes endurance faults arming signals aborts fuzz presses laws soak slopes cold deb docs mutation audit samples clean

setup: $(READY)

$(READY): pyproject.toml uv.lock
	@python=$$(./find-python $(PYTHON)) && \
	{ [ "$$(.venv/bin/python -V 2>&1)" = "$$("$$python" -V)" ] || rm -rf .venv; } && "$$python" -m venv .venv
	.venv/bin/python -m pip install --quiet --disable-pip-version-check 'uv>=0.5'
	UV_SYSTEM_CERTS=1 UV_NATIVE_TLS=1 VIRTUAL_ENV=$(CURDIR)/.venv $(UV) sync --frozen --inexact --active --no-python-downloads --quiet
	@touch $(READY)

demo: setup
	.venv/bin/palpd demo

lint: setup
	.venv/bin/ruff check .
	.venv/bin/ruff format --check .
	.venv/bin/mypy
	.venv/bin/lint-imports

# while you work: lint, and what needs neither another process nor a whole diagnosis
NOT_QUICK := browser service blind cli history study streams arena/test_tools.py \
	$(addprefix gap/test_,adoption.py commands.py diagnosis.py fleet.py law_experiment.py my_simulator_page.py odd_recordings.py own_mujoco_page.py \
	report.py rigs.py sensitivity.py user_simulator.py) \
	$(addprefix daemon/test_,demo.py doctor.py job_worker.py run_reports.py) \
	$(addprefix interchange/test_,export_page.py rosbag.py simulators.py) recording/test_flipped_bits.py \
	$(addprefix web/test_,children.py connections.py history_pages.py) \
	$(addprefix test_,api.py find_python.py notebooks.py pages.py readme.py reference.py site.py wheel.py)
quick: lint
	.venv/bin/pytest -m "not hil" $(PARALLEL_TESTS) $(addprefix --ignore=tests/,$(NOT_QUICK))

# what runs over emulated wires, a browser before them among it, or boots a service waits most of its time, so the rest goes beside it and
# gives way to it; then what needs the machine to itself: the long measurements in short
test: lint
	$(MAKE) --jobs=3 --output-sync test-waiting test-rest test-service
	$(MAKE) coverage samples

test-waiting:
	$(MAKE) test-wires
	$(MAKE) test-browser

test-wires: setup
	$(URGENT) .venv/bin/pytest -m hil --ignore=tests/browser $(WIRES)

test-rest: setup
	$(if $(URGENT),,nice) .venv/bin/pytest -m "not hil" --ignore=tests/browser $(PARALLEL_TESTS)

test-browser: setup
	$(URGENT) .venv/bin/pytest tests/browser

# every branch of the guard is tested, and by its own tests alone
coverage: setup
	COVERAGE_FILE=$(shell mktemp -u) .venv/bin/pytest tests/control/test_safety.py --cov=palpd.control.safety --cov-branch --cov-fail-under=100 --cov-report=term-missing

# ten minutes; writes docs/benchmarks.md. bench-long: three quarters of an hour, without what has a target of its own
bench: setup
	.venv/bin/python -m benchmarks.page

bench-long: setup
	.venv/bin/python -m benchmarks.page --long

# ten minutes each at 125, 500 and 1000 Hz
minutes: setup
	.venv/bin/python -m benchmarks.page --only minutes

# ten runs of ten minutes by the whole daemon at 500 Hz, PARALLEL at a time; KEPT keeps them, so that it may be interrupted
endurance: setup
	.venv/bin/python -m benchmarks.page --only endurance --more '--parallel $(PARALLEL) $(if $(KEPT),--kept $(KEPT))'

# every fault of docs/faults.md N times at random moments, in PARALLEL emulated cells: some 4 minutes for each N on a quiet machine, divided by
# PARALLEL. make faults N=100 PARALLEL=2 KEPT=faults.jsonl may be interrupted: given again it goes on
N ?= 3
PARALLEL ?= 2
faults: setup
	.venv/bin/python -m benchmarks.faults --repeats $(N) --parallel $(PARALLEL) $(if $(KEPT),--json $(KEPT))

# N runs for each way in which arming can fail
arming: setup
	.venv/bin/python -m benchmarks.arming --samples $(N) $(if $(KEPT),--json $(KEPT))

# N signals at random moments of every command, and N aborts under attack; KEPT as above
signals: setup
	.venv/bin/python -m benchmarks.signals --samples $(N) --parallel $(PARALLEL) $(if $(KEPT),--json $(KEPT))

aborts: setup
	.venv/bin/python -m benchmarks.abort --samples $(N) $(if $(KEPT),--json $(KEPT))

# LINES bad command lines: some 5 minutes for 1000 on a quiet machine; SEED draws others
LINES ?= 1000
SEED ?= 1
fuzz: setup
	.venv/bin/python -m benchmarks.fuzz_commands --lines $(LINES) --seed $(SEED)

# PRESSES presses with faults at random moments, without wires
PRESSES ?= 1000
presses: setup
	.venv/bin/python -m benchmarks.page --only presses --more '--presses $(PRESSES)'

# plants the laws of docs/examples/laws into the emulated cell and finds them; writes the table of docs/outside-the-list.md
laws: setup
	.venv/bin/python -m benchmarks.law_demos --docs docs

# two hours of presses, watched minute by minute
MINUTES ?= 120
soak: setup
	.venv/bin/python -m benchmarks.page --only soak --more '--minutes $(MINUTES)'

# moduli on both laws of a sensor with two slopes of Fz, over emulated wires, and what a diagnosis makes of the wrong setting
slopes: setup
	.venv/bin/python -m benchmarks.page --only slopes $(if $(KEPT),--more '--kept $(KEPT)')

# N runs from dropped caches (root), each of which must begin and end as any other
cold: setup
	.venv/bin/python -m benchmarks.page --only cold --more '--runs $(N)'

# a Debian package in dist/: some 3 minutes; needs debhelper and dh-virtualenv
deb: setup
	systemd/build-deb dist

# the docs site in site/: reference pages from the code, then the pages, with every link checked
docs: setup
	.venv/bin/python docs/generate.py
	NO_MKDOCS_2_WARNING=1 .venv/bin/mkdocs build --strict --quiet -f docs/mkdocs.yml
	@echo 'open site/index.html'

# mutants of guard, tare and frame parser; SHARE of them
SHARE ?= 1
mutation: setup
	.venv/bin/python -m benchmarks.page --only mutation --more '--share $(SHARE)'

# known vulnerabilities in what uv.lock names; says so where no database can be reached
audit: setup
	.venv/bin/python -m benchmarks.audit

# the long ones in short: a minute
samples: setup
	-$(MAKE) audit # what becomes known of a dependency today is news, and no fault of this change
	.venv/bin/python -m benchmarks.presses --presses 20
	.venv/bin/python -m benchmarks.fuzz_commands --lines 60 --real 2 --seconds 12
	.venv/bin/python -m benchmarks.mutation --only safety --share 0.05
	if .venv/bin/python -c 'from hw.rtde import require_library; require_library()' 2> /dev/null; \
	then .venv/bin/python -m benchmarks.reaction --model ur5 --pushes 10 --each 1 --speed 0.01 --stiffness 5000; \
	else echo 'no reaction is measured: ur-rtde has no wheel here'; fi

# boots systemd in a container: needs root and systemd-nspawn, and says so where it is skipped
test-service: setup
	$(URGENT) timeout --kill-after=30 600 .venv/bin/pytest -rs -s tests/service/nspawn.py

# builds the Debian package, installs it in a container, uses it and purges it
test-deb: deb
	timeout --kill-after=30 900 .venv/bin/pytest -rs -s tests/service/package.py

clean:
	rm -rf .venv .mypy_cache .ruff_cache .import_linter_cache
