"""Time one fit step: forward, loss, backward, optimiser, density control included.

Fits CAPTURE up to the wanted number of splats and then times the fit's own chunks of steps; prints
the fastest and the median, since machines are shared. The loss beside it says that the steps did
their work.

    python benches/fit_step.py CAPTURE [--splats 20000] [--steps 2000] [--backend cpu]
"""

from __future__ import annotations

import argparse
import json
import statistics

import igsr


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("capture")
    parser.add_argument("--splats", type=int, default=20_000)
    parser.add_argument("--steps", type=int, default=2000)
    parser.add_argument("--backend", default="auto", choices=["auto", "cpu", "gpu"])
    arguments = parser.parse_args()
    seen: list[igsr.Progress] = []
    igsr.fit(
        igsr.load_capture(arguments.capture),
        steps=arguments.steps,
        max_splats=arguments.splats,
        backend=arguments.backend,
        progress=lambda progress: seen.append(progress),
    )
    # The first chunks still grow the model; only what runs at full size counts.
    settled = [p for p in seen[len(seen) // 2 :] if p.splats >= 0.95 * arguments.splats]
    if not settled:
        raise SystemExit(f"the fit ended with {seen[-1].splats} splats, not {arguments.splats}")
    milliseconds = [1000.0 / p.steps_per_second for p in settled]
    print(
        json.dumps(
            {
                "capture": arguments.capture,
                "splats": settled[-1].splats,
                "ms_per_step_min": round(min(milliseconds), 2),
                "ms_per_step_median": round(statistics.median(milliseconds), 2),
                "loss": round(settled[-1].loss, 5),
                **settled[-1].backend,
            },
            indent=1,
        )
    )


if __name__ == "__main__":
    main()
