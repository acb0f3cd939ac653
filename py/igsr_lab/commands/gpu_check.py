"""``python -m igsr_lab gpu-check``: test and measure this computer's GPU, and write a report.

The kernels' tests come first; they run on whatever adapter answers. The report is written whether
they pass or not, or do not end; the exit status is 1 where one fails.
"""

from __future__ import annotations

import contextlib
import os
import re
import signal
import subprocess
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any

import typer

from igsr_lab import bench

ROOT = Path(__file__).resolve().parents[3]
COMMAND = ("cargo", "test", "--release", "--locked", "--package", "splat_render", "--no-fail-fast")
TESTS = tuple(
    word
    for name in ("gpu_stages", "gpu_fit", "gpu_density", "gpu_faults")
    for word in ("--test", name)
)
#: NVIDIA's driver (580) can spin for ever where threads that used it end while others open devices.
ONE_BY_ONE = ("--", "--test-threads=1")
#: Seconds that the tests may take once they are built; a software driver takes four minutes.
TIMEOUT = 1800.0
#: Seconds that are waited for tests that were ended: a driver may hold them.
END_TIMEOUT = 10.0
#: Last lines of the compiler that are shown where the tests do not run.
SHOWN = 20


def kernel_tests() -> dict[str, Any]:
    """Build and run the kernels' tests; which passed and which failed."""
    # Building does not count against the tests' time.
    built = subprocess.run([*COMMAND, *TESTS, "--no-run"], cwd=ROOT, capture_output=True, text=True)
    if built.returncode != 0:
        return _not_run(built.stdout + built.stderr, 0.0)
    return run_tests((*COMMAND, *TESTS, *ONE_BY_ONE))


def run_tests(command: Sequence[str], timeout: float = TIMEOUT) -> dict[str, Any]:
    """Run a command that prints as cargo's tests do, and end it where it takes too long."""
    began = time.perf_counter()
    # Files, since whoever reads a pipe to its end waits for what the command started, too.
    with tempfile.TemporaryFile() as printed, tempfile.TemporaryFile() as complaints:
        running = subprocess.Popen(
            command, cwd=ROOT, stdout=printed, stderr=complaints, start_new_session=True
        )
        try:
            status: int | None = running.wait(timeout)
        except subprocess.TimeoutExpired:
            status = None
            _end(running)
        except BaseException:
            # In a session of its own, it does not get the terminal's Ctrl-C.
            _end(running)
            raise
        seconds = time.perf_counter() - began
        output, errors = (_text(file) for file in (printed, complaints))
    found = dict(re.findall(r"^test (\S+) \.\.\. (?:.*\n)*?(ok|FAILED)$", output, re.MULTILINE))
    failed = sorted(name for name, result in found.items() if result != "ok")
    passed = len(found) - len(failed)
    if status is None:
        begun = re.findall(r"^test (\S+) \.\.\. ", output, re.MULTILINE)
        stuck = [name for name in begun[-1:] if name not in found] or ["the tests"]
        failed += [
            f"{name} did not end within {timeout:.0f} s; nothing ran after" for name in stuck
        ]
    elif status != 0 and not failed:
        return _not_run(errors + output, seconds)
    return _tests(passed, failed, seconds)


def _end(running: subprocess.Popen[bytes]) -> None:
    """End a command and what it started."""
    with contextlib.suppress(OSError):  # it has just ended by itself
        if hasattr(os, "killpg"):
            os.killpg(running.pid, signal.SIGKILL)
        else:
            running.kill()
    with contextlib.suppress(subprocess.TimeoutExpired):
        running.wait(END_TIMEOUT)


def _text(file: Any) -> str:
    file.seek(0)
    return file.read().decode(errors="replace")


def _not_run(output: str, seconds: float) -> dict[str, Any]:
    lines = output.splitlines()[-SHOWN:]
    return _tests(0, ["the tests did not run"], seconds) | {"error": "\n".join(lines)}


def _tests(passed: int, failed: list[str], seconds: float) -> dict[str, Any]:
    return {
        "command": " ".join((*COMMAND, *TESTS, *ONE_BY_ONE)),
        "passed": passed,
        "failed": failed,
        "seconds": seconds,
        "error": "",
    }


def gpu_check_command(
    out: Annotated[Path, typer.Option("--out", help="Folder for the report.")] = Path(
        "out/gpu-check"
    ),
    garden: Annotated[
        Path | None,
        typer.Option("--garden", metavar="FILE", help="For W2: gsplat's test_garden.npz."),
    ] = None,
    capture: Annotated[
        Path | None,
        typer.Option("--capture", metavar="CAPTURE", help="For W3: photos of 400x400 pixels."),
    ] = None,
    seconds: Annotated[
        float, typer.Option("--seconds", help="How long each row is repeated, in seconds.")
    ] = 2.0,
) -> None:
    """Test the kernels, measure them, and write report.html and report.json into --out.

    Attach the report to an issue about a GPU. The exit status is 1 if a test fails.
    """
    out.mkdir(parents=True, exist_ok=True)
    print("testing the kernels ...", flush=True)
    tests = kernel_tests()
    print(f"{tests['passed']} passed, {len(tests['failed'])} failed", flush=True)
    settings = bench.Settings(
        backends=("gpu",),
        garden=garden,
        capture=capture,
        models=out / "models",
        seconds=seconds,
    )
    report = bench.device_report(settings, lambda doing: print(doing, flush=True))
    path = out / "report.html"
    bench.write_device_report(path, {**report, "tests": tests})
    print(f"\nThe report is {path}; its figures are in {bench.json_beside(path)}.")
    if tests["failed"]:
        raise typer.Exit(1)
