# make demo | make test: each does all set-up by itself on a machine that has make and python3 (3.11+).
PYTHON ?= python3
UV := .venv/bin/uv
READY := .venv/.ready

.PHONY: setup demo test test-service lint bench faults soak clean

setup: $(READY)

$(READY): pyproject.toml uv.lock
	@$(PYTHON) -c 'import sys; sys.exit(0 if (3, 11) <= sys.version_info[:2] < (3, 14) else "palpd needs Python 3.11 to 3.13, found " + sys.version.split()[0] + "; try make PYTHON=python3.12")'
	$(PYTHON) -m venv .venv
	.venv/bin/python -m pip install --quiet 'uv>=0.5'
	UV_SYSTEM_CERTS=1 UV_NATIVE_TLS=1 VIRTUAL_ENV=$(CURDIR)/.venv $(UV) sync --frozen --inexact --active --no-managed-python --quiet
	@touch $(READY)

demo: setup
	.venv/bin/palpd demo

lint: setup
	.venv/bin/ruff check .
	.venv/bin/mypy
	.venv/bin/lint-imports

test: lint
	.venv/bin/pytest

# ten minutes; writes docs/benchmarks.md
bench: setup
	.venv/bin/python benchmarks/page.py

# every fault of docs/faults.md N times at random moments, in PARALLEL emulated cells; some 5 minutes for each N and cell
N ?= 3
PARALLEL ?= 2
faults: setup
	.venv/bin/python benchmarks/faults.py --repeats $(N) --parallel $(PARALLEL) $(if $(KEPT),--json $(KEPT))

# two hours of presses, watched minute by minute
MINUTES ?= 120
soak: setup
	.venv/bin/python benchmarks/soak.py --minutes $(MINUTES)

# boots systemd in a container: needs root and systemd-nspawn, and says so where it is skipped
test-service: setup
	timeout --kill-after=30 600 .venv/bin/pytest -rs -s tests/service/nspawn.py

clean:
	rm -rf .venv .mypy_cache .ruff_cache .import_linter_cache
