# Every target that needs Python first makes the virtual environment .venv, once: a
# stamp inside it carries the checksum of what it was made from, so a second run
# installs nothing and an edit of pyproject.toml or constraints.txt brings it up to date.
#
#   make demo PYTHON=python3.12   another interpreter than python3
#   make demo TORCH_INDEX=URL     a second package index to look for PyTorch in: with
#                                 PyTorch's CPU index, Linux gets the build without CUDA

PYTHON ?= python3
TORCH_INDEX ?=
CONSTRAINTS ?= constraints.txt
WORKERS ?= 2

VENV := .venv
PY := $(VENV)/bin/python
PIP := $(PY) -m pip install -qq --disable-pip-version-check --no-input
TORCH := $(or $(shell grep '^torch==' $(CONSTRAINTS)),torch)
DM_CONTROL := $(or $(shell grep '^dm_control==' $(CONSTRAINTS)),dm-control)
MADE_FROM := $(shell { pwd; cat pyproject.toml $(CONSTRAINTS); } | cksum | cut -d' ' -f1)
STAMP := $(VENV)/.installed-$(MADE_FROM)
NERD := $(PY) -m torchrl_nerd.cli
# A machine that is lent for minutes has torch, and no network to make .venv with.
GPU_PY := $(or $(wildcard $(PY)),$(PYTHON))
PYTEST := OMP_NUM_THREADS=1 $(PY) -m pytest

.PHONY: help setup dev demo test check size words test-slow test-gpu gpu gpu-wheels bench-check results varied-cartpole varied-double_pendulum model-cartpole-adaptive model-double_pendulum-adaptive model-ant-adaptive model-anymal-adaptive model-franka-adaptive data-ant data-ant-learned data-anymal data-anymal-learned anymal-wide data-franka model-ant model-ant-mlp model-double_pendulum model-cube model-franka model-franka-mlp model-anymal model-anymal-mlp model-double_pendulum-mlp policies format docs build lock clean
.DEFAULT_GOAL := help

help: ## list the targets
	@awk -F ':.*## ' '/^[a-z_ -]+:.*## / { printf "  %-26s %s\n", $$1, $$2 }' Makefile

setup: $(STAMP) ## make .venv, the only step before any `.venv/bin/nerd ...`

dev: $(STAMP) ## and what some tests alone need: Ray, W&B, skrl; and pre-commit
	$(PIP) -c $(CONSTRAINTS) -e ".[dev]"

# PyTorch goes first, so that nothing else chooses its build. dm_control goes last and
# alone: from Python 3.13 on one package that it names, but the suite does not use, has
# no wheel (see pyproject.toml); before that it is there already.
$(STAMP):
	@$(PYTHON) -c 'import sys; v = sys.version_info[:2]; sys.exit(v < (3, 11) and "Python >= 3.11 is needed, but $(PYTHON) is %d.%d: name another one, as in make PYTHON=python3.12" % v)'
	@$(PY) -m pip --version >/dev/null 2>&1 || $(PYTHON) -m venv --clear $(VENV)
	@echo "Installing into $(VENV): minutes the first time, nothing the second"
	$(PIP) "$(TORCH)" $(if $(TORCH_INDEX),--extra-index-url "$(TORCH_INDEX)")
	$(PIP) -c $(CONSTRAINTS) -e ".[lint,test]"
	$(PIP) --no-deps "$(DM_CONTROL)"
	@rm -f $(VENV)/.installed-* && touch $@

# Threads that soon fall asleep: on a loaded machine the longer wait of GNU's OpenMP takes
# up to thirty times as long, see docs/howto/machine.md.
demo: $(STAMP) ## learn a swing-up in learned dynamics, check it in MuJoCo
	GOMP_SPINCOUNT=$${GOMP_SPINCOUNT:-1000} $(PY) examples/ppo.py

test: check ## lint, types and the test suite
	$(PYTEST) -n $(WORKERS) --dist worksteal $(ARGS)

check: $(STAMP) ## lint, format, types, imports, docstrings and words
	$(PY) -m ruff check .
	$(PY) -m ruff format --check .
	$(PY) -m basedpyright
	$(PY) tests/tools/check_source.py
	$(PY) tests/tools/check_words.py

size: $(STAMP) ## lines and comments of the package, and files that are too long
	$(PY) tests/tools/size.py

words: $(STAMP) ## words that the glossary replaced, by word and by file
	$(PY) tests/tools/check_words.py $(ARGS)

test-slow: $(STAMP) ## the tests that take minutes and all products of parameters, on random inputs
	$(PYTEST) -m "slow and not gpu" --seed random $(ARGS)

test-gpu: $(STAMP) ## the tests that need a CUDA device
	$(PYTEST) -m gpu $(ARGS)

gpu: ## all that needs a GPU, in order of worth, to results/gpu/; docs/howto/gpu.md
	PYTHONPATH=.:benchmarks $(GPU_PY) -m gpu $(ARGS)

gpu-wheels: ## download to DIR the wheels that a machine with torch and JAX lacks
	PYTHONPATH=.:benchmarks $(GPU_PY) -m gpu --wheels $(or $(DIR),$(error name the folder, as in make gpu-wheels DIR=wheels))

bench-check: $(STAMP) ## whether anything got slower, against a baseline of ratios
	$(PY) benchmarks/bench_check.py $(ARGS)

# What README and the site show. Hours on two idle cores: `make results ROBOTS=cartpole`
# measures one robot, SIZE="--num-trajectories 256" fewer trajectories.
ROBOTS := cartpole double_pendulum ant anymal franka franka_gravity cube cube_slope cube_real
SIZE :=

results: $(STAMP) ## errors and rates of every dynamics of every robot, to results/
	for robot in $(ROBOTS); do \
		$(NERD) eval $$robot $(SIZE) --quiet --json results/eval_$$robot.json || exit 1; \
		$(NERD) bench $$robot --quiet --json results/bench_$$robot.json || exit 1; \
	done

# Models that take more than `nerd train SCENE`.
PRETRAINED := torchrl_nerd/pretrained

ADAPTIVE := --vary preset --network adaptive-4x64 --single-step-fraction 0 \
	--rollout-history 20 --threads 1
SHORT = --data datasets/$*_varied --sequence-length 64 --batch-size 32

LAST_ROLLOUTS := 300
varied-double_pendulum: LAST_ROLLOUTS := 100

varied-cartpole varied-double_pendulum: varied-%: $(STAMP)
	$(NERD) data $* --vary preset --trajectories 7000 --steps 200 --out datasets/$*_varied
	$(NERD) train $* $(ADAPTIVE) $(SHORT) --steps 6000 --rollout-steps 500 \
		--rollout-length 10 --rollout-batch-size 64 --validate-every 7000 --out runs/$*_varied
	$(NERD) train $* $(ADAPTIVE) $(SHORT) --init-from runs/$*_varied/last \
		--steps 3500 --lr 0.005 --adamw-lr 0.0015 --rollout-steps 700 --rollout-length 20 \
		--rollout-batch-size 48 --validate-every 9000 --save-every 250 --out runs/$*_second
	$(NERD) train $* $(ADAPTIVE) $(SHORT) --init-from runs/$*_second/last \
		--steps 3000 --lr 0.004 --adamw-lr 0.0012 --rollout-steps $(LAST_ROLLOUTS) \
		--rollout-length 40 --rollout-batch-size 128 --validate-every 9000 --save-every 100 \
		--out runs/$*_third

LONG := --sequence-length 160 --batch-size 12 --validate-every 9000

# At last robots that change within a trajectory: single steps, then rollouts as well.
define LEARN_CHANGES
	$(NERD) data $(1) --vary preset --strategy changing --trajectories 7000 --steps 200 --seed 3 \
		--out datasets/$(1)_changing
	$(NERD) train $(1) $(ADAPTIVE) $(LONG) --data datasets/$(1)_changing \
		--init-from runs/$(1)_$(2)/last --steps 3000 --lr 0.004 --adamw-lr 0.0012 \
		--rollout-steps 0 --save-every 250 --out runs/$(1)_changing
endef

define LEARN_ROLLOUTS
	$(NERD) train $(1) $(ADAPTIVE) $(LONG) --data datasets/$(1)_changing \
		--init-from runs/$(1)_changing/last --steps $(2) --lr 0.004 --adamw-lr 0.0012 \
		--rollout-steps $(3) --rollout-length 40 --rollout-batch-size 128 \
		--save-every 50 --out runs/$(1)_adaptive
endef

SHIP_ADAPTIVE = mkdir -p $(PRETRAINED)/$(1)-adaptive && cp runs/$(1)_adaptive/last/* $(PRETRAINED)/$(1)-adaptive/

model-double_pendulum-adaptive: varied-double_pendulum ## pendulums that find their hidden parameters
	$(call LEARN_CHANGES,double_pendulum,third)
	$(call LEARN_ROLLOUTS,double_pendulum,2000,200)
	$(call SHIP_ADAPTIVE,double_pendulum)

model-cartpole-adaptive: varied-cartpole ## the same for Cartpoles, whose sequences grow earlier
	$(NERD) train cartpole $(ADAPTIVE) $(LONG) --data datasets/cartpole_varied \
		--init-from runs/cartpole_third/last --steps 2000 --lr 0.003 --adamw-lr 0.001 \
		--rollout-steps 0 --save-every 100 --out runs/cartpole_long
	$(call LEARN_CHANGES,cartpole,long)
	$(call LEARN_ROLLOUTS,cartpole,1000,250)
	$(call SHIP_ADAPTIVE,cartpole)

# Adaptive models that begin as the shipped transformer of one robot, with a longer band.
BEGUN := --vary preset --network transformer-4x128@64 --single-step-fraction 0 \
	--sequence-length 64 --batch-size 32 --rollout-history 20 --rollout-lr-ratio 0.25 \
	--validate-every 9000 --threads 1
FEW_ROLLOUTS := --steps 5000 --rollout-steps 400 --rollout-length 10 --rollout-batch-size 64 \
	--save-every 250

model-ant-adaptive: $(STAMP) ## Ants that find their hidden parameters
	$(NERD) data ant --vary preset --trajectories 7000 --steps 200 --out datasets/ant_varied
	$(NERD) train ant $(BEGUN) $(FEW_ROLLOUTS) --data datasets/ant_varied --init-from ant \
		--network transformer-4x128-products@64 --symmetries 4 --lr 0.006 --adamw-lr 0.0018 \
		--out runs/ant_adaptive
	$(call SHIP_ADAPTIVE,ant)

model-anymal-adaptive: anymal-wide ## ANYmals that find their hidden parameters
	$(NERD) data anymal --vary preset --trajectories 7000 --steps 200 --out datasets/anymal_varied
	$(NERD) train anymal $(BEGUN) $(FEW_ROLLOUTS) --data datasets/anymal_varied --init-from runs/anymal_wide/last \
		--lr 0.006 --adamw-lr 0.0018 --save-every 100 --out runs/anymal_adaptive
	$(call SHIP_ADAPTIVE,anymal)

FRANKA := --data datasets/franka_varied --lr 0.004 --adamw-lr 0.0012 --bf16-fraction 0.7

model-franka-adaptive: model-franka ## Frankas that find their hidden parameters
	$(NERD) data franka --vary preset --trajectories 7000 --steps 200 --out datasets/franka_varied
	$(NERD) train franka $(BEGUN) $(FEW_ROLLOUTS) $(FRANKA) --init-from runs/franka_on/best --out runs/franka_varied
	$(NERD) train franka $(BEGUN) $(FRANKA) --init-from runs/franka_varied/last --steps 6000 \
		--rollout-steps 300 --rollout-length 20 --rollout-batch-size 48 --save-every 100 \
		--out runs/franka_adaptive
	$(call SHIP_ADAPTIVE,franka)

# The Ant's networks: single steps and rollouts, then both again with more data. Between them
# policies learn in the MLP, and both networks learn from how these move in MuJoCo.
ANT_DATA := datasets/ant datasets/ant_run datasets/ant_spin datasets/ant_correlated datasets/ant_resting
ANT_LEARNED := $(ANT_DATA) datasets/ant_run_more datasets/ant_learned
ANT := --symmetries 4 --validate-every 4000 --save-every 500 --threads 1
TRANSFORMER := --network transformer-4x128-products --single-step-fraction 0.85
MLP := --network mlp-4x128-products --single-step-fraction 1
FIRST := --data $(ANT_DATA) --rollout-lr-ratio 0.25
AGAIN := --data $(ANT_LEARNED) --lr 0.006 --adamw-lr 0.0018 --rollout-lr-ratio 0.4
IN_THE_MLP := $(PY) experiments/time_to_policy.py --wanted 0 --frames 5000000 --horizon 16 \
	--minibatch 8192 --lr 1e-3 --dynamics runs/ant_mlp_first/best --episodes 64

data-ant: $(STAMP)
	$(NERD) data ant --trajectories 10000 --seed 21 --out datasets/ant
	$(NERD) data ant --policy torchrl_nerd/policies/ant-run --trajectories 3000 --seed 31 \
		--out datasets/ant_run
	$(NERD) data ant --policy torchrl_nerd/policies/ant-spin --trajectories 3000 --seed 41 \
		--out datasets/ant_spin
	$(NERD) data ant --policy torchrl_nerd/policies/ant-run --trajectories 3000 --seed 51 \
		--out datasets/ant_run_more
	$(NERD) data ant --strategy correlated --trajectories 6000 --seed 81 --out datasets/ant_correlated
	$(NERD) data ant --strategy resting --trajectories 9000 --seed 71 --out datasets/ant_resting

data-ant-learned: data-ant
	$(NERD) train ant $(ANT) $(FIRST) $(MLP) \
		--steps 24000 --rollout-steps 4000 --out runs/ant_mlp_first
	for seed in 11 12; do \
		$(IN_THE_MLP) ant/run --seed $$seed --out runs/learned_$$seed || exit 1; \
	done
	$(IN_THE_MLP) ant/spin --seed 11 --out runs/learned_11
	$(NERD) data ant --policy runs/learned_*/ant-*/*/[0-9]* \
		--trajectories 2200 --steps 500 --seed 61 --out datasets/ant_learned

model-ant-mlp: data-ant-learned ## the Ant's MLP, with the mirrors of the Ant built in
	$(NERD) train ant $(ANT) $(AGAIN) $(MLP) \
		--init-from runs/ant_mlp_first/best --steps 10000 --rollout-steps 4500 --out runs/ant_mlp_second
	cp runs/ant_mlp_second/best/* $(PRETRAINED)/ant-mlp/

model-ant: data-ant-learned ## the Ant's transformer, with the same mirrors
	$(NERD) train ant $(ANT) $(FIRST) $(TRANSFORMER) \
		--steps 15000 --rollout-steps 3000 --out runs/ant_first
	$(NERD) train ant $(ANT) $(AGAIN) $(TRANSFORMER) \
		--init-from runs/ant_first/best --steps 8000 --rollout-steps 3500 --out runs/ant_second
	cp runs/ant_second/best/* $(PRETRAINED)/ant/

# Transformers that learned single steps on a GPU, in minutes: make model-franka DEVICE=cuda.
# On two cores the same takes a day. The second stage is short and runs anywhere.
DEVICE := cpu
WIDE := --network transformer-4x128 --batch-size 512 --single-step-fraction 0.85 \
	--rollout-steps 0 --warmup 300 --validate-every 2000 --device $(DEVICE)
SECOND := --network transformer-4x128 --lr 0.005 --adamw-lr 0.0015 --rollout-restarts 1 \
	--save-every 200 --threads 1

model-cube: $(STAMP) ## the cube's transformer: single steps; rollouts did not help
	$(NERD) data cube --trajectories 8000 --seed 1 --out datasets/cube_wide
	$(NERD) train cube --data datasets/cube_wide $(WIDE) --predicted-force --steps 7400 \
		--bf16-fraction 0.7 --loss-eps 0.02 --out runs/cube_wide
	cp runs/cube_wide/last/* $(PRETRAINED)/cube/

data-franka: $(STAMP)
	$(NERD) data franka --trajectories 20000 --seed 1 --out datasets/franka_wide
	$(NERD) data franka --policy torchrl_nerd/policies/franka-reach --noise 0.3 \
		--trajectories 3000 --seed 11 --out datasets/franka_reach
	$(NERD) data franka --policy torchrl_nerd/policies/franka-reach_osc --noise 0.3 \
		--trajectories 3000 --seed 11 --out datasets/franka_reach_osc

model-franka: data-franka ## Franka's transformer: single steps, then data along two policies
	$(NERD) train franka --data datasets/franka_wide $(WIDE) --steps 16900 \
		--bf16-fraction 0 --out runs/franka_wide
	$(NERD) data franka --trajectories 10000 --seed 1 --out datasets/franka_on
	$(NERD) train franka --init-from runs/franka_wide/last $(SECOND) --out runs/franka_on \
		--data datasets/franka_on datasets/franka_reach datasets/franka_reach_osc \
		--single-step-fraction 0.85 --bf16-fraction 0 --steps 6000 --rollout-steps 1000 \
		--lr 0.0015 --adamw-lr 0.0005 --rollout-lr-ratio 0.15 --validate-every 2000
	$(NERD) train franka --init-from runs/franka_on/best --out runs/franka_third \
		--network transformer-4x128-products \
		--data datasets/franka_wide datasets/franka_reach datasets/franka_reach_osc \
		--batch-size 128 --single-step-fraction 0.85 --bf16-fraction 0 --steps 9000 \
		--rollout-steps 1500 --lr 0.004 --adamw-lr 0.0012 --rollout-lr-ratio 0.15 \
		--validate-every 3000 --save-every 500 --threads 1
	cp runs/franka_third/best/* $(PRETRAINED)/franka/

model-franka-mlp: data-franka ## Franka's MLP, with products: the same data, the policies' in a second stage
	$(NERD) train franka --data datasets/franka_wide --threads 1 --out runs/franka_mlp_first
	$(NERD) train franka --init-from runs/franka_mlp_first/last --out runs/franka_mlp_second \
		--data datasets/franka_wide datasets/franka_reach datasets/franka_reach_osc \
		--lr 0.006 --adamw-lr 0.0018 --rollout-steps 1500 --rollout-lr-ratio 0.15 \
		--validate-every 1500 --save-every 250 --threads 1
	cp runs/franka_mlp_second/best/* $(PRETRAINED)/franka-mlp/

# ANYmal's networks: single steps and rollouts, then both again with more data, as the Ant's.
# The robot is nearly symmetric: left and right, fore and hind.
ANYMAL := --symmetries 4 --near-symmetry --validate-every 4000 --save-every 500 --threads 1
ANYMAL_DATA := datasets/anymal datasets/anymal_more
IN_ANYMAL := $(PY) experiments/time_to_policy.py --wanted 0 --frames 5000000 --horizon 16 \
	--minibatch 8192 --lr 1e-3 --dynamics runs/anymal_mlp_first/best --episodes 64 \
	--seed 11 --out runs/anymal_learned_11

data-anymal: $(STAMP)
	$(NERD) data anymal --trajectories 10000 --seed 21 --out datasets/anymal
	$(NERD) data anymal --trajectories 10000 --seed 81 --out datasets/anymal_more

data-anymal-learned: data-anymal
	$(NERD) train anymal $(ANYMAL) --data $(ANYMAL_DATA) --rollout-lr-ratio 0.25 $(MLP) \
		--steps 12000 --rollout-steps 2000 --out runs/anymal_mlp_first
	$(IN_ANYMAL) anymal/forward
	$(IN_ANYMAL) anymal/sideways
	$(NERD) data anymal --policy runs/anymal_learned_*/anymal-*/*/[0-9]* \
		--trajectories 1500 --steps 500 --seed 61 --out datasets/anymal_learned

model-anymal-mlp: data-anymal-learned ## ANYmal's MLP: two stages, the second with data along policies
	$(NERD) train anymal $(ANYMAL) --data $(ANYMAL_DATA) datasets/anymal_learned \
		--lr 0.006 --adamw-lr 0.0018 --rollout-lr-ratio 0.4 $(MLP) \
		--init-from runs/anymal_mlp_first/best --steps 5000 --rollout-steps 2000 --out runs/anymal_mlp_second
	cp runs/anymal_mlp_second/best/* $(PRETRAINED)/anymal-mlp/

model-anymal: data-anymal-learned ## ANYmal's transformer, with the same data
	$(NERD) train anymal $(ANYMAL) --data $(ANYMAL_DATA) --rollout-lr-ratio 0.15 $(TRANSFORMER) \
		--steps 12000 --rollout-steps 1000 --out runs/anymal_first
	$(NERD) train anymal $(ANYMAL) --data $(ANYMAL_DATA) datasets/anymal_learned \
		--lr 0.005 --adamw-lr 0.0015 --rollout-lr-ratio 0.3 $(TRANSFORMER) \
		--init-from runs/anymal_first/best --steps 5000 --rollout-steps 1500 --out runs/anymal_second
	cp runs/anymal_second/last/* $(PRETRAINED)/anymal/

anymal-wide: $(STAMP)
	$(NERD) data anymal --trajectories 20000 --seed 1 --out datasets/anymal_wide
	$(NERD) train anymal --data datasets/anymal_wide $(WIDE) --predicted-force --steps 10500 \
		--bf16-fraction 0.7 --out runs/anymal_wide

PENDULUM := --network transformer-2x96 --predicted-force --unconstrained-motion --loss-eps 1.0

model-double_pendulum: $(STAMP) ## the double pendulum's transformer: single steps, then rollouts
	$(NERD) data double_pendulum --trajectories 40000 --seed 1 --out datasets/pendulum_wide
	$(NERD) train double_pendulum --data datasets/pendulum_wide $(WIDE) $(PENDULUM) \
		--single-step-fraction 0.75 --bf16-fraction 0.5 --steps 28100 \
		--out runs/pendulum_wide
	$(NERD) data double_pendulum --trajectories 60000 --out datasets/pendulum_on
	$(NERD) train double_pendulum --init-from runs/pendulum_wide/last $(SECOND) $(PENDULUM) \
		--data datasets/pendulum_on --lr 0.004 --adamw-lr 0.0012 --steps 0 \
		--rollout-steps 2000 --rollout-lr-ratio 0.06 --validate-every 500 --out runs/pendulum_on
	$(NERD) train double_pendulum --init-from runs/pendulum_on/best $(PENDULUM) \
		--data datasets/pendulum_on --lr 0.004 --adamw-lr 0.0012 --single-step-fraction 0.75 \
		--steps 10000 --rollout-steps 2500 --rollout-lr-ratio 0.15 --validate-every 2500 \
		--threads 1 --out runs/pendulum_third
	cp runs/pendulum_third/best/* $(PRETRAINED)/double_pendulum/

PENDULUM_MLP := --network mlp-4x120 --predicted-force --unconstrained-motion \
	--single-step-fraction 1.0 --loss-eps 1.0 --bf16-fraction 0.9 --validate-every 6000

model-double_pendulum-mlp: $(STAMP) ## the double pendulum's MLP: two stages
	$(NERD) data double_pendulum --trajectories 150000 --out datasets/double_pendulum_mlp
	$(NERD) train double_pendulum --data datasets/double_pendulum_mlp $(PENDULUM_MLP) \
		--steps 90000 --rollout-steps 4000 --rollout-lr-ratio 0.03 --out runs/double_pendulum_mlp
	$(NERD) train double_pendulum --init-from runs/double_pendulum_mlp/best \
		--data datasets/double_pendulum_mlp $(PENDULUM_MLP) --steps 24000 \
		--rollout-steps 3000 --lr 0.004 --adamw-lr 0.0012 --rollout-lr-ratio 0.08 \
		--out runs/double_pendulum_on
	cp runs/double_pendulum_on/best/* $(PRETRAINED)/double_pendulum-mlp/

# Policies, learned without MuJoCo. Those of ant/run and of Franka learned in the first
# edition's hybrids, whose place the analytic steps have taken.
POLICIES := torchrl_nerd/policies
PPO := OMP_NUM_THREADS=1 $(PY) examples/ppo.py
BY_GRADIENTS := OMP_NUM_THREADS=1 $(PY) examples/first_order.py --compile \
	--num-envs 256 --window 64 --lr 1e-3 --evaluate-every 40 --episodes 2048
SHIP_POLICY = mkdir -p $(POLICIES)/$* && cp runs/$@/policy.* $(POLICIES)/$*/
LEGGED := $(addprefix policy-,ant-run ant-spin ant-spin_track anymal-forward anymal-sideways)
FRAMES := 8000000

policies: policy-cartpole-swingup $(LEGGED) policy-franka-reach policy-franka-reach_osc policy-franka-reach_torque ## a policy for every task with a goal, hours on one core

policy-cartpole-swingup: policy-%: $(STAMP)
	$(PPO) --total-frames 6000000 --out runs/$@
	$(SHIP_POLICY)

policy-ant-spin_track: FRAMES := 24000000
$(LEGGED): policy-%: $(STAMP)
	$(PPO) --task $(subst -,/,$*) --dynamics analytic --compile --horizon 16 --minibatch 8192 --lr 1e-3 \
		--total-frames $(FRAMES) --evaluate-every 1000 --episodes 256 --out runs/$@
	$(SHIP_POLICY)

policy-franka-reach: policy-%: $(STAMP)
	$(PPO) --task franka/reach --dynamics analytic --compile --seed 1 --out runs/$@-ppo
	$(BY_GRADIENTS) --task franka/reach --dynamics analytic --start runs/$@-ppo --updates 850 --seed 1 --out runs/$@-on
	$(BY_GRADIENTS) --task franka/reach --dynamics analytic --start runs/$@-on --updates 340 --seed 1 --out runs/$@
	$(SHIP_POLICY)

policy-franka-reach_osc: policy-%: $(STAMP)
	$(PPO) --task franka/reach_osc --compile --out runs/$@
	$(SHIP_POLICY)

policy-franka-reach_torque: policy-%: $(STAMP)
	$(PPO) --task franka/reach_torque --dynamics analytic --compile --seed 1 --out runs/$@-ppo
	$(BY_GRADIENTS) --task franka/reach_torque --dynamics analytic --start runs/$@-ppo --updates 3200 --seed 1 --out runs/$@
	$(SHIP_POLICY)

format: $(STAMP) ## repair what ruff can repair
	$(PY) -m ruff check --fix .
	$(PY) -m ruff format .

docs: $(STAMP) ## the documentation site in site/, where a warning is an error
	@$(PY) -c 'import mkdocs, material, mkdocstrings' 2>/dev/null || $(PIP) -c $(CONSTRAINTS) -e ".[docs]"
	NO_MKDOCS_2_WARNING=1 $(PY) -m mkdocs build --strict -q

build: $(STAMP) ## wheel and source archive in dist/
	$(PY) -m hatchling build

lock: ## write the newest versions that pyproject.toml allows to constraints.txt
	rm -rf $(VENV)
	$(MAKE) dev docs CONSTRAINTS=/dev/null
	echo "# The versions that make installs; written by make lock." > constraints.txt
	$(PY) -m pip freeze -qq --exclude-editable | sed 's/+.*//' >> constraints.txt

clean: ## remove .venv, caches and built files; runs/ and datasets/ stay
	rm -rf $(VENV) build dist site .pytest_cache .ruff_cache MUJOCO_LOG.TXT
	find . -name __pycache__ -type d -prune -exec rm -rf {} +
