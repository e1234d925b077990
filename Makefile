# On a fresh machine: `make demo`, `make test`, `make docs`. Each sets up .venv first, once.
# Needs python3.11 with venv, and make. Another interpreter: make setup PY=/path/to/python3.11

PY ?= python3.11
TORCH := torch==2.13.0

VENV := .venv
BIN := $(VENV)/bin
PIP := $(BIN)/python -m pip --disable-pip-version-check --no-input
OK := $(VENV)/.ok
LOCK_VENV := build/lock-venv
LOCK = $(LOCK_VENV)/bin/uv pip compile -q --python-version 3.11 --generate-hashes --no-emit-index-url \
  --no-emit-find-links --custom-compile-command "make lock"

# Images often forbid bytecode; every process that a test starts would then compile all that it imports.
unexport PYTHONDONTWRITEBYTECODE

.DEFAULT_GOAL := help
.DELETE_ON_ERROR:
.PHONY: help setup docs demo quick test test-all test-slurm test-ray test-tune check sanitise bench runtime image lock clean

help: ## list the verbs
	@echo "usage: make VERB"
	@awk -F ':.*## ' '/^[a-z-]+:.*## / { printf "  %-10s %s\n", $$1, $$2 }' $(firstword $(MAKEFILE_LIST))

setup: $(OK) ## make .venv with the locked packages and go1exp in it (redone when pyproject.toml, the lock or C++ changes)

$(OK): pyproject.toml requirements/lock.txt hatch_build.py $(wildcard go1exp/deploy/estimation/cpp/*)
	@$(PY) -c 'import sys, venv, ensurepip; sys.exit(sys.version_info < (3, 11))' 2>/dev/null || { \
	  echo "go1exp needs Python 3.11 or newer with venv, but '$(PY)' is missing, older or has no venv."; \
	  echo "Install python3.11 or name one: make setup PY=/path/to/python3.11"; exit 1; } >&2
	@echo "setup 1/5: virtual environment in $(VENV), from $$($(PY) --version)"
	@rm -f $@
	@$(PY) -m venv $(VENV)
	@echo "setup 2/5: $(TORCH)"
	@$(PIP) install -qq --no-compile "$(TORCH)"
	@echo "setup 3/5: packages of requirements/lock.txt"
	@$(call install,lock)
	@echo "setup 4/5: go1exp itself, editable"
	@$(PIP) install -qq --no-build-isolation --no-deps -e .
	@$(BIN)/python -c 'from go1exp.deploy.estimation import compiled; compiled()' 2>&1 | tail -n 1
	@echo "setup 5/5: check that the packages fit together, and compile what go1exp imports of them"
	@$(PIP) check
	@$(BIN)/python -c 'import go1exp.gap.stages.explain, go1exp.train.trainer'
	@touch $@

# Packages of a lock, hash-checked: with uv, or with pip where uv cannot be installed or does not find them.
install = $(PIP) install -qq --require-hashes --no-deps -r requirements/uv.txt 2>/dev/null && \
  $(BIN)/uv pip install -q --python $(BIN)/python --link-mode copy --require-hashes --no-deps -r requirements/$(1).txt \
  2>/dev/null || $(PIP) install -qq --require-hashes --no-deps -r requirements/$(1).txt

docs: setup ## build the documentation in build/docs; any warning or dead link is an error
	@echo "docs 1/2: packages of requirements/docs.txt"
	@$(call install,docs)
	@echo "docs 2/2: sphinx-build"
	@$(BIN)/python -m sphinx -q -b html -n -W --keep-going -d build/doctrees docs build/docs
	@echo "docs: build/docs/index.html"

demo: setup ## train for two minutes, evaluate the policy, render a video, find a model error, all in runs/demo
	@echo "demo 1/4: go1exp train experiment=minute (two minutes on two cores)"
	@$(BIN)/go1exp train experiment=minute hydra.run.dir=runs/demo
	@echo "demo 2/4: go1exp eval, at a finer physics step than in training (a quarter of a minute)"
	@$(BIN)/go1exp eval run=runs/demo 'grid.x=[0.5,-0.5]' 'grid.y=[0.3]' 'grid.yaw=[0.8]' seconds=10 physics_dt=0.002 noise=true
	@echo "demo 3/4: go1exp play (half a minute)"
	@$(BIN)/go1exp play run=runs/demo viewer=clip physics_dt=0.002
	@echo "demo 4/4: go1exp gap, on recordings of a robot with friction that the model does not have (a minute)"
	@$(BIN)/go1exp gap logs=assets/demo/suspended_go1 out=runs/demo/gap || [ $$? -eq 10 ]

# SLOW: none, all, or a commit: then the slow tests that are about a file changed since (tests/selection.py).
# SLOW_SECONDS: after so many in each process, slow tests are skipped.
SLOW ?= none
SLOW_SECONDS ?= inf
PYTEST = $(BIN)/python -m pytest -n $(or $(JOBS),2) --dist loadscope -q

# Files that need neither a training nor another process nor a search. Others: make quick T=tests/test_ppo.py
T ?= $(addprefix tests/,contracts/test_actuators.py contracts/test_terms.py $(addprefix test_,$(addsuffix .py, \
  configs delay_line excitations feet help layering logging randomness recording rewards selection)))

quick: setup ## run tests that take seconds, while working; of certain files: make quick T=tests/test_ppo.py
	@echo "quick: pytest"
	@$(PYTEST) --slow=none $(T)

test: setup ## run the tests that must hold
	@echo "test: pytest"
	@$(PYTEST) --slow=$(SLOW) --slow-seconds=$(SLOW_SECONDS) --durations=15

test-all: SLOW := all
test-all: test ## run every test

test-slurm: setup ## sweeps on a real Slurm of this machine alone, started and ended here; needs root, slurm-wlm, munge
	@echo "test-slurm 1/2: submitit"
	@$(PIP) install -qq "submitit>=1.5.4,<2"
	@echo "test-slurm 2/2: pytest"
	@GO1EXP_TEST_SLURM=1 $(BIN)/python -m pytest -q --slow=all tests/test_slurm.py tests/test_study.py tests/test_sweep_index.py

test-tune: setup ## searches for settings with Optuna
	@echo "test-tune 1/2: optuna"
	@$(PIP) install -qq "optuna>=5,<6"
	@echo "test-tune 2/2: pytest"
	@GO1EXP_TEST_TUNE=1 $(BIN)/python -m pytest -q --slow=all tests/test_tune.py

test-ray: setup ## sweeps on a Ray cluster of this machine, one node of which is killed; needs root
	@echo "test-ray 1/2: ray"
	@$(PIP) install -qq "ray>=2.60,<3"
	@echo "test-ray 2/2: pytest"
	@GO1EXP_TEST_RAY=1 $(BIN)/python -m pytest -q --slow=all tests/test_ray.py

check: setup ## formatting, lint and types; changes nothing
	@echo "check 1/3: ruff format"
	@$(BIN)/ruff format --check .
	@echo "check 2/3: ruff check"
	@$(BIN)/ruff check .
	@echo "check 3/3: mypy"
	@$(BIN)/mypy

sanitise: setup ## the C++ filter once under the address and undefined-behaviour sanitisers
	@echo "sanitise 1/2: build"
	@$(BIN)/python hatch_build.py --sanitise build/sanitise
	@echo "sanitise 2/2: the motions of tests/test_estimation.py, C++ against NumPy"
	@LD_PRELOAD="$$($${CXX:-g++} -print-file-name=libasan.so)" ASAN_OPTIONS=detect_leaks=0 \
	  $(BIN)/python tests/test_estimation.py build/sanitise

bench: setup ## measure the speed of the environment, of training, of nets and effects
	@echo "bench 1/3: environment"
	@$(BIN)/go1exp bench suite=env
	@echo "bench 2/3: training"
	@$(BIN)/go1exp bench suite=train
	@echo "bench 3/3: nets, effects, recording"
	@$(BIN)/go1exp bench suite=actuator

runtime: ## make build/runtime, the environment of the robot's computer: no torch, no MuJoCo (docs/deploy.md)
	@echo "runtime 1/3: wheel in build/wheels"
	@rm -rf build/wheels build/runtime
	@PYTHON=$(PY) deploy/build.sh build/wheels
	@echo "runtime 2/3: environment in build/runtime"
	@PYTHON=$(PY) deploy/install.sh build/runtime build/wheels/go1exp-*.whl
	@echo "runtime 3/3: check"
	@deploy/check.sh build/runtime

image: ## the same as a container image, go1exp-deploy; needs Docker
	@command -v docker >/dev/null || { echo "make image needs Docker, and there is none; make runtime does without" >&2; exit 1; }
	@docker info >/dev/null 2>&1 || { \
	  echo "make image: docker reaches no daemon (docker info says why); make runtime does without" >&2; exit 1; }
	docker build -f deploy/Dockerfile -t go1exp-deploy .

# An override that never applies takes torch, and with it the CUDA packages, out of the resolution.
lock: ## resolve requirements/base.in into requirements/lock.txt, keeping the pins that still fit
	@echo "lock 1/3: uv in $(LOCK_VENV)"
	@$(PY) -m venv $(LOCK_VENV)
	@$(LOCK_VENV)/bin/python -m pip install -qq --disable-pip-version-check --no-input --require-hashes -r requirements/uv.txt
	@echo "lock 2/3: requirements/lock.txt and requirements/docs.txt"
	@echo "torch ; python_version < '3'" > build/no-torch.txt
	@$(LOCK) requirements/base.in --override build/no-torch.txt -o requirements/lock.txt
	@$(LOCK) requirements/docs.in -c requirements/lock.txt -o requirements/docs.txt
	@! grep -n '://' requirements/lock.txt requirements/docs.txt || { echo "a lock names an address" >&2; exit 1; }
	@echo "lock 3/3: requirements/deploy.txt and requirements/build.txt, parts of it"
	@$(PY) deploy/lock.py

clean: ## remove .venv, build products and caches; keeps runs/ and outputs/
	@echo "clean: $(VENV), build products and caches"
	@rm -rf $(VENV) build dist *.egg-info go1exp/deploy/estimation/_kalman.*.so .pytest_cache .mypy_cache .ruff_cache .hypothesis
	@find go1exp tests -name __pycache__ -type d -prune -exec rm -rf {} +
