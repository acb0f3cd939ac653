"""``igsr view``: starts splat-view, or says how to get it."""

from __future__ import annotations

import os
import subprocess
import sys

import pytest

VIEW = [sys.executable, "-m", "igsr.cli", "view"]

#: Stands in for splat-view: writes what it was given, one a line, and ends with 3.
STAND_IN = f"""#!{sys.executable}
import sys
print(*sys.argv[1:], sep="\\n")
sys.exit(3)
"""


def view(path, *arguments):
    return subprocess.run(
        [*VIEW, *map(str, arguments)],
        env={**os.environ, "PATH": str(path)},
        capture_output=True,
        text=True,
        timeout=60,
    )


def test_without_splat_view_one_sentence_says_how_to_get_it(tmp_path):
    result = view(tmp_path, "scene.ply")
    assert result.returncode == 1
    assert result.stdout == ""
    assert "cargo install --locked --path crates/splat_view" in result.stderr
    lines = [line for line in result.stderr.splitlines() if "XDG_RUNTIME_DIR" not in line]
    assert len(lines) == 1, result.stderr
    assert lines[0].endswith("."), result.stderr


@pytest.mark.skipif(os.name == "nt", reason="the stand-in is a script with a #! line")
def test_splat_view_gets_scenes_and_options_as_given_and_its_exit_status_counts(tmp_path):
    program = tmp_path / "splat-view"
    program.write_text(STAND_IN)
    program.chmod(0o755)
    given = ["a dir", "--camera", "3", "b.ply", "--near", "0.5"]
    result = view(tmp_path, *given)
    assert result.stdout.splitlines() == given, result.stderr
    assert result.returncode == 3
