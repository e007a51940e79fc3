# Everything a newcomer needs. Each target sets up what it needs first: a virtual environment, and libLLVM.
PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
STAMP := $(VENV)/.installed
OLDEST := .venv-oldest
export PIP_DISABLE_PIP_VERSION_CHECK := 1

.PHONY: help demo test test-oldest slow lint bench docs quality clean

help:
	@echo "make demo         simplify the embedded scene to 2 % of its triangles (out/demo)"
	@echo "make test         linters, type checker, tests"
	@echo "make test-oldest  the tests with the oldest dependencies allowed (Python 3.10 or 3.11)"
	@echo "make slow         the tests that take minutes each"
	@echo "make lint         linters and type checker alone"
	@echo "make bench        time a step and its stages (docs/performance.md)"
	@echo "make quality      compare with other tools (docs/quality.md; needs the folder ../shared, see docs/reproduce.md)"
	@echo "make docs         render docs/ to out/docs"
	@echo "make clean        remove .venv, out and what building left"

$(STAMP): pyproject.toml scripts/setup.sh
	PYTHON=$(PYTHON) bash scripts/setup.sh $(VENV)
	@touch $@

demo: $(STAMP)
	@mkdir -p out/demo
	test -f out/demo/relic.glb || $(BIN)/python -m scenes.build relic out/demo/relic.glb
	$(BIN)/appearance-opt simplify out/demo/relic.glb --ratio 0.02 --out out/demo/relic_2pct.glb

lint: $(STAMP)
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy

test: lint
	$(BIN)/python -m pytest

# in an environment of its own, made anew when the versions change
$(OLDEST)/.installed: pyproject.toml scripts/setup.sh constraints-oldest.txt
	rm -rf $(OLDEST)
	PIP_CONSTRAINT=$(CURDIR)/constraints-oldest.txt PYTHON=$(PYTHON) bash scripts/setup.sh $(OLDEST)
	@touch $@

test-oldest: $(OLDEST)/.installed
	$(OLDEST)/bin/python -m pytest

slow: $(STAMP)
	$(BIN)/python -m pytest -m slow

bench: $(STAMP)
	$(BIN)/python -m experiments.bench

quality: $(STAMP)
	$(BIN)/python -m experiments.quality

docs: $(STAMP)
	$(BIN)/python scripts/build_docs.py out/docs

clean:
	rm -rf $(VENV) $(OLDEST) out build *.egg-info
