"""Test and measure this computer's GPU: writes a page and a JSON file that can be sent to others.

    python benches/gpu_check.py [--out DIR] [--garden FILE] [--capture DIR] [--seconds S]

The kernels' tests come first; they run on whatever adapter answers. The report is written whether
they pass or not; the exit status is 1 where one fails.
"""

from __future__ import annotations

import argparse
import re
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

from igsr import benchmark

ROOT = Path(__file__).resolve().parent.parent
COMMAND = ("cargo", "test", "--release", "--locked", "--package", "splat_render", "--no-fail-fast")
TESTS = tuple(
    word
    for name in ("gpu_stages", "gpu_fit", "gpu_density", "gpu_faults")
    for word in ("--test", name)
)
#: Last lines of the compiler that are shown where the tests do not run.
SHOWN = 20


def kernel_tests() -> dict[str, Any]:
    """Run the kernels' tests; which passed and which failed."""
    began = time.perf_counter()
    done = subprocess.run([*COMMAND, *TESTS], cwd=ROOT, capture_output=True, text=True)
    found = dict(
        re.findall(r"^test (\S+) \.\.\. (?:.*\n)*?(ok|FAILED)$", done.stdout, re.MULTILINE)
    )
    failed = sorted(name for name, result in found.items() if result != "ok")
    if done.returncode != 0 and not failed:
        lines = (done.stderr + done.stdout).splitlines()[-SHOWN:]
        return _tests(0, ["the tests did not run"], began) | {"error": "\n".join(lines)}
    return _tests(len(found) - len(failed), failed, began)


def _tests(passed: int, failed: list[str], began: float) -> dict[str, Any]:
    return {
        "command": " ".join((*COMMAND, *TESTS)),
        "passed": passed,
        "failed": failed,
        "seconds": time.perf_counter() - began,
        "error": "",
    }


def main() -> int:
    """Tests, benchmark, report."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--out", type=Path, default=Path("out/gpu-check"))
    parser.add_argument("--garden", type=Path, help="for W2: gsplat's test_garden.npz")
    parser.add_argument("--capture", type=Path, help="for W3: photos of 400x400 pixels")
    parser.add_argument("--seconds", type=float, default=2.0, help="how long a row is repeated")
    given = parser.parse_args()
    given.out.mkdir(parents=True, exist_ok=True)
    print("testing the kernels ...", flush=True)
    tests = kernel_tests()
    print(f"{tests['passed']} passed, {len(tests['failed'])} failed", flush=True)
    settings = benchmark.Settings(
        backends=("gpu",),
        garden=given.garden,
        capture=given.capture,
        models=given.out / "models",
        seconds=given.seconds,
    )
    report = benchmark.device_report(settings, lambda doing: print(doing, flush=True))
    path = given.out / "report.html"
    benchmark.write_device_report(path, {**report, "tests": tests})
    print(f"\nThe report is {path}; its figures are in {benchmark.json_beside(path)}.")
    return 1 if tests["failed"] else 0


if __name__ == "__main__":
    sys.exit(main())
