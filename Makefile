# Each target installs what it needs: into the active virtual environment, or into .venv if none is active.
# Another Python: make PYTHON=python3.12 test
SHELL := /bin/sh
PYTHON ?= python3
VENV := $(or $(VIRTUAL_ENV),.venv)
INSTALLED := $(VENV)/.snarf-installed
SNARF := $(VENV)/bin/snarf
SUBJECT ?= 50002
NATIVE := $(wildcard csrc/cpu/*.cpp csrc/cpu/*.h csrc/include/snarf/*.h)
C_FAMILY = $(shell find csrc benchmarks tests/native tests/pretend_gpu tests/trust -name '*.c' -o -name '*.h' -o -name '*.cpp' -o -name '*.cu' -o -name '*.cuh')

.PHONY: help setup demo test lowest docs notebook platforms wheels fuzz trust sanitize lint format bench gpu clean

help:
	@echo "make setup     install snarf into $(VENV), with what its tests need"
	@echo "make demo      run the whole pipeline on the built-in subject $(SUBJECT): samples, training, animation, evaluation"
	@echo "make test      run the tests"
	@echo "make lowest    run the tests of files, samples, pictures and commands with the oldest packages that pyproject.toml allows"
	@echo "make docs      build the documentation as a site, in build/site"
	@echo "make notebook  run the notebook of examples/ as it stands, in about ten minutes"
	@echo "make platforms resolve the packages for every Python and platform, and write docs/platforms.md"
	@echo "make wheels    build wheels for this platform with cibuildwheel, and try them"
	@echo "make fuzz      read 20,000 damaged files with every file reader, 5,000 with slow ones"
	@echo "make trust     crash, disturb and attack the commands, and measure their memory, for some hours (Linux)"
	@echo "make sanitize  test the native library built with AddressSanitizer and UndefinedBehaviorSanitizer (Linux)"
	@echo "make lint      check style, format and types of the code"
	@echo "make format    format the code"
	@echo "make bench     measure the searches, preprocessing, batches, a training step, evaluation and mesh extraction"
	@echo "make gpu       check and measure everything that runs on a GPU, in nine minutes at most, after minutes of preparation on the CPU"
	@echo "make clean     remove .venv, builds, samples and results"

setup: $(INSTALLED)

$(INSTALLED): pyproject.toml tools/set_up.sh CMakeLists.txt $(NATIVE)
	PYTHON=$(PYTHON) tools/set_up.sh $(VENV)

# The commands are enough for users: an installed snarf is taken as it is.
$(SNARF):
	PYTHON=$(PYTHON) tools/set_up.sh $(VENV) commands

demo: $(SNARF)
	$(SNARF) preprocess subject=$(SUBJECT)
	$(SNARF) train subject=$(SUBJECT) training=quick run=demo resume=true
	$(SNARF) animate subject=$(SUBJECT) run=demo resolution=128 max_frames=30 overwrite=true
	$(SNARF) eval subject=$(SUBJECT) run=demo
	$(SNARF) eval --ood subject=$(SUBJECT) run=demo
	@echo "avatar, tables and pictures: outputs/builtin/$(SUBJECT)/demo"
	@echo "meshes and video:            outputs/builtin/$(SUBJECT)/demo/animation"
	@echo "next: $(SNARF) export subject=$(SUBJECT) run=demo format=html"

test: $(INSTALLED)
	tools/fetch_nvrtc.sh $(VENV)
	$(VENV)/bin/python -m pytest -q -n auto

lowest:
	tools/test_lowest.sh $(PYTHON)

docs: $(INSTALLED)
	NO_MKDOCS_2_WARNING=true $(VENV)/bin/python -m mkdocs build --quiet --strict
	@echo "site: build/site/index.html"

notebook: export OMP_WAIT_POLICY = PASSIVE
notebook: $(INSTALLED)
	mkdir -p build/notebook
	cd build/notebook && $(abspath $(VENV))/bin/python $(CURDIR)/tools/run_notebook.py $(CURDIR)/examples/first_avatar.ipynb

platforms: build/packaging
	build/packaging/bin/python tools/platforms.py

wheels: build/packaging
	build/packaging/bin/python -m cibuildwheel --output-dir build/wheels

build/packaging:
	$(PYTHON) -m venv $@
	$@/bin/python -m pip install --quiet uv cibuildwheel || { rm -rf $@; exit 1; }

fuzz: $(INSTALLED)
	$(VENV)/bin/python tools/fuzz_readers.py

# The short forms of these are among the tests. What is promised is in docs/promises.md.
trust: $(INSTALLED)
	$(VENV)/bin/python tools/trust_faults.py
	$(VENV)/bin/python tools/trust_pairs.py
	$(VENV)/bin/python tools/trust_viewer.py
	$(VENV)/bin/python tools/trust_memory.py
	for seed in 1 2 3; do $(VENV)/bin/python tools/fuzz_readers.py --count 5000 --seed $$seed --only own || exit 1; done

sanitize: $(INSTALLED)
	tools/sanitize.sh $(VENV)

lint: $(INSTALLED)
	$(VENV)/bin/ruff check .
	$(VENV)/bin/ruff format --check .
	$(VENV)/bin/clang-format --dry-run --Werror $(C_FAMILY)
	$(VENV)/bin/pyright --pythonpath $(VENV)/bin/python

format: $(INSTALLED)
	$(VENV)/bin/ruff check --select I --fix .
	$(VENV)/bin/ruff format .
	$(VENV)/bin/clang-format -i $(C_FAMILY)

# As the commands do: idle PyTorch threads must not occupy the cores that the native library needs.
bench: export OMP_WAIT_POLICY = PASSIVE
bench: $(INSTALLED)
	$(VENV)/bin/python benchmarks/bm_search.py
	$(VENV)/bin/python benchmarks/bm_balance.py
	$(VENV)/bin/python benchmarks/bm_library.py
	$(VENV)/bin/python benchmarks/bm_data.py
	$(VENV)/bin/python benchmarks/bm_training.py
	$(VENV)/bin/python benchmarks/bm_threads.py
	$(VENV)/bin/python benchmarks/bm_optimizer.py
	$(VENV)/bin/python benchmarks/bm_gpu_waits.py
	$(VENV)/bin/python benchmarks/bm_evaluation.py
	$(VENV)/bin/python benchmarks/bm_extraction.py
	$(VENV)/bin/python benchmarks/bm_shape.py
	$(VENV)/bin/python benchmarks/bm_diffusion.py
	$(VENV)/bin/python benchmarks/bm_networks.py
	$(VENV)/bin/python benchmarks/bm_surfaces.py
	$(VENV)/bin/python benchmarks/bm_loose_pieces.py
	$(VENV)/bin/python benchmarks/bm_video.py

gpu: $(INSTALLED)
	$(VENV)/bin/python benchmarks/gpu_check.py --look
	$(VENV)/bin/python benchmarks/pack_gpu_check.py
	$(VENV)/bin/python benchmarks/gpu_check.py

clean:
	rm -rf .venv build data/processed outputs
