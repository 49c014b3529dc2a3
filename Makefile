# `make cases` computes the paper's cases, `make test` runs the tests; both make .venv themselves.

PYTHON ?= python3
BIN := .venv/bin
KATEX := 0.16.47
# Where Python is told to keep no compiled modules, each of the many processes here would compile all that it imports.
unexport PYTHONDONTWRITEBYTECODE

.PHONY: cases view test slow lint types snippets tables tables-check docs wheel benchmarks clean

cases: .venv/installed
	$(BIN)/ssm-decouple compare all --output results

# From a clone to a moving picture: case 1 under no, selective and reactionless protection in the browser, until Ctrl-C.
view: .venv/installed-viewer
	$(BIN)/ssm-decouple compare case1 --no-figures --output results
	$(BIN)/ssm-decouple view results/case1/none.nc results/case1/selective.nc results/case1/reactionless.nc

test: .venv/installed-dev
	$(BIN)/python -m pytest -n auto --dist worksteal

slow: .venv/installed-dev
	$(BIN)/python -m pytest -m slow

lint: .venv/installed-dev
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .

types: .venv/installed-dev
	$(BIN)/mypy

# Every Python block in the documents runs.
snippets: .venv/installed-dev
	$(BIN)/python -m pytest -p no:cacheprovider README.md docs

# The tables in the documents are what the commands print today.
tables-check: .venv/installed-dev
	$(BIN)/python docs/tables.py --check

tables: .venv/installed-dev
	$(BIN)/python docs/tables.py

# The site, into site/, with warnings as errors. Its generator reads the source and imports none of it, so that it has an
# environment of its own and needs neither the package nor what that depends on.
docs: .venv-docs/installed
	.venv-docs/bin/python docs/build.py

# Build the wheel, install it in an empty environment and run a case from another folder. What builds it stands outside
# that environment, and not in .venv, so that both can be installed at once.
wheel:
	rm -rf dist .venv-wheel
	$(PYTHON) -m venv .venv-wheel
	.venv-wheel/bin/pip install --quiet --disable-pip-version-check --target .venv-wheel/building build
	PYTHONPATH=.venv-wheel/building .venv-wheel/bin/python -m build --outdir dist .
	.venv-wheel/bin/pip install --quiet --disable-pip-version-check --no-compile dist/*.whl
	cd .venv-wheel && bin/ssm-decouple run case1 --no-progress && ls results/case1
	rm -rf .venv-wheel

benchmarks: .venv/installed-dev
	$(BIN)/python benchmarks/control_step.py
	$(BIN)/python benchmarks/dynamic.py
	$(BIN)/python benchmarks/start_up.py
	$(BIN)/python benchmarks/arms.py
	$(BIN)/python benchmarks/exactness.py
	$(BIN)/python benchmarks/batch.py
	$(BIN)/python benchmarks/campaign.py

clean:
	rm -rf .venv .venv-docs .venv-wheel .cache dist docs/assets/katex results site

# pip is renewed first: old resolvers try every version of everything. Most modules are never imported, so none is
# compiled before it is.
.venv/bin/python:
	$(PYTHON) -m venv .venv
	$(BIN)/pip install --quiet --upgrade pip

.venv-docs/installed: pyproject.toml
	@command -v npm >/dev/null || { echo "the site needs npm, to fetch KaTeX: apt install npm"; exit 1; }
	$(PYTHON) -m venv .venv-docs
	.venv-docs/bin/pip install --quiet --upgrade pip
	.venv-docs/bin/pip install --quiet --disable-pip-version-check --no-compile --group docs
	rm -rf docs/assets/katex && mkdir docs/assets/katex
	cd .venv-docs && npm pack --silent katex@$(KATEX) && tar xzf katex-$(KATEX).tgz
	cd .venv-docs/package && cp -r LICENSE dist/katex.min.js dist/katex.min.css dist/fonts ../../docs/assets/katex
	touch $@

.venv/installed: pyproject.toml .venv/bin/python
	@echo "installing into .venv, a minute or so"
	$(BIN)/pip install --quiet --disable-pip-version-check --no-compile --editable .
	touch $@

.venv/installed-viewer: pyproject.toml .venv/bin/python
	@echo "installing into .venv, a minute or so"
	$(BIN)/pip install --quiet --disable-pip-version-check --no-compile --editable '.[viewer]'
	touch $@ .venv/installed

.venv/installed-dev: pyproject.toml .venv/bin/python
	@echo "installing into .venv, two minutes or so"
	$(BIN)/pip install --quiet --disable-pip-version-check --no-compile --editable '.[dev]'
	touch $@ .venv/installed .venv/installed-viewer
