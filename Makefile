# Everything a newcomer types. `make` alone lists the targets.
PYTHON ?= python3
BIN := .venv/bin
VMCAN ?= ../shared/tools/vmcan.sh
PLAYS := .venv/plays
PACKAGES := .venv/packages
STAMP := .venv/installed
MODEL := tests/gemuco tests/house
CLOCKLESS := $(addprefix tests/hal/test_,campaign.py fuzz.py object_tables.py safety_limits.py safety_motion.py safety_numbers.py emergency_numbers.py) \
  $(addprefix tests/services/test_,acquaintance.py collector.py describe.py inspect.py lerobot.py measured.py message_logs.py recording_dataset.py \
    recording_schema.py trainer.py trust_loop.py update_loop.py view_state.py) \
  $(addprefix tests/simulators/test_,bullet.py drafted_robot.py eds.py kxr_world.py mjcf.py musashi_geometry.py musashi_motion.py physics.py \
    pr2_world.py urdf_arm.py world.py) \
  $(addprefix tests/studies/test_,kxr.py musashi.py paper.py peers.py pr2.py) tests/system/test_kills.py
SOCKETCAN := $(addprefix tests/system/test_socketcan,.py _bus.py _drivers.py _states.py)

# Tests that need no clock run beside the others, at the lowest priority and so with more time, and are printed at the end. Each program computes
# in one thread: threads of linear algebra wait for each other on two busy cores (the model's tests: 341 s in place of 215).
BESIDE := nice -n 19 $(BIN)/python -m pytest -p no:cacheprovider --timeout=600
define RUN_TESTS
@mkdir -p build; export OPENBLAS_NUM_THREADS=1 OMP_NUM_THREADS=1; \
$(BESIDE) $(TESTS) $(MODEL) >build/model.log 2>&1 & model=$$!; \
$(BESIDE) $(TESTS) $(CLOCKLESS) >build/clockless.log 2>&1 & clockless=$$!; \
trap 'kill $$model $$clockless; exit 130' INT TERM; \
$(BIN)/python -m pytest $(TESTS) $(addprefix --ignore=,$(MODEL) $(CLOCKLESS)); failed=$$?; \
wait $$model || failed=1; wait $$clockless || failed=1; cat build/model.log build/clockless.log; exit $$failed
endef

.DEFAULT_GOAL := help
.PHONY: help setup demo reproduce test test-ci test-all check format faults fuzz mutation peers bench test-socketcan test-controllers results clean test-compose wheel wheels lock test-network test-ros2 test-lerobot test-servos test-foxglove test-rerun docs

help:            ## list the targets
	@grep -hE '^[a-z0-9-]+:.*##' $(MAKEFILE_LIST) | sed -E 's/:.*## /\t/' | expand -t 18

$(PLAYS): pyproject.toml constraints.txt requirements.lock deploy/setup.sh
	deploy/setup.sh $(PYTHON) train sim view
	@touch $(PLAYS)

$(PACKAGES): pyproject.toml constraints.txt requirements.lock deploy/setup.sh
	deploy/setup.sh $(PYTHON) dev
	@touch $(PACKAGES) $(PLAYS)

$(STAMP): $(PACKAGES)
	$(BIN)/python -m gemuco.warm
	@touch $(STAMP)

setup: $(STAMP)  ## make .venv with the exact versions of constraints.txt

demo: $(PLAYS)  ## two minutes with a muscle-driven arm that loses a sensor and a muscle
	$(BIN)/gemuco demo

reproduce: $(STAMP)  ## the paper's experiments on three simulated robots, its figures beside ours
	for robot in pr2 musashi kxr; do $(BIN)/gemuco reproduce $$robot || exit 1; done

test: TESTS := -m "not long and not slow"
test: $(STAMP)   ## every promise once, a few minutes: what a change needs
	$(RUN_TESTS)

test-ci: TESTS := -m "not slow"
test-ci: $(STAMP)  ## those and the longer ones without the slow ones, a quarter of an hour; CI runs these
	$(RUN_TESTS)

test-all: $(STAMP)  ## all tests, half an hour
	$(RUN_TESTS)

check: $(STAMP)  ## formatting, lint, types, import contracts
	$(BIN)/ruff format --check .
	$(BIN)/ruff check .
	$(BIN)/mypy
	$(BIN)/lint-imports

format: $(STAMP) ## apply formatting and the safe lint fixes
	$(BIN)/ruff format .
	$(BIN)/ruff check --fix .

test-socketcan: $(STAMP)  ## stack and drivers on vcan0 and vcan1 of a real Linux kernel, booted with $(VMCAN) if need be
	@if [ -e /sys/class/net/vcan0 ]; then $(BIN)/python -m pytest $(SOCKETCAN); \
	elif [ -x "$(VMCAN)" ] && command -v insmod >/dev/null; then "$(VMCAN)" -t 580 "$(CURDIR)" $(BIN)/python -m pytest -p no:cacheprovider $(SOCKETCAN); \
	else echo "skipped: no vcan0 here (modprobe vcan; ip link add vcan0 type vcan), and no '$(VMCAN)' with insmod (packages kmod, can-utils) to boot a kernel that has one"; fi

test-controllers: $(STAMP)  ## drivers on two CAN controllers at 1 Mbit/s: can0 and can1 on one wire, or QEMU's SJA1000 by $(VMCAN)
	@if [ -e /sys/class/net/can0/device ]; then $(BIN)/python -m pytest tests/system/test_socketcan_states.py; \
	elif [ -x "$(VMCAN)" ] && command -v qemu-system-x86_64 >/dev/null; then VMCAN_HW=1 "$(VMCAN)" -b qemu -t 580 "$(CURDIR)" $(BIN)/python -m pytest -p no:cacheprovider tests/system/test_socketcan_states.py; \
	else echo "skipped: no controllers can0 and can1 here, and no '$(VMCAN)' with qemu-system-x86_64 to boot a machine that has them"; fi

PYTHON312 ?= python3.12
LEROBOT_HANDS := lerobot[dataset,feetech,dynamixel]==0.6.1 lerobot-doctor==0.2.0 lerobot-lint==0.1.1
ROS2_HANDS := zenoh-ros2-sdk==0.1.8 rosbags==0.11.9 ros2-pyterfaces[cydr]==0.3.0 numpy==2.4.6 eclipse-zenoh==1.10.2

test-ros2: $(STAMP)  ## the bridge to ROS 2 against programs of other authors, installed in build/ros2
	@[ -x build/ros2/bin/zenoh-ros2 ] || { $(BIN)/python -m venv build/ros2 && build/ros2/bin/pip install --quiet --disable-pip-version-check $(ROS2_HANDS); }
	$(BIN)/python -m pytest tests/ros2

test-lerobot: $(STAMP)  ## the plugin and the export against LeRobot itself, installed in build/lerobot; needs Python 3.12
	@[ -x build/lerobot/bin/lelint ] || { $(PYTHON312) -m venv build/lerobot && build/lerobot/bin/pip install --quiet --disable-pip-version-check $(LEROBOT_HANDS) .; }
	build/lerobot/bin/pip install --quiet --disable-pip-version-check --no-deps --force-reinstall . ./integrations/lerobot
	$(BIN)/python tests/lerobot/record_proof.py build/lerobot

SERVO_HANDS := feetech-servo-sdk==1.0.0 dynamixel-sdk==4.1.0 rustypot==1.13.1 damiao-motor==1.0.6 motorbridge==0.5.6

test-servos: $(STAMP)  ## simulated servos and MIT drives under masters of other authors, installed in build/servos; LeRobot's if `make test-lerobot` ran
	@[ -x build/servos/bin/motorbridge-cli ] || { $(BIN)/python -m venv build/servos && build/servos/bin/pip install --quiet --disable-pip-version-check $(SERVO_HANDS); }
	$(BIN)/python -m pytest tests/servos
	@if [ ! -e /sys/class/net/vcan0 ] && [ -x "$(VMCAN)" ]; then "$(VMCAN)" -t 300 "$(CURDIR)" $(BIN)/python -m pytest -p no:cacheprovider tests/servos -k motorbridge; fi

test-foxglove: $(STAMP)  ## the live server under Foxglove's own client and protobufjs, installed in build/foxglove; needs node and npm
	@[ -d build/foxglove/node_modules ] || npm install --silent --no-fund --no-audit --prefix build/foxglove @foxglove/ws-protocol@0.8.0 ws@8.18.3 protobufjs@7.5.4
	$(BIN)/python -m pytest tests/foxglove

test-rerun: $(STAMP)  ## files and live views in rerun, whose package (half a gigabyte) is put into build/rerun
	@[ -d build/rerun/rerun ] || $(BIN)/python -m pip install --quiet --disable-pip-version-check --no-deps --target build/rerun --constraint constraints.txt rerun-sdk psutil attrs
	PYTHONPATH=build/rerun $(BIN)/python -m pytest tests/services/test_rerun.py

test-compose: $(STAMP)  ## the simulated stack in containers: up, a client, each container killed once, down; needs Docker
	$(BIN)/python tests/system/compose_check.py

wheel: $(STAMP)  ## the package as one file in build/wheel
	rm -rf build/lib build/bdist.*  # a build takes what an earlier one left there
	$(BIN)/python -m pip wheel --quiet --disable-pip-version-check --no-deps --wheel-dir build/wheel .
	@ls build/wheel/*.whl

wheels: $(STAMP)  ## fill wheels/, from which the images are then built without a network
	$(BIN)/python deploy/requirements.py --locked +train +sim +studies +build | $(BIN)/python -m pip download --quiet --dest wheels --require-hashes --no-deps --requirement /dev/stdin

lock: $(STAMP)   ## write requirements.lock: the hashes of the versions in constraints.txt
	@mkdir -p build
	$(BIN)/python -m pip install --quiet --dry-run --ignore-installed --report build/lock.json --constraint constraints.txt '.[all,dev,mutation,peers]' setuptools
	$(BIN)/python deploy/lock.py build/lock.json

faults: $(STAMP)  ## the robot broken in every way with many seeds (docs/safety.md), and a million random frames
	$(BIN)/python tests/hal/campaign.py --seeds 7 --json runs/faults.json
	$(BIN)/python tests/hal/fuzz.py --frames 1000000

fuzz: $(STAMP)    ## a hundred thousand bad messages on every key of a running robot
	$(BIN)/python tests/system/fuzz_messages.py --count 100000

mutation: $(STAMP)  ## 300 small changes of drivers, protocols and safety; the share that the fast tests notice, half an hour
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --constraint constraints.txt --editable '.[mutation]'
	$(BIN)/python -m studies.mutation --count 300

peers: $(STAMP)  ## the model beside ridge, Gaussian process, trees, imputers and detectors of scikit-learn, one table; two hours, then cached
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --constraint constraints.txt --editable '.[peers]'
	$(BIN)/python -m studies.peers

test-network: $(STAMP)  ## HAL and model on a link that is cut, slow or lossy, over TCP and QUIC (docs/network.md); needs root
	$(BIN)/python tests/network/campaign.py --json runs/network.json

docs: $(STAMP)   ## the documentation site in build/site; a broken link or a missing reference is an error
	$(BIN)/zensical build --strict --clean

bench: $(STAMP)   ## speed beside torch, zenoh and bare timers, a quarter of an hour; writes docs/benchmarks.md
	env -u OPENBLAS_CORETYPE OMP_NUM_THREADS=1 OPENBLAS_NUM_THREADS=1 $(BIN)/python -m studies.speed.all  # BLAS as free as torch

clean:           ## remove what make setup and the demo made
	rm -rf .venv runs build *.egg-info
