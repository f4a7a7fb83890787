# make run, test, test-all, test-slowest, lint, docs, screenshots, bench, compile-times, fuzz, ecosystem: each sets up what
# it needs in .venv.
PYTHON ?= python3
VENV ?= .venv
BIN := $(VENV)/bin
INSTALL := $(PYTHON) install.py $(VENV)

# Tests and benchmarks start Python many times: without it, each of them compiles SymPy anew, which takes seconds.
unexport PYTHONDONTWRITEBYTECODE

.PHONY: run test test-all test-slowest lint docs screenshots bench compile-times fuzz ecosystem generate clean

run:
	@$(INSTALL) visual
	$(BIN)/fourbar simulate four_bar -o results/four_bar.csv -o results/four_bar.npz -o results/four_bar.png

PYTEST := $(BIN)/python -m pytest --numprocesses auto --dist worksteal

# Some of each kind, in minutes: tests/README.md says which.
test:
	@$(INSTALL) test visual
	$(PYTEST) -m 'not slow'

test-all:
	@$(INSTALL) test visual
	$(PYTEST)

# All tests, and which of them, and which models, take most processor time.
test-slowest:
	@$(INSTALL) test visual
	$(PYTEST) --costs 20

lint:
	@$(INSTALL) test visual
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy
	$(BIN)/python -m mypy.stubtest $(addprefix fourbar_codegen.runtime.,batch evaluator implicit integrator) --ignore-disjoint-bases --allowlist tests/harness/stubs.txt
	$(BIN)/python tests/harness/scripts.py build/scripts
	$(BIN)/oxlint --quiet --deny-warnings --config .oxlintrc.json build/scripts/*.js
	for script in build/scripts/*.js; do node --check $$script || exit 1; done
	$(BIN)/clang-format --dry-run --Werror $(wildcard src/fourbar_codegen/runtime/*.h src/fourbar_codegen/runtime/*/*.h src/fourbar_codegen/runtime/*/*.inc) \
		tests/runtime/*.c
	PATH=$(BIN):$$PATH $(BIN)/cython-lint --max-line-length 120 src/fourbar_codegen/runtime/*.pyx src/fourbar_codegen/runtime/*.pxd

# Without Ipopt, one page is built without its outputs, and says so.
docs:
	@$(INSTALL) test visual docs page $$(pkg-config --exists ipopt lapack 2>/dev/null && echo ipopt)
	$(BIN)/python -m sphinx --fail-on-warning --quiet -b html docs docs/_build/html

# The built documentation as readers see it: pictures, accessibility, links, what is clipped or loaded from elsewhere.
screenshots: docs
	$(BIN)/python docs/screenshots.py

bench:
	@$(INSTALL) test visual bench
	$(BIN)/python benchmarks/four_bar.py --output results/benchmark.json
	$(BIN)/python benchmarks/cold.py --output results/cold.json
	$(BIN)/python benchmarks/compile_times.py --output results/compile_times.json
	$(BIN)/python benchmarks/models.py --output results/models.json
	$(BIN)/python benchmarks/drift.py --output results/drift.json
	$(BIN)/python benchmarks/methods.py --output results/methods.json
	$(BIN)/python benchmarks/peers.py --output results/peers.json
	$(BIN)/python benchmarks/engines.py --output results/engines.json
	$(BIN)/python benchmarks/recursive.py --output results/recursive.json
	$(BIN)/python benchmarks/forms.py --output results/forms.json
	$(BIN)/python benchmarks/sensitivities.py --output results/sensitivities.json
	$(BIN)/python benchmarks/collocation.py --output results/collocation.json
	$(BIN)/python benchmarks/pins.py --output results/pins.json
	$(BIN)/python benchmarks/scale.py --output results/scale.json
	$(BIN)/python benchmarks/events.py --output results/events.json
	$(BIN)/python benchmarks/export.py --output results/export.json
	$(BIN)/python benchmarks/footprint.py --output results/footprint.json
	$(BIN)/python benchmarks/page.py --output results/page.json

# What compiling ten models takes by stage; a minute or two.
compile-times:
	@$(INSTALL) test visual
	$(BIN)/python benchmarks/compile_times.py

# Hours: 100,000 calls, 1,000 Systems. FUZZ='--calls 1000' does fewer of these, as `python -m fuzz.runner run --help` says.
fuzz:
	@$(INSTALL) test visual
	PYTHONPATH=tests:benchmarks:examples $(BIN)/python -m fuzz.runner run --docs $(FUZZ)

# Models of others, from SymBRiM, SymPy, PyDy and opty; minutes.
ecosystem:
	@$(INSTALL) test visual
	PYTHONPATH=tests:benchmarks:examples $(BIN)/python -m ecosystem

generate:
	@$(INSTALL) test visual
	$(BIN)/fourbar generate four_bar -o generated

clean:
	rm -rf $(VENV) build results docs/_build docs/_live docs/notebooks src/*.egg-info src/fourbar_codegen/*/*.so
