# make demo and make test set up everything they need in .venv; the other targets are for people who work on the code.
PYTHON ?= python3
VENV ?= .venv
READY = $(VENV)/.ready

.PHONY: demo test trials docs wheel wheel-demo lint format lock clean deb image fuzz soak mutation silent sbom audit fleet measurement types

demo: $(READY)
	$(VENV)/bin/emb-daemon demo

# One process per core; further threads of linear algebra would only wait for a core. Byte code is written even if the shell
# forbids it: otherwise each of a hundred processes compiles the sources.
PYTEST = OPENBLAS_NUM_THREADS=1 PYTHONDONTWRITEBYTECODE= $(VENV)/bin/pytest -q -rs -n auto --maxprocesses 4 \
	--dist loadfile --no-loadscope-reorder
test: $(READY) lint
	$(PYTEST) -m "not trial"

# Long tests: all kernels compiled ahead, whole campaigns identified, whole drives diagnosed. make test has a short form of each.
trials: $(READY)
	$(PYTEST) -m trial

$(READY): requirements.lock pyproject.toml
	$(PYTHON) -m venv $(VENV)
	$(VENV)/bin/pip install --quiet --disable-pip-version-check --require-hashes -r requirements.lock
	$(VENV)/bin/pip install --quiet --disable-pip-version-check --no-deps --editable .
	touch $@

# Pages to read in site/index.html.
docs: $(READY)
	$(VENV)/bin/mkdocs build --strict --quiet

wheel: $(READY)
	rm -rf dist
	$(VENV)/bin/python -m hatchling build

# The daemon for boxes with Debian of this machine's release, without a compiler; DEB_MACHINE="x86_64 aarch64" for both kinds.
DEB_MACHINE ?= $(shell uname -m)
deb: wheel
	$(VENV)/bin/python packaging/make_deb.py dist/*.whl --machine $(DEB_MACHINE)

# An OCI image for replay, identification and fleets; CONTAINER=docker or buildah makes it as well.
CONTAINER ?= podman
image: wheel
	$(CONTAINER) build --file packaging/Containerfile --tag emb-daemon .

# What a user gets: the wheel in an environment with nothing else in it.
wheel-demo: wheel
	$(PYTHON) -m venv --clear build/empty
	build/empty/bin/pip install --quiet --disable-pip-version-check "$$(echo dist/*.whl)[offline]"
	cd build && empty/bin/emb-daemon demo --corners 1 --seconds 8

# Needs the extra fuzz, which the lock file leaves out: $(VENV)/bin/pip install --editable '.[fuzz]'.
# Findings are left in tests/fuzz/findings and become tests.
FUZZ_SECONDS ?= 60
fuzz: $(READY)
	mkdir -p tests/fuzz/findings
	for target in frames secoc state yaml candump; do \
		$(VENV)/bin/python tests/fuzz/fuzz.py $$target -max_total_time=$(FUZZ_SECONDS) -max_len=4096 \
			-artifact_prefix=tests/fuzz/findings/$$target- || exit; \
	done

# Half an hour of four corners; fails if the daemon loses a budget or its memory grows. SOAK_SECONDS=120 in CI.
SOAK_SECONDS ?= 1800
soak: $(READY)
	$(VENV)/bin/python tests/soak.py $(SOAK_SECONDS)

# Mutants of wire, authentication, filter, plausibility, monitor, training, discovery, state files and runtime, drawn with a fixed seed.
MUTANTS ?= 60
mutation: $(READY)
	$(VENV)/bin/python tests/mutation.py $(MUTANTS)

# Fails if an estimate is wrong beyond its stated uncertainty without a flag: one drive of each kind of fault that the
# documentation promises to flag. All 900 drives with one fault and 100 with two: $(VENV)/bin/python -m studies.silent grid
SILENT ?= nominal,torque_constant,friction_scale,viscous,resolver_frozen_last,current_frozen,current_zero,current_lost,$\
thermocouple_stuck,thermocouple_stuck_noise,ambient_cold,power_cycle,bursts_lost,$\
current_offset,power_on_hot,wheel_pulses_pause,stribeck,start_latched,gear_wear,wheel_speed_zero
silent: $(READY)
	$(VENV)/bin/python -m studies.silent grid --faults $(SILENT) --count 1 --processes 1 --strict

# Packages that the daemon's computer installs, as CycloneDX, and their known vulnerabilities. audit also fails if the database
# of vulnerabilities cannot be reached.
SUPPLY = build/supply/bin
$(SUPPLY)/pip-audit:
	$(PYTHON) -m venv build/supply
	$(SUPPLY)/pip install --quiet --disable-pip-version-check 'cyclonedx-bom>=7' 'pip-audit>=2.9'

sbom: $(SUPPLY)/pip-audit
	mkdir -p dist
	$(SUPPLY)/cyclonedx-py requirements --pyproject pyproject.toml --short-PURLs \
		--output-reproducible --of JSON --output-file dist/emb_daemon.cdx.json requirements-box.lock

audit: $(SUPPLY)/pip-audit
	$(SUPPLY)/pip-audit --strict --disable-pip --require-hashes -r requirements-box.lock

# A simulated fleet of 200 units for 30 days: fails unless the effects of three batches and nine of ten faulty units are found,
# with at most one wrong finding.
FLEET_SEED ?= 1
fleet: $(READY)
	$(VENV)/bin/python -m studies.fleet --seed $(FLEET_SEED)

# Ten minutes of four corners at 250 Hz over XCP; fails if one packet is missing.
MEASUREMENT_SECONDS ?= 600
measurement: $(READY)
	$(VENV)/bin/python -m studies.xcp $(MEASUREMENT_SECONDS)

lint: $(READY)
	$(VENV)/bin/ruff check .
	$(VENV)/bin/ruff format --check .

# Fails unless every public name has a known type. pyright examines the package of the first python in PATH.
TYPES = build/types/bin
$(TYPES)/pyright:
	$(PYTHON) -m venv build/types
	$(TYPES)/pip install --quiet --disable-pip-version-check 'pyright[nodejs]==1.1.414'

types: $(READY) $(TYPES)/pyright
	PATH="$(abspath $(VENV))/bin:$$PATH" $(abspath $(TYPES))/pyright --verifytypes emb_daemon --ignoreexternal

format: $(READY)
	$(VENV)/bin/ruff check --fix .
	$(VENV)/bin/ruff format .

# Needs uv; versions are chosen for every supported Python at once.
lock:
	uv pip compile pyproject.toml --extra test --extra offline --extra mf4 --extra formats --extra docs --extra fleet --extra live --extra workshop --universal --python-version 3.11 --generate-hashes \
		--no-header --no-annotate --quiet --output-file requirements.lock
	$(VENV)/bin/pip install --quiet --require-hashes -r requirements.lock
	$(VENV)/bin/python tools/lock_box.py

clean:
	rm -rf $(VENV) .pytest_cache .ruff_cache .hypothesis build dist site
