"""Memory of fits on a GPU does not grow with the steps."""

import subprocess
import sys
from pathlib import Path

import pytest

PROGRAM = """
import sys
sys.path.insert(0, {tests!r})
import scenes

def resident():
    return int(open("/proc/self/statm").read().split()[1]) * 4096 / 1e6

def fitted(steps):
    scenes.fit(
        capture, steps=steps, backend="gpu", max_splats=300, sh_degree=1, density="fixed",
        start="random", transients="off", remove_floaters=False,
    )

capture = scenes.capture(views=4, size=32)
fitted(20)
before = resident()
fitted(80)
print(resident() - before)
"""


@pytest.mark.skipif(not Path("/proc/self/statm").is_file(), reason="memory is read from Linux")
def test_steps_leak_no_memory():
    # In a new process, since other tests allocate and free memory.
    program = PROGRAM.format(tests=str(Path(__file__).parent))
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    # Kernels that were compiled again in each step took 2 MB.
    assert float(done.stdout.split()[-1]) < 16.0, done.stdout
