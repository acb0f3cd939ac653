"""Short parts for tests of ``igsr_lab.limited_parts``; their processes import this file."""

import os
import subprocess
import sys
import time
from pathlib import Path

ROW = {
    "workload": "made up",
    "pass": "",
    "backend": "gpu",
    "splats": 1,
    "width": 8,
    "height": 8,
    "ms": 1.0,
    "max_error": None,
    "mean_error": None,
}


def variable(name):
    yield {"rows": [{**ROW, "pass": f"{name} is {os.environ[name]}"}]}


def fails():
    yield {"rows": [{**ROW, "pass": "before the error"}]}
    raise RuntimeError("the <device> is lost")


def hangs(sign):
    """A child writes to the file ``sign`` until it is killed."""
    yield {"rows": [{**ROW, "pass": "before the hang"}]}
    code = f"import time\nwhile True: open({str(sign)!r}, 'a').write('.'); time.sleep(0.02)"
    subprocess.Popen([sys.executable, "-c", code])
    while not Path(sign).exists():
        time.sleep(0.02)
    time.sleep(600.0)


def leaves_a_row_out():
    yield {"rows": [ROW, {**ROW, "ms": None, "not_run": "it does not fit"}]}


def crashes():
    yield {}
    os._exit(7)


def not_a_number():
    yield {"rows": [{**ROW, "max_error": float("inf")}]}
