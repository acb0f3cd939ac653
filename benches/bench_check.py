"""Compare this checkout's build with that of a commit: fails where a row takes 10 % longer.

    python benches/bench_check.py [COMMIT]

The commit (by default the one before) is built in a worktree of its own, beside the checkout's
build folder, and both builds take turns in one run of ``igsr bench --compare``.
"""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
#: Percent.
SLOWER = 10


def build_of(commit: str, folder: Path) -> Path:
    """The compiled module of a commit, built with its own sources."""
    tree = folder / "tree"
    target = Path(os.environ.get("CARGO_TARGET_DIR", ROOT / "target")) / "bench-check"
    subprocess.run(["git", "worktree", "add", "--detach", tree, commit], cwd=ROOT, check=True)
    try:
        subprocess.run(
            ["cargo", "build", "--release", "--locked", "-p", "pyo3_bindings"],
            cwd=tree,
            env={**os.environ, "CARGO_TARGET_DIR": str(target), "PYO3_PYTHON": sys.executable},
            check=True,
        )
    finally:
        subprocess.run(["git", "worktree", "remove", "--force", tree], cwd=ROOT, check=True)
    built = next(
        target / "release" / name
        for name in ("lib_core.so", "lib_core.dylib")
        if (target / "release" / name).is_file()
    )
    # Python loads a module by the end of its name.
    return Path(shutil.copy(built, folder / "_core.abi3.so"))


def main() -> int:
    """The exit status of ``igsr bench --compare``."""
    commit = sys.argv[1] if len(sys.argv) > 1 else "HEAD~1"
    with tempfile.TemporaryDirectory() as folder:
        old = build_of(commit, Path(folder))
        bench = Path(sys.executable).parent / "igsr"
        words = ["bench", "--backend", "cpu", "--compare", old, "--fail-above", str(SLOWER)]
        return subprocess.run([bench, *words], check=False).returncode


if __name__ == "__main__":
    sys.exit(main())
