# One environment, .venv, for everything: made when it is missing, renewed when pyproject.toml or constraints.txt
# change or the folder has moved. Every target works from any state, and twice in a row.

SHELL := bash
.SHELLFLAGS := -euo pipefail -c
.ONESHELL:
.DEFAULT_GOAL := help
.PHONY: help env demo test test-all bench check schemas docs clean

PYTHON := .venv/bin/python
IS_311 := -c 'import sys; sys.exit(sys.version_info[:2] != (3, 11))'
RECIPE ?= recipes/quickstart.yaml

help:
	@echo 'make demo      from a recipe to shards, two trained networks and a physics report'
	echo 'make test      lint, types and the test suite'
	echo 'make test-all  the same with the slow tests: whole counts, real training, what reads exports'
	echo 'make bench     speed and memory on this machine'
	echo 'make check     lint and types'
	echo 'make schemas   schemas/*.json and the generated pages of docs/'
	echo 'make clean     removes the environment and the caches; data/ and runs/ stay'

# The stamp names what was installed and where, so that no touched file, copied folder or broken install misleads it.
env:
	@wanted="$$PWD $$(cat pyproject.toml constraints.txt | sha256sum)"
	if $(PYTHON) $(IS_311) 2>/dev/null && [[ "$$(cat .venv/.installed 2>/dev/null)" == "$$wanted" ]]; then exit 0; fi
	for candidate in python3.11 python3 python; do
		if "$$candidate" $(IS_311) 2>/dev/null; then found="$$candidate"; break; fi
	done
	if [[ -z "$${found:-}" ]]; then
		echo 'Python 3.11: not found as python3.11, python3 or python; PyBullet has no wheel for later ones; install it and run make again' >&2
		exit 6
	fi
	moved=0; [[ "$$(cat .venv/.installed 2>/dev/null)" == "$$PWD "* ]] || moved=1
	if (( moved )) || ! $(PYTHON) $(IS_311) 2>/dev/null; then "$$found" -m venv --clear .venv; fi
	echo 'installing into .venv: two minutes or so, the first time' >&2
	$(PYTHON) -m pip install -qq -c constraints.txt -e '.[all,dev]'
	echo 'compiling the kernels' >&2
	made=$$(mktemp -d)
	$(PYTHON) -m dapdata generate recipes/can_cabinet.yaml --demos 1 --out "$$made/dataset" > /dev/null
	$(PYTHON) -m dapdata label "$$made/dataset" > /dev/null
	rm -r "$$made"
	echo "$$wanted" > .venv/.installed

demo: env
	@$(PYTHON) -m dapdata run $(RECIPE)

test: check
	@$(PYTHON) -m pytest -n 2 -m 'not slow'

test-all: check docs
	@$(PYTHON) -m pip install -qq -c constraints.txt 'dapdata[interop]' # what reads exports; dapdata itself is there already
	$(PYTHON) -m pytest -n 2

bench: env
	@$(PYTHON) -m dapdata bench

check: env
	@$(PYTHON) -m ruff format --check .
	$(PYTHON) -m ruff check .
	$(PYTHON) -m mypy

schemas: env
	@$(PYTHON) docs/make.py

docs: env
	@$(PYTHON) -c 'import material' 2>/dev/null || $(PYTHON) -m pip install -qq -c constraints.txt -e '.[docs]'
	$(PYTHON) docs/build_site.py

clean:
	@rm -rf .venv build dist .pytest_cache .mypy_cache .ruff_cache .hypothesis
	find . -name __pycache__ -type d -not -path './.venv/*' -prune -exec rm -rf {} +
