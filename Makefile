# Two commands from nothing: `make demo` and `make test`. Both install what they need into .venv.

PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
PACKAGES := graspdb_density graspdb_geometry graspdb_estimators graspdb_robots graspdb_service graspdb_simworker graspdb graspdb_viewer
# How many processes run tests; the suite is made for two cores.
JOBS ?= 2
KEEP ?=
VIEW ?=
# Where Python keeps nothing compiled, every process of the tests compiles everything anew, assertions too.
unexport PYTHONDONTWRITEBYTECODE

.DEFAULT_GOAL := help
.PHONY: help install docs demo test chromium test-core test-long test-compose check format bench load openapi requirements recompile clean

help:  ## What can be made
	@grep -hE '^[a-z-]+:.*##' $(MAKEFILE_LIST) | sed -E 's/:.*## /\t/' | expand -t 16

install: $(VENV)/installed  ## Install everything, pinned and hashed, into .venv

$(VENV)/installed: requirements.txt pyproject.toml
	@PYTHON="$(PYTHON)" VENV="$(VENV)" sh .ci/install
	@touch $@

demo: install  ## Real physics on the mug: from nothing to a best grasp (KEEP=1 leaves the service running, VIEW=1 shows it)
	$(BIN)/graspdb demo $(if $(KEEP),--keep) $(if $(VIEW),--view)

test: chromium check  ## Every check and every test, on SQLite and on a real PostgreSQL
	@sh .ci/faketime
	-@sh .ci/nginx
	$(BIN)/python -m pytest -n $(JOBS) --dist worksteal -m "not long" --ignore tests/architecture

chromium:
	@sh .ci/chromium

test-core: install  ## The tests without a browser
	@sh .ci/faketime
	$(BIN)/python -m pytest -n $(JOBS) --dist worksteal -m "not long and not browser"

test-long: chromium install  ## Also what takes many minutes
	@sh .ci/faketime
	@sh .ci/nginx
	$(BIN)/python -m pytest -n $(JOBS) --dist worksteal

test-compose: install  ## compose.yaml for real, without a Docker engine: as root on Debian, with buildah and podman
	$(BIN)/python tests/compose

check: install  ## Format, lint, types, import rules, the rules of the house
	$(BIN)/ruff format --check .
	$(BIN)/ruff check .
	$(BIN)/mypy $(addprefix -p ,$(PACKAGES))
	$(BIN)/lint-imports
	$(BIN)/python -m pytest -q tests/architecture

format: install  ## Mend what the formatter and the linter can
	$(BIN)/ruff format .
	$(BIN)/ruff check --fix .

bench: install  ## Measure speed: a table with medians and ratios taken in one run
	$(BIN)/python tests/benchmarks

load: install  ## 200 clients and 50 workers at half of what the machine carries (SECONDS=600, on either database)
	@sh .ci/nginx
	$(BIN)/python tests/load --seconds $(or $(SECONDS),600)

docs: install  ## The site of docs/, into site/index.html, readable offline; every link is checked
	$(BIN)/python docs/make_site.py

openapi: install  ## Write docs/openapi.json and docs/scopes.md anew
	$(BIN)/graspdb-server openapi > docs/openapi.json
	$(BIN)/graspdb-server scopes > docs/scopes.md

PIP_COMPILE = $(BIN)/python -m piptools compile --quiet --generate-hashes --allow-unsafe --strip-extras \
  --no-emit-index-url --no-emit-find-links --no-emit-trusted-host

requirements:  ## Pin what pyproject.toml allows, for development and for the images (UPGRADE=--upgrade: the newest)
	$(PIP_COMPILE) $(UPGRADE) --all-extras --output-file requirements.txt pyproject.toml
	$(PIP_COMPILE) -c requirements.txt --extra service --extra postgres --extra plot --extra pictures --extra arrow --extra robot --build-deps-for wheel \
	  --output-file service/requirements.txt pyproject.toml
	$(PIP_COMPILE) -c requirements.txt --extra sim --extra mujoco --extra dask --build-deps-for wheel \
	  --output-file simworker/requirements.txt pyproject.toml
	$(PIP_COMPILE) -c requirements.txt --extra view --build-deps-for wheel \
	  --output-file clients/requirements.txt pyproject.toml

recompile:  ## Forget what Numba keeps compiled: it does not see where a function that others call has changed
	find service simworker -name '*.nb[ic]' -delete

clean:  ## Remove the environment and what tools left behind
	rm -rf $(VENV) .mypy_cache .ruff_cache .pytest_cache .hypothesis .import_linter_cache demo dist
