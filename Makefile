# `make demo` and `make test` set up everything in .venv; nothing else is needed than Python 3.11.
PYTHON ?= python3
BIN := .venv/bin

.PHONY: demo test notebooks reproduce docs lint clean newcomer

.venv/installed: pyproject.toml constraints.txt
	test -x $(BIN)/python || $(PYTHON) -m venv .venv
	$(BIN)/python -m pip install --quiet --constraint constraints.txt --editable '.[dev]'
	touch $@

demo: .venv/installed
	$(BIN)/zermelo demo four-queries --out out/demo

test: .venv/installed
	$(BIN)/python -m pytest --numprocesses 2 --dist worksteal

notebooks: .venv/installed
	$(BIN)/python -m pytest --numprocesses 2 -m notebook

reproduce: .venv/installed
	$(BIN)/zermelo reproduce all --quick --out out/reproduce

# Times a newcomer's path on a clean clone.
newcomer:
	.ci/newcomer

docs: .venv/installed
	NO_MKDOCS_2_WARNING=1 $(BIN)/mkdocs build --quiet --strict

lint: .venv/installed
	$(BIN)/ruff format --check .
	$(BIN)/ruff check .
	$(BIN)/pyright

clean:
	rm -rf .venv out build *.egg-info
