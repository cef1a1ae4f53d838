# `make demo` and `make test` set up everything by themselves in .venv, from the versions pinned in requirements.lock.
SHELL := /bin/sh
PYTHON := .venv/bin/python
STAMP := .venv/.installed
DOCS_STAMP := .venv/.installed-docs
ONE_THREAD := OMP_NUM_THREADS=1 OPENBLAS_NUM_THREADS=1 MKL_NUM_THREADS=1
WORKERS ?= auto
# some environments forbid compiled modules; the workers and commands of a test run would compile all sources again
export PYTHONDONTWRITEBYTECODE :=

.PHONY: demo test lint slow docs clean
.DELETE_ON_ERROR:

demo: $(STAMP)
	.venv/bin/pilfr demo

test: lint
	$(ONE_THREAD) $(PYTHON) -m pytest -q -n $(WORKERS) --dist worksteal

lint: $(STAMP)
	$(PYTHON) -m ruff check .
	$(PYTHON) -m ruff format --check .
	$(PYTHON) -m mypy

slow: $(STAMP) $(DOCS_STAMP)
	$(ONE_THREAD) $(PYTHON) -m pytest -q -n $(WORKERS) --dist worksteal -m slow

docs: $(DOCS_STAMP)
	$(ONE_THREAD) $(PYTHON) -m sphinx -q -W --keep-going -b html docs build/docs
	@echo "open build/docs/index.html"

clean:
	rm -rf .venv build dist docs/laws docs/pictures docs/reference docs/gallery *.egg-info .pytest_cache .mypy_cache .ruff_cache .hypothesis
	find . -name __pycache__ -type d -prune -exec rm -rf {} +

$(STAMP): pyproject.toml requirements.lock
	@set -e; fit='import sys; sys.exit(sys.version_info < (3, 11))'; \
	if ! .venv/bin/python -c "$$fit" 2>/dev/null; then \
	    found=; \
	    for python in python3 python3.13 python3.12 python3.11; do \
	        if $$python -c "$$fit" 2>/dev/null; then found=$$python; break; fi; \
	    done; \
	    if [ -z "$$found" ]; then \
	        echo "Python 3.11 or newer is needed and no such python3 was found: install one, then run make again." >&2; exit 1; \
	    fi; \
	    if ! $$found -m venv --clear .venv; then \
	        echo "$$found could not make a virtual environment: install its venv module (on Debian: python3-venv), then run make again." >&2; exit 1; \
	    fi; \
	fi
	@echo "installing into .venv (a few minutes the first time)"
	$(PYTHON) -m pip install --quiet --disable-pip-version-check -r requirements.lock
	$(PYTHON) -m pip install --quiet --disable-pip-version-check --no-deps --no-build-isolation -e .
	@touch $@

$(DOCS_STAMP): $(STAMP) requirements-docs.lock
	@echo "installing what builds the documentation (half a minute)"
	$(PYTHON) -m pip install --quiet --disable-pip-version-check -r requirements.lock -r requirements-docs.lock
	@touch $@
