# `make demo` and `make test` are the commands of the README; each sets up its own environment.
PYTHON ?= $(shell command -v python3.11 || command -v python3)
VENV := .venv
CONSTRAINTS := constraints.txt
BIN := $(VENV)/bin
RUN := $(VENV)/.installed
DEV := $(VENV)/.installed-dev
DOCS := $(VENV)/.installed-docs

.PHONY: demo test test-fast test-full test-oldest test-newest coverage browser bench bench-peers blind chaos lint lines docs openapi settings pins package container release clean
.DELETE_ON_ERROR:

$(RUN): pyproject.toml $(CONSTRAINTS)
	$(PYTHON) -c 'import sys; sys.exit(0 if sys.version_info >= (3, 11) else "heliopsf needs Python 3.11 or newer, found " + sys.version.split()[0] + ": make PYTHON=/path/to/python3.11")'
	test -x $(BIN)/python || $(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --quiet --disable-pip-version-check -c $(CONSTRAINTS) -e '.[service]'
	touch $@

$(DEV): $(RUN)
	$(BIN)/python -m pip install --quiet --disable-pip-version-check -c $(CONSTRAINTS) -e '.[dev]'
	touch $@

$(DOCS): $(RUN)
	$(BIN)/python -m pip install --quiet --disable-pip-version-check -c $(CONSTRAINTS) -e '.[docs]'
	touch $@

demo: $(RUN)
	$(BIN)/heliopsf demo $(if $(IMAGE),--image "$(IMAGE)")

# Without the rules of the house, which make lint checks.
test: $(DEV) $(if $(CI),browser)
	$(BIN)/python -m pytest -m "not slow" -n 4 --dist loadfile --ignore tests/house tests

# The tests of one room in one process, for example: make test-fast FILES=tests/psfcore/gap/library
test-fast: $(DEV)
	$(if $(FILES),,$(error expected the folder or the files of a room: make test-fast FILES=tests/psfcore/gap/library))
	$(BIN)/python -m pytest -m "not slow" -x -q $(FILES)

# Chromium for the tests of the pages, on a machine of CI where apt-get may install it. Without Chromium these tests are skipped.
browser:
	@command -v chromium chromium-browser google-chrome >/dev/null || { apt-get update && apt-get install --yes --no-install-recommends chromium; } >/dev/null 2>&1 || echo "Chromium could not be installed: the tests of the pages are skipped"

test-full: $(DEV)
	$(BIN)/python -m pytest -n 2 --dist loadfile tests

# The fast tests with the oldest dependencies that pyproject.toml allows, and with the newest that there are, each in its own environment.
test-oldest:
	$(MAKE) test VENV=.venv-oldest CONSTRAINTS=constraints-oldest.txt

test-newest:
	$(MAKE) test VENV=.venv-newest CONSTRAINTS=/dev/null

# The share of branches that the fast tests run, by room, into the table of CONTRIBUTING.md.
coverage: $(DEV)
	$(BIN)/python -m coverage erase
	$(BIN)/python -m pytest -m "not slow" -n 4 --dist loadfile --ignore tests/house --cov --cov-report= tests
	$(BIN)/python -m tests.house.coverage CONTRIBUTING.md

# Each figure beside its goal and the stored one; needs 20 minutes and no other program on the machine.
bench: $(DEV)
	$(BIN)/python -m benchmarks

# Other packages, each in its own environment, timed in turn with heliopsf on the same data: the table of docs/speed.md, and of
# docs/aia.md for a 4096 px image. The last command writes the PSFs of AIA beside those of aiapy into docs/aia.md, if there is an
# image (level 1 at 171 angstrom).
AIA_IMAGE ?= $(or $(HELIOPSF_SHARED),../shared)/data/real/aia/aia_171_cutout_20130310.fits
bench-peers: $(DEV)
	$(BIN)/python -m benchmarks.race.peers --page docs/speed.md
	$(BIN)/python -m benchmarks.race.peers --whole --rounds 3 --page docs/aia.md
	$(BIN)/python -m benchmarks.race.aia "$(AIA_IMAGE)" docs/aia.md

# Runs jobs while workers, Redis, PostgreSQL and the service are killed at random. Needs Redis and PostgreSQL.
chaos: $(DEV)
	$(BIN)/python -m studies.chaos
	$(BIN)/python -m studies.chaos --seed 2 --redis-keeps

# Measures the gap diagnosis on cases whose effect is withheld. Takes hours; resumes where it was stopped.
blind: $(RUN)
	OMP_NUM_THREADS=1 $(BIN)/heliopsf gap blind --cases 204 --size 256 --images 18 -o heliopsf-blind
	OMP_NUM_THREADS=1 $(BIN)/heliopsf gap blind --cases 24 --seed 2 --size 512 --images 30 -o heliopsf-blind-512

lint: $(DEV)
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy
	$(BIN)/python -m pytest -q tests/house

# The lines, files and tests of each room, beside the lines that it is meant to have.
lines: $(DEV)
	$(BIN)/python -m tests.house.lines

# The documentation site, docs/_build/html/index.html. Its tutorials run; neither the build nor the pages need a network.
docs: $(DOCS)
	$(BIN)/python -m sphinx -W --keep-going -E -b html docs docs/_build/html

# The table of settings, made from the settings class.
settings: $(DEV)
	$(BIN)/python -m workers.settings_table docs/settings.md

openapi: $(DEV)
	$(BIN)/python -m service.openapi openapi/openapi.json

# The oldest versions of all packages that pyproject.toml allows.
constraints-oldest.txt: pyproject.toml
	test -x .venv-pins/bin/uv || { $(PYTHON) -m venv .venv-pins && .venv-pins/bin/python -m pip install --quiet --disable-pip-version-check uv; }
	.venv-pins/bin/uv pip compile --quiet --python-version 3.11 --resolution lowest-direct --no-header --no-annotate --extra dev -o $@ pyproject.toml

# Wheel and source archive in dist/, checked, installed into an empty environment, and the demo run from there.
package: $(DEV)
	rm -rf dist
	$(BIN)/python -m build --no-isolation --outdir dist .
	$(BIN)/python -m twine check --strict dist/*
	rm -rf .venv-wheel && $(PYTHON) -m venv .venv-wheel
	.venv-wheel/bin/python -m pip install --quiet --disable-pip-version-check -c constraints.txt "$$(ls dist/*.whl)[service]"
	cd dist && ../.venv-wheel/bin/heliopsf demo -o demo
	rm -rf dist/demo .venv-wheel

# The image, and its demo.
container:
	docker build --tag heliopsf .
	docker run --rm --volume /data heliopsf heliopsf demo -o /data/demo

# Cuts a release, for example: make release VERSION=0.2.0
release:
	$(if $(VERSION),,$(error expected the version: make release VERSION=0.2.0))
	bash deploy/release.sh "$(VERSION)" "$(PYTHON)"

# The hashes of the pinned packages and of the build tool, for the image. The file names no index.
pins: constraints.txt pyproject.toml pins/build.in
	test -x .venv-pins/bin/uv || { $(PYTHON) -m venv .venv-pins && .venv-pins/bin/python -m pip install --quiet --disable-pip-version-check uv; }
	.venv-pins/bin/uv pip compile --quiet --universal --python-version 3.11 --generate-hashes --no-header --no-annotate -c constraints.txt --extra s3 --extra traces -o pins/service.txt pyproject.toml pins/build.in

clean:
	rm -rf $(VENV) .venv-oldest .venv-newest .venv-wheel .venv-peers .venv-pins dist .mypy_cache .ruff_cache .hypothesis docs/_build docs/_gallery
