"""The stages of `tests/run`: command, tier, needs, and the files that each depends on.

Tiers: `quick` runs with `--quick` too; `everyday` runs always; `heavy` runs with `--all`, and otherwise only if one of
its `inputs` has changed since it last passed (`tests/all-passed.toml`).
Lanes: `clock` stages wait for real time (flights, servers) and run one at a time; `compute` stages use the time that
those leave, at the lowest priority.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

PROGRAM = "target/debug/vizflyt"
EXAMPLES = "target/debug/examples"
# Rust crate of the Python package.
EXTENSION = "jetson/python/Cargo.toml"
# The workspace without the crates that only heavy stages compile.
WORKSPACE = "--locked --workspace --exclude vizflyt-ros2 --exclude vizflyt-fuzz"
# Crates with features of no ordinary build; always selected together, so that stages share one build.
FEATURED = "-p vizflyt -p vizflyt-ros2 -p vizflyt-bridge -p vizflyt-fuzz -p vizflyt-runtime -p vizflyt-server"
FEATURES = "vizflyt/postgres,vizflyt/foxglove,vizflyt/ros2,vizflyt/crazyflie,vizflyt-bridge/net"


@dataclasses.dataclass(frozen=True)
class Need:
    """A program, library or Python module that a stage uses, and its Debian package."""

    test: str
    """Shell command that succeeds if it is installed."""
    package: str


def program(name: str, package: str = "") -> Need:
    return Need(f"command -v {name}", package or name)


def file(pattern: str, package: str) -> Need:
    return Need(f"compgen -G '{pattern}'", package)


CC = program("cc", "gcc libc6-dev")
CXX = program("c++", "g++")
VENV = Need("python3 -c 'import venv, ensurepip'", "python3-venv")
FFMPEG = program("ffmpeg")
POPPLER = program("pdftoppm", "poppler-utils")
NODE = program("node", "nodejs")
NPM = program("npm")
CHROMIUM = program("chromium")
VULKAN = file("/usr/share/vulkan/icd.d/*.json", "mesa-vulkan-drivers libvulkan1")
POSTGRES = Need("compgen -G '/usr/lib/postgresql/*/bin/initdb' || command -v initdb", "postgresql")
YAML = Need("python3 -c 'import yaml'", "python3-yaml")
ARM = [
    program("aarch64-linux-gnu-gcc", "gcc-aarch64-linux-gnu libc6-dev-arm64-cross"),
    program("qemu-aarch64", "qemu-user"),
]
OPENCV = [
    file("/usr/include/opencv4/opencv2/imgproc.hpp", "libopencv-imgproc-dev"),
    file("/usr/include/opencv4/opencv2/calib3d.hpp", "libopencv-calib3d-dev"),
    Need("ldconfig -p | grep 'libclang[-.0-9]*so'", "libclang-dev"),
    program("clang"),
]

QUICK, EVERYDAY, HEAVY = "quick", "everyday", "heavy"
FIRST, CLOCK, COMPUTE = "first", "clock", "compute"


@dataclasses.dataclass(frozen=True)
class Stage:
    """One row of the table."""

    name: str
    title: str
    tier: str
    lane: str
    """`first` stages run before all others, one after another; if one fails, nothing else runs."""
    command: str
    """Bash, run in the root of the repository."""
    expected_s: int
    """Usual duration on two cores, shown next to the elapsed time [s]."""
    needs: Sequence[Need] = ()
    inputs: Sequence[str] = ()
    """Heavy stages: our folders and files that it depends on; toolchain and crates from elsewhere are added to them."""
    when_quick: str = ""
    """Command in place of `command` with `--quick`; {crates} are the changed ones."""


# Tests of heavy stages: the forest with twenty seeds; a plugin that is compiled and flown.
LONG = "test(over_many_seeds)"
NEW = "test(a_new_rust_plugin)"
# Tests that fly, serve or wait: they measure rates and latencies. The others compute, or use a virtual clock.
CLOCKED = (
    "(package(/^vizflyt-(guardian|runtime|sdk|c|server|simulator|bridge)$/) - test(/^guard::tests::/)"
    f" + binary(flights)) - {LONG} - {NEW}"
)

STAGES = [
    # --- first: without these, nothing else can run
    Stage("format", "format of Rust", QUICK, FIRST,
          f"cargo fmt --all -- --check && cargo fmt --manifest-path {EXTENSION} -- --check", 2),
    Stage(
        "build", "build", QUICK, FIRST,
        f"cargo build {WORKSPACE} --bins --example detections --example misbehave --example trajectories",
        255, [CC, CXX],
    ),
    Stage("compile", "compile the tests", EVERYDAY, FIRST, "tests/rust/compile", 235, [CC, CXX]),
    # --- everyday: compute
    Stage("lint-rust", "lints of Rust", QUICK, COMPUTE,
          f"cargo clippy {WORKSPACE} --all-targets --quiet -- -D warnings"
          # A separate workspace. Not in the stage `python`: cargo lets only one stage at a time use target/debug, and
          # that stage must not wait for one with lower priority.
          # that stage must not wait for one that gives way.
          " && PYO3_NO_PYTHON=1 cargo clippy --locked --quiet --target-dir target"
          f" --manifest-path {EXTENSION} -- -D warnings",
          150,
          when_quick="cargo clippy --locked {crates} --all-targets --quiet -- -D warnings"),
    Stage("tests", "tests that compute", QUICK, COMPUTE, f"tests/rust/test 'not ({CLOCKED} + {LONG} + {NEW})'", 450,
          [VULKAN, FFMPEG, POPPLER],
          when_quick="tests/rust/test --crates {crates}"),
    Stage("doc", "examples in the documentation", EVERYDAY, COMPUTE, f"cargo test {WORKSPACE} --doc", 15),
    Stage("links", "links in the documents", QUICK, COMPUTE,
          "tests/docs/links.py && tests/docs/events.py && tests/docs/messages.py", 2),
    Stage("prose", "words of documents, comments", QUICK, COMPUTE, "tests/docs/prose.py && tests/docs/sources.py", 2),
    Stage("spelling", "spelling", QUICK, COMPUTE, "tests/docs/spelling", 10, [VENV]),
    Stage("commands", "commands in the documents", QUICK, COMPUTE, f"tests/docs/commands.py {PROGRAM}", 1),
    Stage("lint-page", "the page's scripts: lints, types, unit tests", QUICK, COMPUTE, "tests/page/lint", 5,
          [NODE, NPM]),
    Stage("lint-python", "Python: lints and types", QUICK, COMPUTE,
          "tests/python/lint && python3 -m unittest discover -q -s tests/stages", 20, [VENV]),
    # --- everyday: clock
    Stage("flights", "flights and servers in real time", EVERYDAY, CLOCK, f"tests/rust/test '{CLOCKED}'", 620,
          [VULKAN, FFMPEG]),
    Stage("attack", "attacks on the real program", EVERYDAY, CLOCK, f"tests/attack/run {PROGRAM}", 65, [VENV]),
    Stage("page", "the page in Chromium", EVERYDAY, CLOCK, f"tests/page/run {PROGRAM}", 85, [NODE, NPM, CHROMIUM]),
    Stage("python", "Python package and plugins", EVERYDAY, CLOCK,
          f"tests/python/run {PROGRAM} -m 'not long and not course'", 190, [VENV, YAML]),
    # --- heavy: compute
    Stage("targets", "lints for ARM64, and what chips build", HEAVY, COMPUTE, "tests/rust/targets", 60, [ARM[0]],
          ["protocol/core", "protocol/rgbd", "render-server/splat", "firmware-esp/bridge", "tests/rust/targets"]),
    Stage("features", "optional features: lints and tests", HEAVY, COMPUTE, f"tests/rust/features {FEATURES}", 480,
          [VULKAN],
          ["jetson/ros2", "jetson/runtime/src/log", "jetson/runtime/Cargo.toml", "jetson/cli/Cargo.toml",
           "jetson/cli/src/crazyflie", "render-server/server/src/flights/leaderboard",
           "render-server/server/Cargo.toml", "firmware-esp/bridge", "tests/fuzz/tests", "tests/fuzz/Cargo.toml",
           "tests/rust/features"]),
    Stage("firmware", "firmware of the bridge: both chips, the ESP8266's in QEMU", HEAVY, COMPUTE,
          "tests/firmware/run", 370, [VENV], ["firmware-esp", "protocol/core", "tests/firmware"]),
    Stage("opencv", "OpenCV's bindings", HEAVY, COMPUTE, "tests/opencv/run", 175, OPENCV,
          ["jetson/sdk", "jetson/tags", "protocol/core", "tests/opencv"]),
    Stage("sanitize", "unsafe code under AddressSanitizer", HEAVY, COMPUTE, "tests/sanitize/run", 130, [],
          ["render-server/splat", "protocol/rgbd", "jetson/tags", "jetson/sdk", "jetson/sdk-c", "tests/sanitize",
           "tests/fuzz/instrument"]),
    Stage("fuzz", "fuzz targets, four seconds each", HEAVY, COMPUTE, "tests/fuzz/run 4", 230, [CXX],
          ["tests/fuzz", "protocol", "render-server/splat/src/format", "render-server/arena/src/config",
           "render-server/server/src/poses/drivers", "render-server/server/src/stream",
           "render-server/twin/src/dataset", "jetson/runtime/src/link", "jetson/runtime/src/stream",
           "jetson/runtime/src/log", "jetson/guardian", "jetson/ros2", "jetson/grading/src",
           "firmware-esp/bridge", "hardware/simulator/src", "jetson/tags/src"]),
    Stage("arm", "ARM64: codec, renderer, tags in QEMU", HEAVY, COMPUTE, "tests/arm/run", 110, ARM,
          ["protocol/core", "protocol/rgbd", "render-server/splat", "jetson/tags", "tests/arm"]),
    Stage("formats", "scene formats against other people's tools", HEAVY, COMPUTE, f"tests/formats/run {PROGRAM}", 60,
          [VENV, NODE, NPM],
          ["render-server/splat/src/format", "render-server/splat/src/edit", "render-server/studio/src/scene",
           "tests/formats"]),
    Stage("capture", "from a video to a twin, with recorded poses", HEAVY, COMPUTE, f"tests/capture/run {PROGRAM}", 75,
          [VENV, FFMPEG], ["render-server/twin", "render-server/studio/src/scene", "jetson/tags", "tests/capture"]),
    Stage("pycolmap", "from a video to a twin, with pycolmap's own poses", HEAVY, COMPUTE,
          f"tests/capture/run --structure-from-motion pycolmap {PROGRAM}", 120, [VENV, FFMPEG],
          ["render-server/studio/src/scene/capture/poses", "tests/capture/pycolmap.txt"]),
    Stage("tags", "tags against pupil-apriltags, in images and as printed", HEAVY, COMPUTE,
          f"tests/tags/run {EXAMPLES}/detections {PROGRAM}", 170, [VENV, POPPLER],
          ["jetson/tags", "jetson/cli/src/tags", "tests/tags"]),
    Stage("dataset", "data sets against pycocotools", HEAVY, COMPUTE, f"tests/dataset/run {PROGRAM}", 20, [VENV],
          ["render-server/studio/src/labels", "render-server/studio/src/dataset", "tests/dataset"]),
    Stage("site", "documentation site", HEAVY, COMPUTE, f"docs/site/build {PROGRAM}", 40, [VENV],
          ["docs", "jetson/python/python"]),
    # --- heavy: clock
    Stage("seeds", "the forest, flown live over twenty seeds", HEAVY, CLOCK, f"tests/rust/test '{LONG}'", 105, [],
          ["jetson/plugins/avoid", "jetson/runtime/src/control", "jetson/runtime/src/companion",
           "jetson/runtime/src/guard", "hardware/simulator/src", "tests/e2e/tests/flights/demo.rs"]),
    Stage("new-plugin", "a new Rust plugin, compiled, tested and flown", HEAVY, CLOCK, f"tests/rust/test '{NEW}'", 70,
          [], ["jetson/sdk", "jetson/cli/templates", "jetson/cli/src/new", "tests/e2e/tests/flights/fly.rs"]),
    Stage("python-flights", "Python plugins: whole flights", HEAVY, CLOCK,
          f"tests/python/run {PROGRAM} -m long", 250, [VENV, YAML],
          ["jetson/python", "jetson/plugins/python", "jetson/sdk", "jetson/runtime/src/supervisor",
           "jetson/runtime/src/control", "jetson/cli/templates", "tests/python"]),
    Stage("course", "starters and solutions of the course", HEAVY, CLOCK,
          f"tests/python/run {PROGRAM} -m course", 110, [VENV, YAML],
          ["docs/course", "hardware/simulator/src", "jetson/grading/src", "jetson/python", "jetson/runtime/src",
           "jetson/sdk", "protocol/core", "render-server/arena", "render-server/scenes", "render-server/splat",
           "tests/python"]),
    Stage("clients", "independent MAVLink clients", HEAVY, CLOCK,
          "tests/clients/run target/debug/vizflyt-simulator", 80, [VENV],
          ["hardware/simulator", "firmware-esp/bridge", "protocol/core/src/mavlink", "tests/clients"]),
    Stage("ardupilot", "the vehicle's promises, as they are held against ArduCopter", HEAVY, CLOCK,
          "tests/ardupilot/run --quick target/debug/vizflyt-simulator", 80, [VENV],
          ["hardware/simulator", "hardware/airframe", "jetson/runtime/src", "jetson/guardian",
           "protocol/core/src/mavlink", "protocol/core/src/failsafe.rs", "tests/ardupilot"]),
    Stage("ros2", "ROS 2 against Cyclone DDS", HEAVY, CLOCK,
          f"cargo build --locked {FEATURED} --features {FEATURES} --bins"
          f" && jetson/python/build-wheel -o target/ros2/wheels --program {PROGRAM}"
          f" && tests/ros2/run {PROGRAM} target/ros2/wheels/*.whl", 130, [VENV],
          ["jetson/ros2", "protocol/process", "tests/ros2"]),
    Stage("leaderboard", "leaderboard on a PostgreSQL server", HEAVY, CLOCK,
          f"tests/leaderboard/run {FEATURES}", 5, [POSTGRES],
          ["render-server/server/src/flights/leaderboard", "tests/leaderboard"]),
    Stage("mcap", "flight logs against an independent reader", HEAVY, CLOCK,
          f"tests/mcap/run {PROGRAM}", 60, [VENV],
          ["jetson/runtime/src/log", "render-server/studio/src/export", "tests/mcap"]),
    Stage("pose", "fused poses against evo", HEAVY, CLOCK,
          f"tests/pose/run {EXAMPLES}/trajectories {PROGRAM}", 60, [VENV],
          ["render-server/arena/src/pose", "render-server/studio/src/evaluate", "render-server/studio/src/export",
           "tests/pose"]),
    Stage("packages", "packages: built twice, installed in a clean Debian, flown, upgraded, purged; the image",
          HEAVY, CLOCK,
          "cargo build --release --locked --bin vizflyt"
          " && $([ $(id -u) = 0 ] || echo sudo) tests/packages/run target/release/vizflyt", 700, [],
          ["hardware/packages", "render-server/systemd", "jetson/python/build-wheel", "tests/packages"]),
]
