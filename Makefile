# Two commands: `make reproduce` runs the whole chain, `make test` passes the tests.
# `make docs` writes what pages draw from code and measurements.
# They set up a virtual environment in .venv on first use and need no network after that.
# PYTHON: the first Python from 3.11 on that can make one; `make PYTHON=...` names another.
SUITABLE := import ensurepip, sys, venv; sys.exit(sys.version_info < (3, 11))
NAMES := python3.11 python3.12 python3.13 python3.14 python3 python
PYTHON ?= $(shell for name in $(NAMES); do \
	$$name -c '$(SUITABLE)' 2>/dev/null && echo $$name && break; done)
OUT ?= $(if $(QUICK),results-quick,results)
RUN := .venv/bin/python -m
QUICK ?=

.PHONY: reproduce test check lint bench docs clean
.DELETE_ON_ERROR:

reproduce: .venv/installed
	$(RUN) brokk_min reproduce --out "$(OUT)" $(if $(QUICK),--quick)

test: lint check

check: .venv/installed-dev
	$(RUN) coverage erase
	$(RUN) coverage run -m pytest --numprocesses 2 --dist loadfile --no-loadscope-reorder
	$(RUN) coverage combine --quiet
	$(RUN) coverage report
	$(RUN) coverage report --fail-under=100 \
		--include=brokk_min/hw.py,brokk_min/can/safety_gate.py,brokk_min/can/canopen.py

lint: .venv/installed-dev
	$(RUN) ruff check .
	$(RUN) ruff format --check .
	$(RUN) mypy

bench: .venv/installed-dev
	$(RUN) benchmarks.rollout

docs: .venv/installed-dev
	.venv/bin/python tests/paper/test_docs.py
	.venv/bin/python tests/paper/test_paper.py
	.venv/bin/python tests/paper/test_walkthrough.py
	.venv/bin/python docs/paper.py

.venv/bin/python:
	$(if $(PYTHON),,$(error PYTHON: expected Python 3.11 or newer with venv, found none of $(NAMES)))
	"$(PYTHON)" -m venv .venv

.venv/installed: pyproject.toml constraints.txt | .venv/bin/python
	$(RUN) pip install --quiet -c constraints.txt -e ".[train]"
	touch .venv/installed

.venv/installed-dev: pyproject.toml constraints.txt | .venv/bin/python
	$(RUN) pip install --quiet -c constraints.txt pip  # that of Python 3.11 knows no --group
	$(RUN) pip install --quiet -c constraints.txt -e ".[all]" --group dev
	touch .venv/installed .venv/installed-dev

clean:
	rm -rf .venv .coverage* results results-quick .mypy_cache .ruff_cache .pytest_cache .hypothesis
