# Every target creates the virtual environment first; a clean checkout is enough.

PYTHON ?= python3
BIN := .venv/bin
DEMO := demo

# Of `make fuzz`: seconds in which files are damaged and read.
SECONDS ?= 60

.PHONY: demo notebooks site picture check test long slow studies coverage statistics bench fuzz lock locked sbom clean

demo: .venv/installed
	@rm -rf $(DEMO)
	@echo "Simulating a Y stage with wearing preload and loosening mount ..."
	@$(BIN)/python -m models simulate lms-y --life both --logs 40 --seconds 20 --seed 3 --out $(DEMO)/logs
	@echo "Analysing the logs ..."
	@$(BIN)/lmshealth run $(DEMO)/logs --stage lms-y --out $(DEMO)/result --today 2026-07-20

# The picture in the README: a screenshot of the report of the demo.
picture: .venv/installed
	@test -d $(DEMO)/result || $(MAKE) demo
	$(BIN)/python -m tests.tools.picture $(DEMO)/result

# The notebooks with the results of their cells, as pages in demo/notebooks.
notebooks: .venv/installed
	@mkdir -p $(DEMO)/notebooks
	$(BIN)/jupytext --set-kernel python3 --to ipynb --execute --run-path . studies/notebooks/*.py
	@mv studies/notebooks/*.ipynb $(DEMO)/notebooks/
	$(BIN)/jupyter nbconvert --to html $(DEMO)/notebooks/*.ipynb

# The documentation as a site in demo/site, with executed notebooks; a broken link fails.
site: notebooks
	$(BIN)/pip install --quiet --disable-pip-version-check --editable ".[docs]"
	$(BIN)/python -m tests.tools.site.pages $(DEMO)/site-source
	$(BIN)/sphinx-build -W --keep-going -q -b html -c tests/tools/site $(DEMO)/site-source $(DEMO)/site

# Linters, types, layers of the packages.
check: .venv/installed
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy
	$(BIN)/lint-imports

# Tests run in parallel processes: one thread each for linear algebra.
test long slow studies coverage statistics bench: export OPENBLAS_NUM_THREADS = 1
test long slow studies coverage statistics bench: export OMP_NUM_THREADS = 1
# Tests start many programs: let them share compiled byte code.
unexport PYTHONDONTWRITEBYTECODE
test: .venv/installed
	$(BIN)/pytest -n 2 --dist worksteal -m "not slow and not study and not statistical"

# `make studies slow statistics` in one run: tests are collected once, and no processor waits for
# the last test of each.
long: .venv/installed
	$(BIN)/pytest -n 2 --dist worksteal --durations=30 -m "study or slow or statistical"

# Quick forms of all studies: the questions of studies/README.md on few data. With FULL=1 all are
# recorded in full, which takes a night; an interrupted run goes on where it was.
studies: .venv/installed
ifdef FULL
	$(BIN)/python -m studies.harness.full
else
	$(BIN)/pytest -n 2 --dist worksteal -m study
endif

# Tests of seconds each: whole files, servers, browsers, chains.
slow: .venv/installed
	$(BIN)/pytest -n 2 --dist worksteal -m "slow and not statistical"

# Lines of the package that no fast test runs; fails below 95 %. Studies do not count.
coverage: .venv/installed
	$(BIN)/pytest -n 2 -m "not slow and not study and not statistical" \
		--cov=lmshealth --cov-fail-under=95

# Calibration of errors and intervals, with a page of ranks and coverages; LMSHEALTH_SEED=7 draws
# other data.
statistics: .venv/installed
	LMSHEALTH_STATISTICS=$(DEMO)/statistics.html $(BIN)/pytest -n 2 --dist worksteal -m statistical

# Speed of every step relative to a peer, recorded in studies/cost/ratios/result.json.
bench: .venv/installed
	$(BIN)/python -m studies.cost.ratios.run

# Damaged files of all formats, from another seed each time; what fails is kept and named.
fuzz: .venv/installed
	LMSHEALTH_FUZZ_EXAMPLES=$$(( 5 * $(SECONDS) )) $(BIN)/pytest -q -m slow tests/io/formats/test_fuzz.py

# Versions and hashes of all that development needs; `make locked` installs just these.
lock: .venv/installed
	$(BIN)/uv pip compile --quiet --universal --python-version 3.11 --extra dev --generate-hashes \
		--no-annotate --no-header --no-emit-index-url pyproject.toml -o tests/requirements.lock

locked:
	$(PYTHON) -m venv --clear .venv
	$(BIN)/pip install --quiet --disable-pip-version-check --require-hashes -r tests/requirements.lock
	$(BIN)/pip install --quiet --disable-pip-version-check --no-deps --editable .
	@touch .venv/installed

# Bill of materials of the environment (CycloneDX), with licences.
sbom: .venv/installed
	$(BIN)/uv tool run --from cyclonedx-bom cyclonedx-py environment .venv/bin/python \
		--pyproject pyproject.toml --output-reproducible -o sbom.json

# Reinstall when pyproject.toml is newer than the installation.
.venv/installed: pyproject.toml
	$(PYTHON) -m venv .venv
	$(BIN)/pip install --quiet --disable-pip-version-check --editable ".[dev]"
	@touch $@

clean:
	rm -rf .venv $(DEMO) sbom.json build .coverage .coverage.* *.egg-info .pytest_cache .mypy_cache .ruff_cache
