"""``python -m igsr_lab gpu-check``: test and measure this computer's GPU, and write a report.

The kernels' tests run first, on the adapter that igsr uses. The report is written whether they
pass, fail or hang; the exit status is 1 if one fails.
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

from igsr.cli.options import option
from igsr_lab import bench
from igsr_lab.commands.bench import CaptureOption, GardenOption, SecondsOption

ROOT = Path(__file__).resolve().parents[3]
BUILD = ("cargo", "test", "--release", "--locked", "--package", "splat_render", "--no-fail-fast")
TEST_FILES = tuple(
    word
    for name in ("gpu_stages", "gpu_fit", "gpu_density", "gpu_faults")
    for word in ("--test", name)
)
#: NVIDIA's driver (580) can hang if threads that used it end while others open devices.
ONE_BY_ONE = ("--", "--test-threads=1")
COMMAND = (*BUILD, *TEST_FILES, *ONE_BY_ONE)
#: Time limit of the built tests; a software driver takes four minutes.
TIMEOUT_SECONDS = 1800.0
#: Time limit for killed tests to end: a driver may hold them.
END_TIMEOUT_SECONDS = 10.0
#: Number of the compiler's last lines in the report, if the tests do not run.
SHOWN_LINES = 20


def kernel_tests() -> dict[str, Any]:
    """Build and run the kernels' tests; return which passed and failed."""
    words = (*BUILD, *TEST_FILES, "--no-run")  # building does not count against the time limit
    built = subprocess.run(words, cwd=ROOT, capture_output=True, text=True)
    if built.returncode != 0:
        return _not_run(built.stdout + built.stderr, 0.0)
    return run_tests(COMMAND)


def run_tests(command: Sequence[str], timeout: float = TIMEOUT_SECONDS) -> dict[str, Any]:
    """Run a command that prints like cargo's tests; kill it after the timeout."""
    began = time.perf_counter()
    # Files, because a pipe stays open until all children end.
    with tempfile.TemporaryFile() as printed, tempfile.TemporaryFile() as complaints:
        running = subprocess.Popen(
            command, cwd=ROOT, stdout=printed, stderr=complaints, start_new_session=True
        )
        try:
            status: int | None = running.wait(timeout)
        except subprocess.TimeoutExpired:
            status = None
            _kill(running)
        except BaseException:
            # In its own session, it does not get the terminal's Ctrl-C.
            _kill(running)
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


def _kill(running: subprocess.Popen[bytes]) -> None:
    """Kill a command and its children."""
    with contextlib.suppress(OSError):  # it has just ended
        if hasattr(os, "killpg"):
            os.killpg(running.pid, signal.SIGKILL)
        else:
            running.kill()
    with contextlib.suppress(subprocess.TimeoutExpired):
        running.wait(END_TIMEOUT_SECONDS)


def _text(file: Any) -> str:
    file.seek(0)
    return file.read().decode(errors="replace")


def _not_run(output: str, seconds: float) -> dict[str, Any]:
    error = "\n".join(output.splitlines()[-SHOWN_LINES:])
    return _tests(0, ["the tests did not run"], seconds) | {"error": error}


def _tests(passed: int, failed: list[str], seconds: float) -> dict[str, Any]:
    command = " ".join(COMMAND)
    return {
        "command": command,
        "passed": passed,
        "failed": failed,
        "seconds": seconds,
        "error": "",
    }


def gpu_check_command(
    out: Annotated[Path, option("--out", help="Folder for the report.")] = Path("out/gpu-check"),
    garden: GardenOption = None,
    capture: CaptureOption = None,
    seconds: SecondsOption = 2.0,
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
