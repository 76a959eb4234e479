# make demo     normals for a sample scan, and a picture of them, in demo/
# make test     everything that is checked: lint, then all tests
# make quick    lint and the tests that take less than a minute
# make lint     style, format, direction of imports, types
# make format   mend style and format
# make docs     build the documentation in site/ and check its links
# make fuzz     damaged files for every reader, for SECONDS (600); prints a table
# make torture  commands that are killed at KILLS (50) random moments each, or have no disk
# make hostile  clouds that are hard on an estimator: errors and signs by model
# make setup    only the virtual environment .venv, which all of the above make on their own
#
# make demo PYTHON=python3.12      another Python (3.10 or newer)
# make demo TORCH_INDEX=ADDRESS    PyTorch's package index for CPU-only wheels (its address is on PyTorch's
#                                  "Get started" page under CPU): on Linux x86-64 the default wheel brings
#                                  several GB of CUDA libraries along

PYTHON ?= python3
TORCH_INDEX ?=
SECONDS ?= 600
KILLS ?= 50

BIN := .venv/bin
STAMP := .venv/.installed

.PHONY: browser demo docs format fuzz hostile lint quick setup test torture

demo: $(STAMP)
	@mkdir -p demo
	$(BIN)/jetnormal estimate samples/milk.pcd -o demo/milk_normals.ply --force
	$(BIN)/jetnormal preview demo/milk_normals.ply -o demo/milk_normals.png --force \
		--up=-0.05,-0.85,-0.46 --views=-15:20 --colors file,normals,plain --size 620 --background dark
	@echo "The cloud with normals: demo/milk_normals.ply    A picture of it: demo/milk_normals.png"

test: lint browser
	$(BIN)/python -m pytest --durations=10

quick: lint
	OMP_NUM_THREADS=1 $(BIN)/python -m pytest -q tests/formats tests/geometry tests/support  # small arrays: threads only wait

lint: $(STAMP)
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/lint-imports
	$(BIN)/mypy

format: $(STAMP)
	$(BIN)/ruff check --fix .
	$(BIN)/ruff format .

docs: $(STAMP)
	NO_MKDOCS_2_WARNING=1 $(BIN)/mkdocs build --strict

fuzz: $(STAMP)
	PYTHONPATH=tests $(BIN)/python -m robustness.fuzz --seconds $(SECONDS)

torture: $(STAMP)
	PYTHONPATH=tests $(BIN)/python -m robustness.torture --kills $(KILLS)

hostile: $(STAMP)
	PYTHONPATH=tests $(BIN)/python -m robustness.hostile

# The page that `preview --html` writes is tested in Chromium. Without it those tests are skipped.
browser:
	@command -v chromium >/dev/null || command -v google-chrome >/dev/null || { [ "$$(id -u)" = 0 ] && apt-get update -qq && \
		DEBIAN_FRONTEND=noninteractive apt-get install -qq -y --no-install-recommends chromium </dev/null; } \
		>/dev/null 2>&1 || echo "There is no Chromium, and apt cannot install it here: its tests are skipped."

setup: $(STAMP)

# Without ensurepip (Debian's python3 without python3-venv) an installed pip can still fill the environment.
$(BIN)/pip:
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 10))' || \
		{ echo "jetnormal needs Python 3.10 or newer: name one, as in make PYTHON=python3.12" >&2; exit 1; }
	@$(PYTHON) -m venv .venv >/dev/null 2>&1 || \
		{ $(PYTHON) -m venv --clear --without-pip .venv && $(PYTHON) -m pip --python $(BIN)/python install pip; } || \
		{ echo "Python cannot make a virtual environment here: apt install python3-venv" >&2; exit 1; }

$(STAMP): pyproject.toml constraints.txt | $(BIN)/pip
	$(BIN)/python -m pip install --disable-pip-version-check --no-input --constraint constraints.txt \
		$(if $(TORCH_INDEX),--extra-index-url $(TORCH_INDEX)) --editable '.[dev]'
	@touch $@
