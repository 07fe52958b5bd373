# Two commands matter: `make demo` and `make test`. Both set everything up first.
.DEFAULT_GOAL := help
.PHONY: help setup build demo test soak check format bench docs clean
PYTHON ?= python3
PROFILE ?= release
VENV := .venv
BIN := $(VENV)/bin
RUST := $(shell find crates -name '*.rs' -o -name Cargo.toml) Cargo.toml Cargo.lock

help: ## this list
	@awk -F ':.*## ' '/^[a-z]+:.*## / {printf "  make %-8s %s\n", $$1, $$2}' $(MAKEFILE_LIST)

$(VENV)/.tools: requirements.txt
	@command -v cargo >/dev/null || { echo "weldscan needs a Rust toolchain (cargo); see https://rustup.rs" >&2; exit 1; }
	@$(PYTHON) -c 'import sys; sys.exit("weldscan needs Python >= 3.11, this is %d.%d: make PYTHON=python3.11 ..." % sys.version_info[:2] if sys.version_info < (3, 11) else 0)'
	@echo "setting up $(VENV) ..."
	@test -x $(BIN)/python || $(PYTHON) -m venv $(VENV) || { echo "python3 -m venv failed: on Debian, apt-get install python3-venv" >&2; exit 1; }
	@$(BIN)/python -m pip install --quiet --disable-pip-version-check -r requirements.txt
	@touch $@

$(VENV)/.built-$(PROFILE): $(VENV)/.tools $(RUST) pyproject.toml
	@echo "building the core (profile $(PROFILE)) ..."
	@VIRTUAL_ENV=$(abspath $(VENV)) $(BIN)/maturin develop --quiet --locked --profile $(PROFILE)
	@rm -f $(VENV)/.built-* && touch $@

$(VENV)/.peers: requirements-peers.txt .ci/debian-peers $(VENV)/.tools
	@.ci/debian-peers
	@while read -r peer; do case "$$peer" in ""|\#*) continue;; esac; \
	  $(BIN)/python -m pip install --quiet --disable-pip-version-check --no-deps "$$peer" 2>/dev/null \
	    || echo "without $$peer: its tests are skipped"; done < requirements-peers.txt
	@touch $@

setup: $(VENV)/.tools ## the virtual environment in .venv

build: $(VENV)/.built-$(PROFILE) ## the core, installed into .venv

demo: build ## a simulated cell, measured: summary and report
	@$(BIN)/weldscan demo

test: build $(VENV)/.peers ## every test, Rust and Python
	cargo test --locked --workspace --profile fast
	$(BIN)/python -m pytest -n auto --maxprocesses 4 --dist loadfile

soak: build $(VENV)/.peers ## the attacks on the live cell in full: kills, interrupts, EIO, full disks, hostile links; an hour
	$(BIN)/python -m pytest --soak -n 2 --dist load --durations 0 --durations-min 1 tests/station/test_campaigns.py \
	  tests/station/test_scan.py tests/devices/test_hostile_links.py tests/devices/test_robot_peers.py

check: build ## format, lints, types, import contracts, documentation
	cargo fmt --all --check
	cargo clippy --profile fast --locked --workspace --all-targets --all-features -- -D warnings
	RUSTDOCFLAGS="-D warnings" cargo doc --profile fast --locked --workspace --no-deps --quiet
	! grep -rnE 'pyo3|numpy' crates/weldcore/src --include='*.rs' | grep -v '^crates/weldcore/src/python/' | grep -vE ':[0-9]+:\s*//'
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy
	$(BIN)/stubtest weldscan._weldcore
	$(BIN)/lint-imports

format: setup ## rewrite in the project's format
	cargo fmt --all
	$(BIN)/ruff format .
	$(BIN)/ruff check --fix .

bench: build ## criterion
	cargo bench --locked

clean: ## remove what was built
	rm -rf $(VENV) target
