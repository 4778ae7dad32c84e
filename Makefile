# Every target first makes a virtual environment, so that a clean checkout is enough.

PYTHON ?= python3
BIN := .venv/bin
DEMO := demo

.PHONY: demo picture check test slow coverage statistics bench clean

demo: .venv/installed
	@rm -rf $(DEMO)
	@echo "Simulating the life of a Y stage whose preload wears and whose mount loosens ..."
	@$(BIN)/python -m models simulate lms-y --life both --logs 40 --seconds 20 --seed 3 --out $(DEMO)/logs
	@echo "Analysing its logs ..."
	@$(BIN)/lmshealth run $(DEMO)/logs --stage lms-y --out $(DEMO)/result

# The picture in the README, from the report of the demo.
picture: .venv/installed
	@test -d $(DEMO)/result || $(MAKE) demo
	$(BIN)/python -m studies.demo_life.picture $(DEMO)/result

# Linters and types.
check: .venv/installed
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy
	$(BIN)/lint-imports

# Tests run side by side: threads inside linear algebra would only get in their way.
test slow coverage statistics bench: export OPENBLAS_NUM_THREADS = 1
test slow coverage statistics bench: export OMP_NUM_THREADS = 1
# They start many programs: these find compiled what one of them has compiled.
unexport PYTHONDONTWRITEBYTECODE
test: .venv/installed
	$(BIN)/pytest -n 2 --dist worksteal -m "not slow and not statistical"

# Tests that take seconds each: whole files, servers, browsers, chains.
slow: .venv/installed
	$(BIN)/pytest -n 2 --dist worksteal -m "slow and not statistical"

# Which lines of the package does no fast test run? Fails below 95 %. What studies run does not count.
coverage: .venv/installed
	$(BIN)/pytest -n 2 -m "not slow and not statistical" --ignore=tests/test_studies.py \
		--cov=lmshealth --cov-fail-under=95

# Is what is said of errors and intervals true? LMSHEALTH_SEED=7 draws all anew.
statistics: .venv/installed
	$(BIN)/pytest -n 2 --dist worksteal -m statistical

# Every figure of speed beside its peer, into studies/bench/result.json.
bench: .venv/installed
	$(BIN)/python -m studies.bench.run

# The stamp is newer than what it was made from, or the installation is done again.
.venv/installed: pyproject.toml
	$(PYTHON) -m venv .venv
	$(BIN)/pip install --quiet --disable-pip-version-check --editable ".[dev]"
	@touch $@

clean:
	rm -rf .venv $(DEMO) build .coverage .coverage.* *.egg-info .pytest_cache .mypy_cache .ruff_cache
