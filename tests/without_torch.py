"""Python processes in which torch is not installed, as after ``pip install igsr``."""

import os
import subprocess
import sys

#: Packages of the extra ``refine``, and their dependencies.
BLOCKED = ("torch", "torchmetrics", "torchvision")

#: Python imports it when it starts, in child processes too.
SITE = f"""
import sys

class Blocked:
    def find_spec(self, name, path=None, target=None):
        if name.partition(".")[0] in {BLOCKED!r}:
            raise ModuleNotFoundError(f"No module named {{name!r}}", name=name)

sys.meta_path.insert(0, Blocked())
"""


def environment(folder):
    """Variables of a process without torch; writes a file that blocks it into the folder."""
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "sitecustomize.py").write_text(SITE)
    path = os.pathsep.join(filter(None, [str(folder), os.environ.get("PYTHONPATH")]))
    return {**os.environ, "PYTHONPATH": path}


def python(folder, *arguments, **options):
    """Run Python without torch."""
    return subprocess.run(
        [sys.executable, *map(str, arguments)],
        env=environment(folder / "site"),
        capture_output=True,
        text=True,
        timeout=300,
        **options,
    )


def igsr(folder, *arguments):
    """Run an ``igsr`` command without torch, in the folder."""
    return python(folder, "-m", "igsr.cli", *arguments, cwd=folder)
