# Everything a person needs: `make demo`, `make test`. Everything else is for those who change the program.

PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
PACKAGES := $(wildcard packages/trilat-*)
PIP := $(BIN)/python -m pip --disable-pip-version-check install --no-input
LOCKED := --quiet --require-hashes --only-binary :all: -r
# uv takes a quarter of pip's time; pip does what uv cannot, as where only its own settings name a package index
INSTALL = @$(BIN)/uv pip install --python $(BIN)/python $(LOCKED) $< || $(PIP) $(LOCKED) $<

.PHONY: help demo play setup extras test pytest sessions containers push-set lint platforms packages test-long faults docs media bench suite-gains suite lock clean

help:
	@echo "make demo    run the paper's experiment live, 20 s, and look at what it made"
	@echo "make play    take hold of three arms on a page in the browser, and look at what you made"
	@echo "             OPTIONS='--duration 5' gives options to either"
	@echo "make setup   make the virtual environment .venv from locked dependencies, and compile what the demo needs"
	@echo "make extras EXTRAS=view    optional packages as well; without EXTRAS it lists them"
	@echo "make test    everything that CI checks"
	@echo "make test-long    all of that and the rest: every test, every live session, endurance"
	@echo "make packages     the tests of each package, where only the core and the package are installed"
	@echo "make push-set     measure anew which tests make test leaves to make test-long"
	@echo "make faults       docs/data/fault-matrix.csv: two thousand sessions in which things go wrong, and the matrix of faults"
	@echo "make docs         the documentation as a site, with search, offline: build/site/html/index.html"
	@echo "make media        the pictures of README.md, the gallery and a report, from logs of simulated runs"
	@echo "make bench   the figures of docs/theory/benchmarks.md, measured on this machine"
	@echo "make suite-gains  docs/studies/bench.md: tunes the gains that are out of date; entered again, it continues"
	@echo "make suite        docs/studies/bench.md: the whole suite of control laws; entered again, it continues"

demo: setup
	@$(BIN)/trilat demo paper $(OPTIONS)

play: setup
	@$(BIN)/trilat live play $(OPTIONS)

setup: $(VENV)/compiled.stamp

$(VENV)/bin/python:
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11))' || \
		{ echo "trilat-net needs Python 3.11 or newer; name one with: make PYTHON=python3.12 $(MAKECMDGOALS)"; exit 2; }
	@$(PYTHON) -c 'import ensurepip, venv' 2>/dev/null || \
		{ echo "Python's venv module is missing; on Debian and Ubuntu: apt install python3-venv"; exit 2; }
	@$(PYTHON) -m venv $(VENV)

$(VENV)/uv.stamp: requirements/uv.lock | $(VENV)/bin/python
	@$(PIP) $(LOCKED) $< || echo "there is no uv for this machine: pip installs, more slowly"
	@touch $@

$(VENV)/runtime.stamp: requirements/runtime.lock pyproject.toml $(PACKAGES:=/pyproject.toml) | $(VENV)/uv.stamp
	@echo "installing locked dependencies into $(VENV)"
	$(INSTALL)
	@$(PIP) --quiet --no-deps --no-build-isolation $(addprefix -e ,. $(PACKAGES))
	@touch $@

$(VENV)/compiled.stamp: $(VENV)/runtime.stamp $(wildcard trilat_net/core/*/*.py)
	@$(BIN)/python -m tests.compile_core paper
	@touch $@

extras: setup
	@$(BIN)/python -m tests.install_extras "$(EXTRAS)"

$(VENV)/dev.stamp: requirements/dev.lock $(VENV)/runtime.stamp
	$(INSTALL)
	@touch $@

$(VENV)/long.stamp: requirements/long.lock $(VENV)/dev.stamp
	$(INSTALL)
	@touch $@

test:
	@$(MAKE) --no-print-directory -j2 $(VENV)/dev.stamp setup
	@echo "tests, live sessions and linters at once: about six minutes on two cores"
	@$(MAKE) --no-print-directory -j3 sessions pytest lint # real sessions come first: the others give way

pytest: $(VENV)/dev.stamp
	@TRILAT_TEST_RUN=tests nice -n 19 $(BIN)/python -m pytest -q -p tests.progress -n $$(getconf _NPROCESSORS_ONLN) --dist worksteal \
		-m "not live and not long" --ignore tests/live --ignore packages/trilat-people/tests/live_tests

SESSIONS = TRILAT_TEST_RUN=sessions flock -o $(VENV)/sessions.lock $(BIN)/python -m pytest -q -p tests.progress \
	-o cache_dir=.pytest_cache/sessions -m "live and not long" tests/live packages/trilat-people/tests/live_tests packages/trilat-studies/tests/sweep_tests

sessions: $(VENV)/dev.stamp
	@$(SESSIONS) || { echo "real-time sessions depend on what else the machine does: those that failed run once more"; \
		$(SESSIONS) --last-failed; }

push-set: $(VENV)/dev.stamp
	$(BIN)/python -m tests.push_set

test-long: platforms $(VENV)/long.stamp $(VENV)/docs.stamp
	TRILAT_TEST_RUN=all-tests $(BIN)/python -m pytest -q -p tests.progress -n auto --dist worksteal -m "not live"
	TRILAT_TEST_RUN=dealt-tests $(BIN)/python -m pytest -q -p tests.progress -p tests.dealt -n auto -m "not live and not long" --ignore tests/live --ignore packages/trilat-people/tests/live_tests
	TRILAT_TEST_RUN=all-sessions $(BIN)/python -m pytest -q -p tests.progress -m live
	$(MAKE) --no-print-directory packages

packages: $(VENV)/dev.stamp
	$(BIN)/python -m tests.each_package

containers: setup
	.ci/compose

lint: $(VENV)/dev.stamp
	nice -n 19 $(BIN)/ruff check .
	nice -n 19 $(BIN)/ruff format --check .
	nice -n 19 $(BIN)/mypy
	nice -n 19 $(BIN)/lint-imports

platforms: $(VENV)/dev.stamp # processes of sessions use functions of POSIX, and of Linux
	for other in win32 darwin; do \
		$(BIN)/mypy --platform $$other --follow-imports silent --exclude 'trilat_net/app/(demo_session\.py|process_starter\.py|play/)' --cache-dir .mypy_cache/$$other -p trilat_net -p trilat_people.experiment -m trilat_people.hand_impedance -p trilat_studies -p trilat_ros2 || exit 1; \
	done

faults: $(VENV)/dev.stamp
	$(BIN)/python -m tests.faults --seeds 2000 --write

$(VENV)/docs.stamp: requirements/docs.lock $(VENV)/runtime.stamp
	$(INSTALL)
	@touch $@

docs: $(VENV)/docs.stamp
	$(BIN)/python docs/site/make_pages.py
	cd build/site && ../../$(BIN)/zensical build --strict -f zensical.toml
	@echo "open build/site/html/index.html in a browser; it needs no server and no network"

media: setup
	$(BIN)/python docs/media/make_media.py

bench: $(VENV)/dev.stamp
	$(BIN)/python -m benchmarks

suite-gains: setup
	$(BIN)/trilat bench --tune
	$(BIN)/trilat bench --tune --study round-trips

suite: setup
	$(BIN)/trilat bench
	$(BIN)/trilat bench --study round-trips

lock: $(VENV)/uv.stamp
	$(BIN)/uv pip compile -q --universal --generate-hashes --python-version 3.11 --no-annotate \
		--group setup -o requirements/uv.lock
	$(BIN)/uv pip compile -q --universal --generate-hashes --python-version 3.11 --no-annotate \
		pyproject.toml --group build -o requirements/runtime.lock
	$(BIN)/uv pip compile -q --universal --generate-hashes --python-version 3.11 --no-annotate \
		pyproject.toml --extra frames --group build --group dev -c requirements/runtime.lock -o requirements/dev.lock
	$(BIN)/uv pip compile -q --universal --generate-hashes --python-version 3.11 --no-annotate \
		--group long -c requirements/dev.lock -o requirements/long.lock
	$(BIN)/uv pip compile -q --universal --generate-hashes --python-version 3.11 --no-annotate \
		--group docs -c requirements/dev.lock -o requirements/docs.lock
	$(BIN)/uv pip compile -q --universal --generate-hashes --python-version 3.11 --no-annotate \
		--group build --group release -c requirements/dev.lock -o requirements/release.lock
	.ci/distributions
	$(BIN)/uv pip compile -q --universal --generate-hashes --python-version 3.11 --no-annotate \
		build/distributions/trilat-net-core/pyproject.toml -c requirements/runtime.lock -o requirements/core.lock

clean:
	rm -rf $(VENV) build *.egg-info .mypy_cache .pytest_cache .ruff_cache .hypothesis
