"""Compare igsr with gsplat's stored picture and gradients of a four-splat scene.

The fixture (Brush's ``tiny_case_with_grads.safetensors``) has splats, gsplat's picture of them, and
gsplat's gradients for the stored upstream gradient. That version of gsplat detached the view
directions of the spherical harmonics, so the means' gradients are compared without that term:
colors are evaluated first and passed as RGB.

    python -m igsr_lab.bench.gsplat_fixture FIXTURE [--backend reference|cpu|gpu]
"""

from __future__ import annotations

import argparse

import numpy as np
from safetensors.numpy import load_file

from igsr import _core

WIDTH, HEIGHT = 123, 82


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("fixture", help="tiny_case_with_grads.safetensors")
    parser.add_argument("--backend", default="reference", choices=["reference", "cpu", "gpu"])
    arguments = parser.parse_args()
    fixture = load_file(arguments.fixture)
    dtype = np.float64 if arguments.backend == "reference" else np.float32

    def array(name: str) -> np.ndarray:
        return np.ascontiguousarray(fixture[name].astype(dtype))

    viewmat = np.eye(4)
    viewmat[:3, 3] = [-0.123, -0.456, 8.0]
    focal = 0.5 * WIDTH / np.tan(0.5 * np.pi / 2)
    camera = {
        "viewmat": viewmat,
        "intrinsics": np.array([focal, focal, 0.5 * WIDTH, 0.5 * HEIGHT]),
        "width": WIDTH,
        "height": HEIGHT,
        "near": 0.01,
        "far": 1e10,
        "eps2d": 0.3,
        "antialiased": False,
        "raw_parameters": True,
        "backend": arguments.backend,
    }
    shape = [array(name) for name in ("means", "quats", "scales", "opacities")]
    projected = _core.project(*shape, array("coeffs"), sh_degree=3, **camera)
    picture = {"background": np.zeros(3, dtype), "backend": arguments.backend}
    image = _core.rasterize(projected, width=WIDTH, height=HEIGHT, **picture)
    out = np.concatenate([image["color"], image["alpha"][..., None]], axis=2)
    difference = np.abs(out - fixture["out_img"])
    print(f"backend {arguments.backend}")
    print(f"picture   max {difference.max():.2e}  mean {difference.mean():.2e}   (bound 2e-5)")

    v_out = array("v_out_img")
    v_image = _core.rasterize_backward(
        projected,
        image,
        v_color=np.ascontiguousarray(v_out[..., :3]),
        v_alpha=np.ascontiguousarray(v_out[..., 3]),
        v_depth=np.zeros((HEIGHT, WIDTH), dtype),
        absolute=False,
        **picture,
    )
    with_sh = _core.project_backward(
        *shape, array("coeffs"), projected, v_image, sh_degree=3, **camera
    )
    detached = _core.project_backward(
        *shape, projected["colors"], projected, v_image, sh_degree=None, **camera
    )
    rows = {
        "v_xy": v_image["v_means2d"],
        "v_means": detached["v_means"],
        "v_quats": with_sh["v_quats"],
        "v_scales": with_sh["v_scales"],
        "v_opacities": with_sh["v_opacities"],
        "v_coeffs": with_sh["v_colors"],
    }
    for name, value in rows.items():
        expected = fixture[name]
        error = np.abs(value - expected).max() / np.abs(expected).max()
        print(f"{name:<12} {error:.2e} of the largest   (bound 1e-4)")


if __name__ == "__main__":
    main()
