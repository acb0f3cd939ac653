"""Training curves, as a paper's figure of training and validation loss."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from igsr._internal.atomic_write import atomic_write
from igsr.errors import IgsrError

#: What a score is held against, as the end of its name: the same before what was trained is
#: applied, or of an answer that looks at nothing.
BESIDE = ("_before", "_constant")


def plot_training(log: Path, path: Path) -> list[dict[str, Any]]:
    """Plot every quantity of a training's log over its steps; returns the log's rows.

    Raises:
        IgsrError: the log cannot be read.
    """
    from matplotlib.figure import Figure

    try:
        rows = [json.loads(line) for line in log.read_text(encoding="utf-8").splitlines()]
    except (OSError, ValueError) as error:
        raise IgsrError(f"{log} cannot be read ({error}); train again.") from error
    names = list(dict.fromkeys(key for row in rows for key in row))
    # What a score is held against has no axis of its own: it lies beside the score, and what is
    # validated beside what is trained.
    drawn = [
        name
        for name in names
        if name not in ("step", "seconds")
        and not name.endswith(BESIDE)
        and name.removeprefix("validation_") not in set(names) - {name}
    ]
    if not drawn:
        raise IgsrError(f"{log} holds nothing to plot; train again.")
    figure = Figure(figsize=(10.0, 2.4 * -(-len(drawn) // 2)), layout="constrained")
    axes = figure.subplots(-(-len(drawn) // 2), 2, squeeze=False).ravel()
    for axis in axes[len(drawn) :]:
        axis.remove()
    for axis, name in zip(axes, drawn, strict=False):
        drawn_here = [
            (f"{one}{end}", style)
            for one in (name, f"validation_{name}")
            for end, style in (("", "-"), *((end, "--") for end in BESIDE))
        ]
        for key, style in drawn_here:
            known = [(row["step"], row[key]) for row in rows if key in row]
            if known:
                # A line of one point would not show.
                marker = "o" if len(known) == 1 else ""
                axis.plot(*zip(*known, strict=True), style + marker, label=key.replace("_", " "))
        axis.set_xlabel("step")
        axis.grid(alpha=0.3)
        axis.legend(fontsize=8)
    with atomic_write(path) as temporary:
        figure.savefig(temporary, format="png", dpi=120)
    return rows
