# make setup  installs what the tests need with apt: a software Vulkan driver, a browser, shader tools, libGL
# make test   runs the checks: about eight minutes on two cores once built
# make lint   runs the checks of make test that take seconds
# make test-long   runs the tests that take longer
# make demo   makes a scene of the example photos in out/demo
# make build  builds igsr into .venv
# make wheel  builds the wheel for this platform into dist
# make docs   builds the documentation site into out/docs
# make bench  measures speed and error: [BACKENDS="cpu gpu"] [GARDEN=test_garden.npz] [CAPTURE=DIR]
# make bench-check  compares this build's speed with a commit's: [BASE=HEAD~1]
# make gpu-check   tests and measures this computer's GPU; attach out/gpu-check/report.html to an issue
# make fuzz   changes splat files at random for longer than make test does: [CASES=100000]
#
# Needs Python 3.10 or newer, Rust 1.95 or newer and a C linker. Everything Python goes into .venv.

PYTHON ?= python3
CARGO ?= cargo

VENV := .venv
BIN := $(VENV)/bin

# What Python loads is a release build. Rust tests have the profile of plain `cargo test`: optimized,
# with assertions and overflow checks.
PROFILE := --release
# The interpreter that maturin builds against: with another one, pyo3 would be compiled twice.
export PYO3_PYTHON := $(CURDIR)/$(BIN)/python
export PIP_DISABLE_PIP_VERSION_CHECK := 1

RUST_SOURCES := $(shell find crates -type f \( -name '*.rs' -o -name '*.wgsl' -o -name Cargo.toml \)) \
	Cargo.toml Cargo.lock

.PHONY: demo setup test test-long fuzz bench bench-check gpu-check accuracy docs profile build wheel \
	lint check-rust check-python check-system example-capture clean
.DELETE_ON_ERROR:

# ---- what a user runs --------------------------------------------------------------------------

demo: build
	$(BIN)/igsr refine --example --out out/demo
	@printf '%s\n' '' 'The demo wrote' \
		'  out/demo/scene.html   the scene to turn, in a browser' \
		'  out/demo/scene.ply    the splats: any splat viewer opens it' \
		'  out/demo/report.html  what each round did, in a browser' \
		'  out/demo/report.json  the scores on the held-out views' \
		'  out/demo/views.png    photos, and renders before the rounds and after, if one helped'

# What to measure on, and the files that two of the workloads need.
BACKENDS ?= cpu
BENCH := $(BIN)/python -m igsr_lab bench $(if $(GARDEN),--garden '$(GARDEN)') $(if $(CAPTURE),--capture '$(CAPTURE)')

bench: build
	$(BENCH) $(BACKENDS:%=--backend %) --plot out/bench/speed_vs_error.png --json out/bench/rows.json

BASE ?= HEAD~1
bench-check: build
	$(BIN)/python -m igsr_lab bench-check '$(BASE)'

# What a person with a GPU can send: tests of the kernels, times beside errors (and beside gsplat where
# CUDA and gsplat are), driver and limits. On the software driver where there is no GPU.
SECONDS ?= 2
gpu-check: build
	$(BIN)/python -m igsr_lab gpu-check --seconds $(SECONDS) \
		$(if $(GARDEN),--garden '$(GARDEN)') $(if $(CAPTURE),--capture '$(CAPTURE)')

# Writes the page of accuracy and its plot; on the software driver where there is no GPU.
accuracy: build
	$(BIN)/python -m igsr_lab bench --backend cpu --backend gpu --accuracy docs/how-it-works/accuracy.md

# Stops at any warning: a link without a target, a page that no menu leads to.
docs: build $(VENV)/.dev-ready
	NO_MKDOCS_2_WARNING=1 $(BIN)/mkdocs build --strict
	@printf '%s\n' '' 'The documentation is in out/docs: open out/docs/index.html or, to search it, run' \
		'  python3 -m http.server --directory out/docs'

# The hottest functions of W1 or, with CAPTURE=DIR, of W3's fit steps (once its models are fitted).
profile: build
	@command -v perf >/dev/null || { \
		echo "make profile needs Linux's perf: install the package linux-perf (Debian) or linux-tools-generic (Ubuntu)." >&2; exit 1; }
	@# maturin strips the module; cargo's own file has the functions' names.
	$(CARGO) build $(PROFILE) --locked --package pyo3_bindings
	cp "$${CARGO_TARGET_DIR:-target}/release/lib_core.so" py/igsr/_core.abi3.so
	@mkdir -p out/profile
	perf record --output out/profile/perf.data --freq 999 -- \
		$(BENCH) --backend cpu --workload $(if $(CAPTURE),W3,W1) --seconds 20
	perf report --input out/profile/perf.data --stdio --no-children --dsos _core.abi3.so \
		--percent-limit 1 2>/dev/null | grep -v '^#' | head -n 25

build: $(VENV)/.build-ready

# On Linux for every distribution since 2014: zig links against their glibc.
MANYLINUX := $(if $(filter Linux,$(shell uname -s)),--zig --compatibility manylinux2014)

wheel: $(VENV)/.venv-ready
	$(BIN)/python -m pip install --quiet "$$(grep '^ziglang==' requirements-dev.txt)"
	PATH="$(CURDIR)/$(BIN):$$PATH" $(BIN)/maturin build $(PROFILE) --locked $(MANYLINUX) --out dist

clean:
	rm -rf $(VENV) target dist out py/igsr/_core*.so py/igsr/_core*.pyd
	find py tests examples -name __pycache__ -type d -prune -exec rm -rf {} +
	rm -rf .pytest_cache .mypy_cache .ruff_cache .hypothesis

# Renders the committed example capture again, from nothing.
example-capture: build
	$(BIN)/python -m pip install --quiet --requirement examples/requirements.txt
	$(BIN)/python examples/make_capture.py --out $(EXAMPLE)

# ---- the checks --------------------------------------------------------------------------------

test: check-system check-rust check-python

# The tests of a file share a process here: two processes that build the wheel overwrite each other's.
test-long: check-system build $(VENV)/.dev-ready $(VENV)/ray
	IGSR_TEST_GPU=discrete RUST_TEST_THREADS=1 $(CARGO_TEST) --test gpu_stages
	IGSR_TEST_GPU=no-subgroups IGSR_GPU_CHECKS=1 RUST_TEST_THREADS=1 $(CARGO_TEST) --test gpu_stages
	$(PYTEST) --dist loadfile -m long --ignore=tests/test_blocks_ray.py
	PYTHONPATH="$(CURDIR)/$(VENV)/ray" $(BIN)/python -m pytest -m long tests/test_blocks_ray.py

# Ray is 260 MB, and tests ask what igsr says without it: so it lies beside the environment, which has
# all else that it needs.
$(VENV)/ray: $(VENV)/.dev-ready
	rm -rf $@ $@.part
	$(BIN)/python -m pip install --quiet --no-deps --target $@.part $(RAY)
	mv $@.part $@
	@touch $@

RAY := ray==2.60.0 msgpack==1.2.4 protobuf==7.36.2

# A process of tests per core. Each has one torch thread: more of them wait for each other.
PYTEST := OMP_NUM_THREADS=1 $(BIN)/python -m pytest -n auto --dist worksteal

# As plain `cargo test` (pyo3_bindings has no tests in Rust), but the tests that open a GPU each run one
# after the other: side by side, NVIDIA's driver 580 can spin for ever. On two cores and the software
# driver, whose threads fill them anyway, they take a tenth longer.
CARGO_TEST := $(CARGO) test --workspace --exclude pyo3_bindings
RUST_TESTS := $(sort $(notdir $(basename $(wildcard crates/*/tests/*.rs)) \
	$(patsubst %/main.rs,%,$(wildcard crates/*/tests/*/main.rs))))

check-rust: build
	$(CARGO) fmt --all --check
	$(CARGO) clippy $(PROFILE) --locked --workspace --all-targets -- -D warnings
	$(CARGO_TEST) --lib --bins $(patsubst %,--test %,$(filter-out gpu_%,$(RUST_TESTS)))
	RUST_TEST_THREADS=1 $(CARGO_TEST) --test 'gpu_*'
	$(CARGO_TEST) --doc

# The same seeded changes as in make test, and more of them. cargo-fuzz would need a nightly compiler.
CASES ?= 100000

fuzz:
	IGSR_FUZZ_CASES=$(CASES) $(CARGO) test --locked --package splat_render \
		--test formats mutations -- --nocapture

check-python: lint
	$(PYTEST)

lint: build $(VENV)/.dev-ready
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy
	$(BIN)/lint-imports
	$(BIN)/python tests/plain_words.py --check
	$(BIN)/codespell *.md Makefile pyproject.toml crates docs examples py tests

# ---- system packages ---------------------------------------------------------------------------

# Vulkan on the CPU where there is no GPU; a display for the viewer's window, with a fake mouse;
# readers of the shaders that naga's authors did not write; a browser for pages; what OpenCV links.
SYSTEM_PACKAGES := python3-venv mesa-vulkan-drivers libvulkan1 xvfb xdotool libx11-6 libx11-xcb1 \
	libxcursor1 libxi6 libxrandr2 libxkbcommon-x11-0 spirv-tools glslang-tools chromium \
	libgl1

setup:
	@command -v apt-get >/dev/null || { \
		echo "make setup needs apt-get; install what your system calls: $(SYSTEM_PACKAGES)" >&2; exit 1; }
	@as_root=; [ "$$(id -u)" = 0 ] || as_root="sudo -n"; \
	$$as_root apt-get update -qq && \
	$$as_root env DEBIAN_FRONTEND=noninteractive apt-get install -y -qq --no-install-recommends \
		$(SYSTEM_PACKAGES)

# Says all that is missing before anything runs, and installs nothing.
check-system:
	@missing=; \
	need() { eval "$$2" >/dev/null 2>&1 || missing="$$missing $$1"; }; \
	lib() { ldconfig -p | grep -q "$$1"; }; \
	if [ "$$(uname -s)" = Linux ]; then \
		need "libvulkan1" "lib libvulkan.so.1"; \
		need "mesa-vulkan-drivers" "ls /usr/share/vulkan/icd.d/*.json || ls /etc/vulkan/icd.d/*.json"; \
		need "xvfb" "command -v Xvfb"; need "xdotool" "command -v xdotool"; \
		need "libxkbcommon-x11-0" "lib libxkbcommon-x11.so.0"; \
		need "libxcursor1" "lib libXcursor.so.1"; need "libxi6" "lib libXi.so.6"; \
		need "libgl1" "lib libGL.so.1"; \
		need "spirv-tools" "command -v spirv-val"; \
		need "glslang-tools" "command -v glslangValidator"; \
	fi; \
	need "chromium" "command -v chromium || command -v chromium-browser || command -v google-chrome || command -v chrome"; \
	[ -z "$$missing" ] || { \
		echo "make test needs packages that are not installed:$$missing. Run make setup, or install them." >&2; \
		exit 1; }

# ---- setting up --------------------------------------------------------------------------------

$(VENV)/.venv-ready: requirements-dev.txt
	@command -v $(PYTHON) >/dev/null || { \
		echo "igsr needs Python 3.10 or newer, and '$(PYTHON)' is not on the PATH: install it, or name one with 'make PYTHON=...'." >&2; exit 1; }
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 10))' || { \
		echo "igsr needs Python 3.10 or newer, and '$(PYTHON)' is $$($(PYTHON) -V): name a newer one with 'make PYTHON=...'." >&2; exit 1; }
	@command -v $(CARGO) >/dev/null || { \
		echo "igsr needs a Rust toolchain, and 'cargo' is not on the PATH: install Rust with rustup." >&2; exit 1; }
	@$(PYTHON) -c 'import ensurepip, venv' 2>/dev/null || { \
		echo "Python's venv module is missing: run make setup, or install python3-venv." >&2; exit 1; }
	$(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --quiet "$$(grep '^maturin==' requirements-dev.txt)"
	@touch $@

$(VENV)/.build-ready: $(VENV)/.venv-ready pyproject.toml $(RUST_SOURCES)
	@# Another environment that is active is not the one to install into.
	env -u CONDA_PREFIX VIRTUAL_ENV="$(CURDIR)/$(VENV)" $(BIN)/maturin develop $(PROFILE) --locked --extras refine,matching,app
	@touch $@

$(VENV)/.dev-ready: $(VENV)/.venv-ready requirements-dev.txt
	$(BIN)/python -m pip install --quiet --requirement requirements-dev.txt
	@touch $@
