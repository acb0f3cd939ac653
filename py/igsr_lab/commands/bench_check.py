"""``python -m igsr_lab bench-check``: compare this build's speed with another commit's.

The commit is built in a temporary git worktree; ``bench --compare`` then runs both builds in turns.
"""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Annotated

import typer

ROOT = Path(__file__).resolve().parents[3]
#: The check fails if a row takes this much longer.
SLOWER_PERCENT = 10


def build_of(commit: str, folder: Path) -> Path:
    """Build the compiled module of a commit from its own sources."""
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
    # Python finds modules by the end of the name.
    return Path(shutil.copy(built, folder / "_core.abi3.so"))


def bench_check_command(
    commit: Annotated[
        str, typer.Argument(metavar="COMMIT", help="The commit to compare with.")
    ] = "HEAD~1",
) -> None:
    """Compare this build with COMMIT's; the exit status is 1 if a row takes 10 % longer."""
    with tempfile.TemporaryDirectory() as folder:
        old = build_of(commit, Path(folder))
        words = ["bench", "--backend", "cpu", "--compare", str(old)]
        words += ["--fail-above", str(SLOWER_PERCENT)]
        done = subprocess.run([sys.executable, "-m", "igsr_lab", *words], check=False)
    raise typer.Exit(done.returncode)
