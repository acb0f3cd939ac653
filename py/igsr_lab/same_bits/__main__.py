"""Compare the results of igsr before and after a change, bit for bit.

    python -m igsr_lab.same_bits record before.json     # with the code before the change
    python -m igsr_lab.same_bits check before.json      # with the code after it

The runs are small, seeded and use synthetic photos: fits, refinements, compactions, renders,
gradients, scores and files, through public functions and the command ``igsr``. The JSON file has
the SHA-256 of each result by name. ``check`` prints whether each result is the same, and exits with
1 if one changed or is missing. It takes minutes; ``--only fit render`` runs some parts.

Bits are repeatable on one machine only, so the file records its devices, instruction set and
versions, and ``check`` refuses a file with different ones. Without a GPU driver, results of the GPU
are left out. ``PYTHONPATH=/other/py`` runs the code of another folder.
"""

from __future__ import annotations

import argparse
import json
import os
import sys
import warnings
from collections.abc import Sequence
from pathlib import Path

#: Sums depend on the number of threads, which libraries read when they are loaded. Mesa's device
#: selection layer would wait for a display.
ENVIRONMENT = {
    "RAYON_NUM_THREADS": "2",
    "OMP_NUM_THREADS": "1",
    "OPENBLAS_NUM_THREADS": "1",
    "MKL_NUM_THREADS": "1",
    "NODEVICE_SELECT": "1",
}


def record(path: Path, parts: Sequence[str]) -> int:
    """Run the parts and write their hashes to a file."""
    import igsr
    from igsr_lab.same_bits.runs import all_hashes, machine

    found = machine()
    hashes = all_hashes(parts, found["gpu device"] is not None)
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(json.dumps({"machine": found, "hashes": hashes}, indent=1) + "\n")
    print(f"{len(hashes)} results recorded in {path}, of igsr in {Path(igsr.__file__).parent}")
    return 0


def check(path: Path, parts: Sequence[str]) -> int:
    """Run the parts and compare with a file; return 1 if a hash differs or is missing."""
    import igsr
    from igsr_lab.same_bits.runs import all_hashes, machine

    recorded = json.loads(path.read_text(encoding="utf-8"))
    before, after = recorded["machine"], machine()
    lines = [
        f"  {name}: {value} then, {after.get(name)} now"
        for name, value in before.items()
        if value != after.get(name)
    ]
    if lines:
        raise SystemExit(
            f"same_bits: {path} was recorded on another machine or with other versions, "
            "which change the bits:\n" + "\n".join(lines)
        )
    hashes = all_hashes(parts, after["gpu device"] is not None)
    wanted = {
        name: value for name, value in recorded["hashes"].items() if name.split(".")[0] in parts
    }
    states = {
        name: "missing" if name not in hashes else "same" if hashes[name] == value else "changed"
        for name, value in wanted.items()
    }
    states |= {name: "new" for name in hashes if name not in wanted}
    for name, state in states.items():
        print(f"{state:8} {name}")
    kinds = ("same", "changed", "missing", "new")
    counts = {kind: sum(state == kind for state in states.values()) for kind in kinds}
    summary = ", ".join(f"{count} {kind}" for kind, count in counts.items())
    print(f"{summary}, of igsr in {Path(igsr.__file__).parent}")
    return 1 if counts["changed"] or counts["missing"] else 0


def main() -> int:
    """Parse the command line and run."""
    os.environ.update(ENVIRONMENT)
    import torch

    from igsr_lab.same_bits.runs import PARTS

    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("action", choices=("record", "check"))
    parser.add_argument("file", type=Path, help="JSON file of hashes")
    parser.add_argument(
        "--only", nargs="+", choices=PARTS, default=list(PARTS), help="run these parts only"
    )
    given = parser.parse_args()
    torch.set_num_threads(1)
    warnings.simplefilter("ignore")
    return (record if given.action == "record" else check)(given.file, given.only)


if __name__ == "__main__":
    sys.exit(main())
