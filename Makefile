# The two commands of a fresh machine: `make run` and `make test`. Everything lives in .venv/, artifacts/ and mlflow.db.
PYTHON ?= python3
BIN := .venv/bin
PIP := $(BIN)/pip --disable-pip-version-check install --quiet --no-compile
export DVC_NO_ANALYTICS := true
export MLFLOW_DISABLE_TELEMETRY := true
export OMP_NUM_THREADS := 1
unexport PYTHONDONTWRITEBYTECODE  # pip compiles nothing: each module is compiled once, when it is first imported

.PHONY: help setup run test end-to-end claims services benchmark lint docs paper audit ui data notebooks dependencies lock queue fuzz kill demo faults

help:
	@echo "make run        set up, pull the recordings, run the whole pipeline, show the results"
	@echo "make test       set up, run the tests"
	@echo "make end-to-end  test whole ways: the pipeline in DVC, plug-ins, sweeps in many processes, what goes on after a kill"
	@echo "make claims     test what is stated: of the diagnosis and its rivals on many drawn sessions, and in the notebooks"
	@echo "make services   test what others run: sweeps and studies on a Ray cluster, models and recordings in a bucket"
	@echo "make lint       set up, check style and types"
	@echo "make paper      what the documentation shows of models and the paper's tables, and of hidden effects what is not frozen: hours"
	@echo "make docs       set up, build the documentation into site/ and check its links"
	@echo "make audit      a bill of all packages in the environment, and which of them are known to be vulnerable"
	@echo "make demo       five emulated robots, their camera and a broker; a policy drives them, a film is left"
	@echo "make ui         open the MLflow UI on http://127.0.0.1:5000"
	@echo "make benchmark  speed and memory, as figures and ratios"
	@echo "make data       drive the stand-in robots again: the recordings in data/, anew"
	@echo "make dependencies  write into dvc.yaml what its stages are, after they have changed"
	@echo "make notebooks  run the notebooks and store what they show in them"
	@echo "make fuzz, kill, faults  campaigns: damaged files; commands that die at random moments; deployments with faults"
	@echo "make lock       pin the environment as it is installed now in constraints.txt"

setup: .venv/installed

.venv/installed: pyproject.toml constraints.txt
	$(PYTHON) -m venv .venv
	$(PIP) --constraint constraints.txt torch==2.13.0
	$(PIP) --constraint constraints.txt --editable '.[dev]'
	@touch $@

PROMOTE := $(BIN)/swarmtwin promote
run: setup  # beside a process that has imported what the stages need (src/swarmtwin/commands/preloaded.py)
	$(BIN)/dvc pull --quiet data
	@folder=$$(mktemp -d); $(BIN)/python -m swarmtwin.commands.preloaded $$folder/address & \
	  trap "kill $$!; rm -r $$folder" EXIT; SWARMTWIN_PRELOADED=$$folder/address $(MAKE) --no-print-directory results

results:  # a refused promotion (exit status 3) is an answer, not a failure
	-LOKY_MAX_CPU_COUNT=1 $(MAKE) --no-print-directory --jobs=2 parts
	$(BIN)/dvc repro
	$(MAKE) --no-print-directory --jobs=2 --output-sync=target promotions
	$(BIN)/swarmtwin experiment name=overview

PROMOTIONS := $(addprefix promote@,mgr/collective mur/pair mgr mur)
promotions: $(PROMOTIONS)
$(PROMOTIONS): promote@%:
	$(PROMOTE) robot=$(firstword $(subst /, ,$*)) $(if $(findstring /,$*),what=policy candidate=artifacts/policies/$*,\
	  candidate=artifacts/comparison/$*/best) || [ $$? = 3 ]

# The stages of dvc.yaml in parts, two at a time on two cores, the longest way first: make takes the first part in the
# list that can begin, so that what does not lead to policies waits for both simulations, which policies are learned in,
# and the underwater robot, which takes longer, comes first.
# DVC looks at a part's own stages alone (--single-item), so the parts that it reads are named here; the `dvc repro`
# afterwards looks at all of them.
ROBOTS := mgr mur
of_robots = $(ROBOTS:%=$(1)@%)
SIMULATIONS := $(call of_robots,simulation)
PARTS := $(call of_robots,policies) dynamics@mur study@mur dynamics@mgr study@mgr diagnosis@mgr \
  $(call of_robots,pictures) $(SIMULATIONS) $(call of_robots,transitions) $(call of_robots,code)
parts: $(PARTS)
$(call of_robots,transitions): transitions@%: code@%
$(SIMULATIONS): simulation@%: transitions@%
$(call of_robots,policies): policies@%: simulation@%
$(call of_robots,dynamics): dynamics@%: simulation@% | $(SIMULATIONS)
$(call of_robots,study): study@%: dynamics@%
diagnosis@mgr: code@mgr | $(SIMULATIONS)
$(call of_robots,pictures): pictures@%: policies@% study@%

robot = $(lastword $(subst @, ,$@))
$(call of_robots,code): STAGES = code@$(robot)
of_clip@mgr = tracked@mgr
$(call of_robots,transitions): STAGES = $(of_clip@$(robot)) transitions@$(robot) synthetic@$(robot)-*
$(SIMULATIONS): STAGES = synthetic_dynamics@$(robot)
$(call of_robots,study): STAGES = real_and_synthetic@$(robot)
policies@mgr: STAGES = policies@collective policies@obstacle transfer@mgr
policies@mur: STAGES = policies@pair transfer@mur
$(call of_robots,dynamics): STAGES = dynamics@$(robot)-* comparison@$(robot)
diagnosis@mgr: STAGES = diagnosis@mgr report@mgr
$(call of_robots,pictures): STAGES = tables@$(robot) pictures@$(robot)-*
.PHONY: results parts promotions $(PARTS) $(PROMOTIONS)
$(PARTS):  # DVC looks after a folder, or its own files, once at a time: who finds them busy tries again
	@bash -o pipefail -c 'for try in 1 2 3 4 5; do \
	  $(BIN)/dvc repro --single-item --glob $(STAGES:%="%") 2>&1 \
	    | tee .$@.partial | sed -u "s/^/$@: /"; status=$$?; \
	  grep -Eq "Unable to acquire lock|is busy" .$@.partial || break; sleep 5; done; rm -f .$@.partial; exit $$status'

queue: setup  # experiments queued by `dvc exp run --queue`, JOBS at a time; DVC's workers look for it on the path
	PATH="$(CURDIR)/$(BIN):$$PATH" dvc queue start --jobs $(or $(JOBS),1)

fuzz: setup  # damaged files by the thousand; goes on where it was broken off
	$(BIN)/python tests/campaigns/fuzz.py --count $(or $(COUNT),10000) --seed $(or $(SEED),1) --state outputs/fuzz.jsonl

kill: setup  # commands that die at random moments, and are called again; likewise
	$(BIN)/python tests/campaigns/kill.py --count $(or $(COUNT),200) --seed $(or $(SEED),1) --state outputs/kill.jsonl

# What the documentation shows: of the pipeline its tables, and all that the pipelines in docs/results computed.
DOCUMENTED := tables docs/results/dvc.yaml docs/results/creates/dvc.yaml

PYTEST := $(BIN)/pytest -n 3 --dist worksteal
test: setup
	$(BIN)/dvc pull --quiet data $(DOCUMENTED)
	$(PYTEST) -m "not benchmark_figures and not claims and not services and not end_to_end" tests

end-to-end: setup
	$(BIN)/dvc pull --quiet data
	$(PYTEST) -m end_to_end tests

claims: setup
	$(BIN)/dvc pull --quiet data
	$(BIN)/pytest -n 2 --nbmake notebooks
	$(BIN)/pytest -n 2 --dist worksteal -rs -m claims tests

services: .venv/services  # a study on a Ray cluster, models and recordings in a bucket: both are started here
	$(BIN)/pytest -m services tests

.venv/services: .venv/installed
	$(PIP) --constraint constraints.txt --editable '.[services]'
	@touch $@

audit: setup  # what the environment is made of, as a CycloneDX bill, and what is known to be vulnerable in it
	.ci/audit $(BIN)/python artifacts/audit

benchmark: setup
	$(BIN)/pytest -m benchmark_figures -s tests/benchmarks

lint: setup
	$(BIN)/ruff check
	$(BIN)/ruff format --check
	$(BIN)/mypy

paper: setup .venv/services  # what was broken off goes on
	$(BIN)/dvc repro docs/results/dvc.yaml

docs: .venv/docs  # a link, a section or a file that is not there is an error
	$(BIN)/dvc pull --quiet $(DOCUMENTED)
	NO_MKDOCS_2_WARNING=1 $(BIN)/mkdocs build --strict --quiet
	@echo "documentation: site/index.html"

.venv/docs: .venv/installed
	$(PIP) --constraint constraints.txt --editable '.[docs]'
	@touch $@

ui: setup
	$(BIN)/mlflow ui --backend-store-uri $${MLFLOW_TRACKING_URI:-sqlite:///mlflow.db} --host 127.0.0.1 --port 5000

RECORD := $(BIN)/swarmtwin record format=one_file
data: setup  # what the paper had, and a later session of the ground robot that is not like the first
	rm -rf data && mkdir data
	$(RECORD) robot=mgr vehicle=1 transitions=55068 steps=120 seed=1 output=data/mgr/reference
	$(RECORD) robot=mgr vehicle=2 transitions=5874 steps=89 seed=2 output=data/mgr/other_vehicle
	$(RECORD) robot=mgr vehicle=1 runs=20 steps=60 seed=3 output=data/mgr/open_loop
	$(RECORD) robot=mgr vehicle=1 runs=150 steps=40 seed=4 'effects=[{name: battery_sag, loss: 0.3}]' output=data/mgr/later_session
	$(RECORD) robot=mgr 'vehicle=[1,2,3]' runs=1 steps=60 film=10 seed=8 output=data/mgr/clip
	$(BIN)/swarmtwin calibrate robot=mgr camera=data/mgr/clip/video.mp4 camera_height_mm=2000 output=data/mgr/clip/calibration.yaml
	rm data/mgr/clip/calibration.png
	$(RECORD) robot=mur vehicle=1 transitions=15000 steps=75 seed=5 output=data/mur/reference
	$(RECORD) robot=mur vehicle=2 transitions=1372 steps=49 seed=6 output=data/mur/other_vehicle
	$(RECORD) robot=mur vehicle=1 runs=20 steps=60 seed=7 output=data/mur/open_loop
	$(BIN)/dvc add --quiet data && $(BIN)/dvc push --quiet data

notebooks: setup
	$(BIN)/dvc pull --quiet data
	$(BIN)/pytest --nbmake --overwrite notebooks

dependencies: setup
	$(BIN)/python -m swarmtwin.tracking.pipeline

lock: setup
	$(BIN)/pip freeze --exclude-editable | sed 's/+cpu$$//' > constraints.txt

DEMO := artifacts/demo
DEMO_POLICY = $(firstword $(wildcard artifacts/policies/mgr/collective) src/swarmtwin/deploy/bundled/policy)
DEMO_SIMULATION = $(firstword $(wildcard artifacts/dynamics/mgr/crnet_synthetic) src/swarmtwin/deploy/bundled/simulation)
demo: setup  # broker, five emulated robots and their camera; a policy drives them to their target; a film is left
	@$(BIN)/swarmtwin fleet robot=mgr vehicles=5 broker=embedded://127.0.0.1:18883 camera_port=18090 duration_s=200 & fleet=$$!; \
	trap 'kill -TERM $$fleet 2>/dev/null; wait $$fleet' EXIT; \
	for try in $$(seq 120); do \
	  $(BIN)/python -c 'from urllib.request import urlopen; urlopen("http://127.0.0.1:18090/", timeout=1)' 2>/dev/null && break; \
	  kill -0 $$fleet 2>/dev/null || exit 1; sleep 0.5; done; \
	$(BIN)/swarmtwin deploy robot=mgr policy=$(DEMO_POLICY) simulation=$(DEMO_SIMULATION) broker=mqtt://127.0.0.1:18883 \
	  camera=http://127.0.0.1:18090/camera video=true output=$(DEMO) overwrite=true && \
	echo "film: $(DEMO)/deployment.mp4"

faults: setup  # faults brought into running deployments, on a real mosquitto (apt install mosquitto); likewise
	$(BIN)/python tests/campaigns/faults.py --count $(or $(COUNT),1000) --seed $(or $(SEED),1) --state outputs/faults.jsonl
