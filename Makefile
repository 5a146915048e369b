# SPDX-License-Identifier: Apache-2.0
#
# On a fresh Debian or Ubuntu machine, `make demo` and `make test` need nothing before them: they
# install what is missing (tools/setup.sh says what) and keep Python packages in .venv.
#
#   PYTHON=/path/to/python3     the Python to make .venv with, 3.11 or newer
#   OHMSKIN_PIO_ONLINE=1        let PlatformIO download its own packages (tools/platformio_offline)

BIN := .venv/bin
HOST_STAMP := .venv/.stamp-host
STAMP := .venv/.stamp

export PLATFORMIO_SETTING_ENABLE_TELEMETRY := no
export PLATFORMIO_DISABLE_UPGRADE_CHECK := true
ifneq ($(OHMSKIN_PIO_ONLINE),1)
export PLATFORMIO_CORE_DIR := $(CURDIR)/.pio/core
PIO_STAMP := .pio/core/.stamp
$(PIO_STAMP): $(STAMP) $(shell find tools/platformio_offline -name '*.py' -o -name '*.json')
	$(BIN)/python tools/platformio_offline/seed.py .pio/core
	@touch $@
endif

ONE_THREAD := OMP_NUM_THREADS=1 OPENBLAS_NUM_THREADS=1 MKL_NUM_THREADS=1
HEX := host/ohmskin/firmware
PINS := tools/pins
NPM_LOCKS := firmware/second_sim/package-lock.json tools/page_lint/package-lock.json
BIOME = $(firstword $(shell ls tools/page_lint/node_modules/@biomejs/cli-*/biome 2>/dev/null) false)
PAGE := --config-path=tools/page_lint --error-on-warnings host/ohmskin/view/page
C_FILES = $(shell find firmware fuzz -name '*.c' -o -name '*.cpp' -o -name '*.h')

BENCHMARKS := $(addprefix bench-,firmware import host estimators tables fingers newtons knead far pace orders desk force \
                export view strangers largest boards honest quick)

.DEFAULT_GOAL := help
.NOTPARALLEL:
.PHONY: help setup setup-host pins demo test check docs format firmware pico wheel test-firmware test-arduino-gcc test-wiring check-firmware sim \
        test-host test-world test-lerobot fuzz chart stability ablate far experiments clean distclean $(BENCHMARKS)

help: ## list the targets
	@awk -F ':.*## ' '/^[a-z-]+:.*## / { printf "  make %-17s %s\n", $$1, $$2 }' $(MAKEFILE_LIST)

demo: setup-host ## estimate touches on an emulated skin: no board, no compiler needed
	$(BIN)/ohmskin demo

test: setup check test-firmware firmware pico sim check-firmware test-host ## build, check and test everything

setup: $(STAMP) $(PIO_STAMP) ## install what development needs (apt packages, .venv, PlatformIO)

setup-host: $(HOST_STAMP) ## install what the host alone needs (.venv)

$(HOST_STAMP): pyproject.toml tools/setup.sh $(PINS)/host.txt
	tools/setup.sh host

$(STAMP): pyproject.toml tools/setup.sh $(PINS)/all.txt $(NPM_LOCKS)
	tools/setup.sh all

# Versions stay as they are, with UPGRADE=--upgrade they are the newest.
PIN := uv pip compile --quiet --generate-hashes --no-annotate --custom-compile-command 'make pins' $(UPGRADE)
pins: ## write what `make setup` installs, with hashes, anew (needs uv): tools/pins
	$(PIN) --universal --python-version 3.11 --extra dev pyproject.toml $(PINS)/build.in -o $(PINS)/all.txt
	$(PIN) --universal --python-version 3.11 --extra plot --extra view --constraint $(PINS)/all.txt \
		pyproject.toml $(PINS)/build.in -o $(PINS)/host.txt
	$(PIN) --no-deps $(PINS)/avr-gcc.in -o $(PINS)/avr-gcc.txt

check: setup ## formatting, lint, types, generated files, docs
	$(BIN)/ruff check
	$(BIN)/ruff format --check
	$(BIN)/mypy
	PYTHONPATH=. $(BIN)/lint-imports
	$(BIN)/clang-format --dry-run -Werror $(C_FILES)
	@if $(BIOME) --version >/dev/null 2>&1; then echo "biome check"; $(BIOME) check $(PAGE); \
	else echo "check: biome is missing (npm: make setup), the page's JavaScript is not linted"; \
		test "$$CI" != true && test -z "$$OHMSKIN_NO_SKIP"; fi
	$(BIN)/python protocol/generate.py --check
	$(BIN)/python docs/draw.py --check
	NO_MKDOCS_2_WARNING=1 $(BIN)/mkdocs build --strict

docs: setup ## build the pages of docs/ into build/site
	NO_MKDOCS_2_WARNING=1 $(BIN)/mkdocs build --strict

format: setup ## put Python, C++ and JavaScript sources into the common format
	$(BIN)/ruff check --fix
	$(BIN)/ruff format
	$(BIN)/clang-format -i $(C_FILES)
	! $(BIOME) --version >/dev/null 2>&1 || $(BIOME) check --write $(PAGE)

firmware: setup ## build the firmware for all boards
	$(BIN)/pio run

pico: setup ## build the firmware for a Raspberry Pi Pico: firmware/pico/build/ohmskin.uf2
	$(MAKE) -C firmware/pico OHMSKIN_FLAGS="$(OHMSKIN_FLAGS)"

# The copies go: a later wheel would carry an old firmware.
wheel: firmware pico ## build dist/ohmskin-*.whl with the firmware of all boards, to flash without a checkout
	mkdir -p $(HEX)
	for board in uno nano megaatmega2560; do cp .pio/build/$$board/firmware.hex $(HEX)/$$board.hex || exit; done
	cp firmware/pico/build/ohmskin.uf2 $(HEX)/pico.uf2
	$(BIN)/hatchling build -t wheel
	rm -r $(HEX)

test-firmware: setup ## unit tests of the firmware: on this machine and in simulated AVRs
	$(BIN)/pio test -e native -e native_pico -e uno_sim -e mega_sim

test-arduino-gcc: setup sim ## test the firmware as built with avr-gcc 7.3, which Arduino's users have
	$(ONE_THREAD) tools/test_arduino_gcc.sh

test-wiring: setup sim ## test the wiring that platformio.ini has: all cells, in the simulators
	$(BIN)/pio run --silent -e uno -e megaatmega2560
	$(ONE_THREAD) $(BIN)/pytest --quiet --capture=no -rfEs tests/firmware/test_wiring.py

check-firmware: setup ## cppcheck
	$(BIN)/pio check -e uno --fail-on-defect low --fail-on-defect medium --fail-on-defect high

sim: setup ## build the simulator that runs the firmware on an emulated skin
	$(MAKE) -C firmware/sim

# Half of the time that tests take is waiting, so three processes keep two cores busy.
test-host: setup firmware pico sim ## pytest, three processes for two cores
	$(ONE_THREAD) $(BIN)/pytest --numprocesses $$((($$(nproc) * 3 + 1) / 2)) --dist worksteal

test-world: setup-host ## test integrations/ with the real libraries: MuJoCo, Foxglove, Rerun, ROS 2 (build/world)
	tools/test_world.sh mujoco foxglove ros2 notebook

test-lerobot: setup-host ## test integrations/lerobot with LeRobot: installs 6.4 GB below build/world
	tools/test_world.sh lerobot

FUZZED := build/fuzz/frame_reader
READER := firmware/src/core/frame_reader
$(FUZZED): fuzz/frame_reader.cpp $(READER).cpp $(READER).h
	mkdir -p $(@D)
	$(CXX) -std=c++11 -O1 -g -Wall -Wextra -Werror -fsanitize=address,undefined \
		-fno-sanitize-recover=all -I firmware/src -I protocol fuzz/frame_reader.cpp $(READER).cpp -o $@

fuzz: setup $(FUZZED) ## fuzz all that comes from outside, ten minutes (SECURITY.md)
	$(FUZZED) 2000000 1
	$(ONE_THREAD) PYTHONPATH=.:tests/helpers $(BIN)/python -m fuzz 600

STUDY := $(ONE_THREAD) PYTHONPATH=. $(BIN)/python -m studies

chart: setup firmware sim ## time a frame and rate of scans against error, simulated: docs/*-accuracy.png
	$(STUDY) chart
	$(BENCH)/chart_rates.py

stability: setup ## where methods fail, and whether they say so, simulated: docs/stability.png
	$(STUDY) stability

ablate: setup ## what each number in joint and touch earns, ngspice and simulated: docs/ablate.csv
	$(STUDY) ablate

far: setup ## lines sensed at both ends, near ends, zero potential, simulated: docs/far-ends.png
	$(STUDY) far

experiments: setup ## the paper's experiments with force, simulated: docs/force-*.png
	for each in flat curved kneaded timeseries minimum; do $(STUDY) experiment $$each || exit 1; done

BENCH := $(ONE_THREAD) PYTHONPATH=.:tests/helpers $(BIN)/python benchmarks

bench-firmware: setup firmware pico sim ## measure the firmware in the simulator
	$(BENCH)/bench_firmware.py

bench-import: setup-host ## measure what importing the package and asking for its help cost
	$(BENCH)/bench_import.py

bench-host: setup-host ## measure decoding, latency and load of the host
	$(BENCH)/bench_host.py

bench-estimators: setup-host ## measure the estimators: time, error, stated uncertainty
	$(BENCH)/bench_estimators.py

bench-tables: setup-host ## measure the paper's sweeps, and methods that are told less: tables of docs
	$(BENCH)/bench_tables.py

bench-fingers: setup-host ## measure fingertips where nobody knows the wires, and the paper's method
	$(BENCH)/bench_fingers.py

bench-newtons: setup-host ## measure forces under many touches where nobody has told the wires
	$(BENCH)/bench_newtons.py

bench-knead: setup-host ## measure forces of skins that were kneaded over a scale
	$(BENCH)/bench_knead.py

bench-honest: setup-host ## measure whether answers say so where a skin is not as the model supposes
	$(BENCH)/bench_honest.py

bench-pace: setup firmware sim ## measure what it costs to read less of a skin, and what it saves, simulated
	$(BENCH)/bench_pace.py

bench-far: setup-host ## measure what sensing both ends of the lines gains, beside near ends alone
	$(BENCH)/bench_far.py

bench-orders: setup firmware sim ## measure in which order modes near and far should take their readings, simulated
	$(BENCH)/bench_orders.py

bench-desk: setup firmware sim ## measure estimates from a board as unkind as one on a desk, simulated
	$(BENCH)/bench_desk.py

bench-force: setup-host ## measure the way from scan to force: time, ten minutes live, replay
	$(BENCH)/bench_force.py

bench-export: setup-host ## measure bringing the forces of recordings into files: time, memory
	$(BENCH)/bench_export.py

bench-view: setup ## measure the page: latency to the screen, frames, load
	$(BENCH)/bench_view.py

bench-strangers: setup-host ## measure what those without the token can do to the page
	$(BENCH)/bench_strangers.py

bench-largest: setup-host ## measure what the largest skins that files may have cost: SECURITY.md
	$(BENCH)/bench_largest.py

bench-boards: setup-host ## measure one process that reads eight boards at once: five minutes
	$(BENCH)/bench_boards.py

bench-quick: setup firmware pico sim ## see that all benchmarks run, in minutes: the figures mean nothing
	for file in benchmarks/bench_*.py; do \
		echo $$file; $(BENCH)/$${file##*/} --quick || exit; \
	done

clean: ## remove what was built
	rm -rf .pio/build .pio/libdeps build dist .pytest_cache .mypy_cache .ruff_cache .hypothesis
	find . -name .venv -prune -o -name __pycache__ -prune -exec rm -rf {} +
	$(MAKE) -C firmware/sim clean
	$(MAKE) -C firmware/pico clean

distclean: clean ## remove .venv and PlatformIO's packages too
	rm -rf .venv .pio firmware/second_sim/node_modules tools/page_lint/node_modules
