"""The runs of ``same_bits.py``: small and seeded, by public functions and the command line."""

from __future__ import annotations

import contextlib
import dataclasses
import inspect
import json
import os
import platform
import subprocess
import sys
import tempfile
import time
import traceback
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch

import igsr
from igsr import _core
from igsr.denoiser import photo_sources, photo_support, render_buffers
from igsr_lab.presets import preset_keywords
from igsr_lab.same_bits.hashes import Results, digest, named_numbers, pixels, prefixed, read_json
from igsr_lab.same_bits.photos import (
    camera_at,
    made_up_splats,
    with_wall,
    write_ball,
    write_bent,
    write_plain_photos,
    write_room,
)

#: The pictures that a refinement writes of each novel view, by the names that this script uses.
VIEW_PICTURES = {
    "render": ("before",),
    "cleaned": ("after",),
    "confidence": ("confidence", "trust"),  # the name now, and that of igsr 0.1
}
#: Endings of all files that splats are written to.
FORMATS = (".ply", ".compressed.ply", ".splat", ".spz", ".sog", ".glb", ".gltf")
#: The command line, run by the interpreter that runs this.
COMMAND = (sys.executable, "-m", "igsr.cli")

WHITE = (1.0, 1.0, 1.0)
GRAY = (0.5, 0.5, 0.5)


@dataclasses.dataclass
class Inputs:
    """Shared by all parts of the run.

    Attributes:
        folder: for output.
        ball: splats that the photos of ``around`` show.
        around: capture of photos with alpha, in the folder ``around``.
        room: capture of photos without alpha, with points and tracks, in the folder ``room``.
        bent: capture of photos through a lens, with masks.
        gpu: whether a GPU, or a software driver for one, answers.
    """

    folder: Path
    ball: igsr.Splats
    around: igsr.Capture
    room: igsr.Capture
    bent: igsr.Capture
    gpu: bool

    @property
    def fitting(self) -> list[str]:
        """The backends that fit."""
        return ["cpu", "gpu"] if self.gpu else ["cpu"]


def made_inputs(folder: Path, gpu: bool) -> Inputs:
    """Make the photos and load them."""
    ball = made_up_splats(220, seed=1)
    return Inputs(
        folder,
        ball,
        igsr.load_capture(write_ball(folder / "around", ball)),
        igsr.load_capture(write_room(folder / "room", with_wall(ball, seed=2))).with_holdout(5),
        igsr.load_capture(write_bent(folder / "bent", with_wall(ball, seed=3))),
        gpu,
    )


def captures(inputs: Inputs) -> Results:
    """Captures as they are loaded."""
    for name in ("around", "room", "bent"):
        capture = getattr(inputs, name)
        for view in capture.views:
            yield (
                f"{name}.{Path(view.name).stem}.{view.split}",
                [view.camera, view.image, view.mask],
            )
        points = capture.points
        if points is not None:
            tracks = points.tracks
            yield f"{name}.points", [points.xyz, points.rgb, points.confidence]
            yield f"{name}.tracks", [tracks.view, tracks.point, tracks.xy]


def fits(inputs: Inputs) -> Results:
    """Fits on the CPU with every kind of density control, initialization and preset."""
    around, room = inputs.around, inputs.room
    small: dict[str, Any] = {"steps": 700, "max_splats": 900, "seed": 3}
    for density in ("mcmc", "original", "fixed"):
        steps = 1100 if density == "original" else 700
        yield f"density {density}", fitted(around, **small | {"density": density, "steps": steps})
    yield (
        "opacity reset, sh degree 4",
        fitted(
            around,
            **small | {"density": "original", "steps": 6100, "max_splats": 250, "sh_degree": 4},
        ),
    )
    for start in ("points", "depths", "rays", "random"):
        options = small | {"steps": 120, "density": "original"}
        yield f"initialization {start}", fitted(room, **options, start=start)
    yield "initialization hull", fitted(around, **small | {"steps": 120}, start="hull")
    without_points = igsr.Capture(room.path, room.views)
    dense = small | {"steps": 40, "density": "fixed"}
    yield "initialization auto, no points", fitted(without_points, **dense)
    for name, every in (("near", 1), ("far apart", 2)):
        few = igsr.Capture(around.path, [opaque(view) for view in around.train_views[::every]])
        yield f"initialization rays, {name}", fitted(few, **small | {"steps": 60}, start="rays")
    yield "initialization auto, far apart", fitted(few, **small | {"steps": 60})
    yield "dropout", fitted(around, **small, density="mcmc", dropout=0.4)
    yield "no dropout", fitted(around, **small, density="mcmc", dropout=0.0)
    yield "sh degree 0", fitted(around, **small | {"steps": 100}, sh_degree=0)
    yield "background", fitted(room, **small | {"steps": 100}, background=(0.2, 0.4, 0.6))
    yield "masks", fitted(inputs.bent, **small | {"steps": 350})
    for preset in ("3dgs", "instantsplat"):
        few = {"steps": 350, "max_splats": 1200, "seed": 5}
        yield f"preset {preset}", fitted(around, **preset_keywords(preset, around) | few)
    weighted = [
        pseudo_view(view) if number % 3 == 1 else view
        for number, view in enumerate(around.train_views)
    ]
    mixed = igsr.Capture(around.path, weighted)
    yield "weights", fitted(mixed, **small | {"steps": 400})
    begun, _ = fit(around, 200, backend="cpu", max_splats=600, seed=9)
    yield "from splats", fitted(mixed, 150, max_splats=700, start=begun, seed=4)


def fitted(capture: igsr.Capture, *arguments: Any, **options: Any) -> list[Any]:
    """The splats of a fit and its last loss."""
    options = {"backend": "cpu", **options}
    result = igsr.fit(capture, *arguments, **options)
    return [result.splats, result.loss]


def fit(capture: igsr.Capture, *arguments: Any, **options: Any) -> tuple[igsr.Splats, igsr.Capture]:
    """Splats and fitted cameras by ``igsr.fit``."""
    result = igsr.fit(capture, *arguments, **options)
    return result.splats, result.capture


def opaque(view: igsr.View) -> igsr.View:
    """A photo with alpha as one over gray without."""
    alpha = view.image[..., 3:].astype(np.uint16)
    mixed = (view.image[..., :3] * alpha + 128 * (255 - alpha) + 127) // 255
    return replace(view, image=mixed.astype(np.uint8))


def pseudo_view(view: igsr.View) -> igsr.View:
    """A photo as a made-up picture over white."""
    image = view.image[..., :3].copy()
    weights = weights_of(view)
    return igsr.PseudoView(
        view.name, view.camera, view.split, image, view.mask, weights=weights, background=WHITE
    )


def weights_of(view: igsr.View) -> np.ndarray:
    """How much pixels count, more and more from left to right."""
    shape = view.image.shape[:2]
    return np.broadcast_to(np.linspace(0.0, 0.9, shape[1], dtype=np.float32), shape).copy()


def gpu_fits(inputs: Inputs) -> Results:
    """Fits on the GPU: each density control, dropout, and joint poses."""
    if not inputs.gpu:
        return
    small: dict[str, Any] = {"backend": "gpu", "max_splats": 500, "seed": 3}
    for density, steps in (("mcmc", 420), ("original", 620), ("fixed", 60)):
        yield density, fitted(inputs.around, steps, density=density, **small)
    yield "dropout", fitted(inputs.around, 320, dropout=0.4, **small)
    splats, capture = fit(inputs.room, 40, poses="joint", focal="shared", **small)
    yield "joint poses", [splats, *cameras_of(capture)]


def cameras_of(capture: igsr.Capture) -> list[igsr.Camera]:
    """The cameras of all views."""
    return [view.camera for view in capture.views]


def poses(inputs: Inputs) -> Results:
    """Fits of cameras with the splats, with pose priors from tracks and without."""
    room = inputs.room
    assert room.points is not None
    no_tracks = replace(room.points, tracks=None)
    for name, points in (("tracks", room.points), ("no tracks", no_tracks)):
        capture = igsr.Capture(room.path, room.views, points)
        for joint, focal in (
            ("joint", "fixed"),
            ("joint", "shared"),
            ("joint", "per-camera"),
            ("fixed", "shared"),
        ):
            splats, found = fit(
                capture, 160, backend="cpu", seed=1, max_splats=900, poses=joint, focal=focal
            )
            yield f"{joint}, focal {focal}, {name}", [splats, *cameras_of(found)]
    splats, _ = fit(room, 150, backend="cpu", max_splats=900, seed=2)
    found = igsr.refine_cameras(splats, room.test_views, (0.0, 0.0, 0.0), backend="cpu")
    yield "refined cameras of test photos", [view.camera for view in found]


def resumed(inputs: Inputs) -> Results:
    """Fits that were stopped and resumed, and uninterrupted fits."""
    for backend in inputs.fitting:
        for name, capture, options in (
            ("fixed poses", inputs.around, {"steps": 500, "density": "mcmc"}),
            ("joint poses", inputs.room, {"steps": 80, "poses": "joint"}),
        ):
            if backend == "gpu":
                options = options | {"steps": 60}
            path = inputs.folder / f"{backend} {name}"
            given: dict[str, Any] = {
                "backend": backend,
                "seed": 6,
                "max_splats": 400,
                "out": path,
                **options,
            }
            at = given["steps"] // 3

            def stop(event: igsr.Event, at: int = at) -> None:
                if event.stage == "fit" and event.done >= at:
                    raise KeyboardInterrupt

            with contextlib.suppress(KeyboardInterrupt):
                fit(capture, progress=stop, **given)
            splats, found = fit(capture, resume=True, **given)
            yield f"{backend}, {name}", [splats, *cameras_of(found)]


def refinements(inputs: Inputs) -> Results:
    """Refinements: two rounds, a harmful denoiser, and a run that is resumed."""
    options: dict[str, Any] = {"steps": 600, "backend": "cpu", "seed": 0}
    cleaner = Truthful(inputs.ball)
    colors = np.full((len(inputs.ball), 3), 128, np.uint8)
    points = igsr.Points(inputs.ball.means.astype(np.float64), colors)
    views = inputs.around.train_views[::2] + inputs.around.test_views
    capture = igsr.Capture(inputs.around.path, views, points)
    out = inputs.folder / "two rounds"
    refined = igsr.refine(capture, 2, denoiser=cleaner, out=out, **options)
    yield "two rounds.splats", [refined.first, refined.splats, len(refined.rounds)]
    yield from prefixed("two rounds", refinement_files(out))
    out = inputs.folder / "resumed"
    igsr.refine(capture, 1, denoiser=cleaner, out=out, **options)
    refined = igsr.refine(capture, 2, denoiser=cleaner, out=out, resume=True, **options)
    yield "resumed.splats", [refined.first, refined.splats, len(refined.rounds)]
    out = inputs.folder / "harmful"
    refined = igsr.refine(capture, "auto", denoiser=inverted, out=out, **options)
    yield "harmful.splats", [refined.first, refined.splats, len(refined.rounds)]
    yield from prefixed("harmful", refinement_files(out))


class Truthful:
    """A denoiser that knows the scene."""

    def __init__(self, splats: igsr.Splats) -> None:
        """Keep the scene."""
        self.splats = splats

    def __call__(self, render: Any, photos: Sequence[Any]) -> tuple[np.ndarray, np.ndarray]:
        """The true picture and a high confidence."""
        color = igsr.render(self.splats, render.camera, WHITE, backend="cpu").color
        return np.clip(color, 0.0, 1.0), np.full(color.shape[:2], 0.95, np.float32)


def inverted(render: Any, photos: Sequence[Any]) -> tuple[np.ndarray, np.ndarray]:
    """A denoiser that makes all worse and is sure of it: no round is done."""
    color = np.clip(render.color, 0.0, 1.0)
    return 1.0 - color, np.ones(color.shape[:2], np.float32)


def refinement_files(out: Path) -> Results:
    """Files of a refinement: models, novel views, cameras and the report's numbers."""
    yield "scene.ply", out / "scene.ply"
    for folder in sorted((out / "rounds").iterdir()):
        if (folder / "scene.ply").is_file():
            yield f"round {folder.name}.scene.ply", folder / "scene.ply"
        for kind, endings in VIEW_PICTURES.items():
            found = sorted(path for end in endings for path in folder.glob(f"view-*.{end}.png"))
            if found:
                yield f"round {folder.name}.{kind}", [pixels(path) for path in found]
    if (out / "views.png").is_file():
        yield "views.png", pixels(out / "views.png")
    yield from prefixed("cameras", named_numbers(read_json(out / "cameras.json")))
    yield from prefixed("report", named_numbers(read_json(out / "report.json")))


def commands(inputs: Inputs) -> Results:
    """The command line: its files and the numbers that it reports."""
    out = inputs.folder / "cli"
    around, room = inputs.folder / "around", inputs.folder / "room"
    run("fit", around, "--out", out / "fit", "--steps", 400, "--max-splats", 800, "--seed", 7)
    yield from prefixed("fit", fit_files(out / "fit"))
    run(
        *("fit", room, "--out", out / "joint", "--holdout", 4, "--poses", "joint"),
        *("--focal", "shared", "--steps", 120, "--max-splats", 600),
    )
    yield from prefixed("fit with joint poses", fit_files(out / "joint"))
    run("refine", room, "--out", out / "refine", "--rounds", 2, "--holdout", 4, "--steps", 150)
    yield from prefixed("refine", refinement_files(out / "refine"))
    scene = out / "fit" / "scene.ply"
    run("render", scene, "--cameras", around, "--exr", "--out", out / "exr")
    yield "render --exr", sorted((out / "exr").rglob("*.exr"))
    run("render", scene, "--cameras", around, "--out", out / "png")
    yield "render", [pixels(path) for path in sorted((out / "png").rglob("*.png"))]
    run("convert", scene, out / "scene.spz")
    yield "convert", out / "scene.spz"


def fit_files(out: Path) -> Results:
    """Files of a fit: the model, the contact sheet, cameras and the report's numbers."""
    yield "scene.ply", out / "scene.ply"
    yield "views.png", pixels(out / "views.png")
    yield from prefixed("cameras", named_numbers(read_json(out / "cameras.json")))
    yield from prefixed("report", named_numbers(read_json(out / "report.json")))


def run(command: str, *arguments: Any) -> str:
    """Run ``igsr`` of the same tree, on the CPU where the command has the choice; its output."""
    backend = () if command in ("convert", "pose") else ("--backend", "cpu")
    words = [*COMMAND, command, *map(str, arguments), *backend]
    # A folder igsr where this was started must not be taken for it.
    place = {"PYTHONPATH": str(Path(igsr.__file__).resolve().parents[1])}
    done = subprocess.run(
        words,
        env=os.environ | place,
        cwd=tempfile.gettempdir(),
        capture_output=True,
        text=True,
        check=False,
    )
    if done.returncode:
        raise RuntimeError(f"{' '.join(words)} failed:\n{done.stderr}")
    return done.stdout


def compactions(inputs: Inputs) -> Results:
    """Smaller models, by photos and without."""
    splats, _ = fit(inputs.around, 400, backend="cpu", max_splats=500, seed=8)
    for name, options in (
        ("by photos", {"capture": inputs.around, "max_loss": 0.5, "steps": 60}),
        ("by itself", {"max_loss": 0.4, "psnr": 60.0, "sh_degree": 0, "steps": 12}),
    ):
        found = igsr.compact(splats, backend="cpu", seed=1, **options)
        yield f"{name}.splats", found.splats
        yield from prefixed(f"{name}.report", named_numbers(found.report))


def formats(inputs: Inputs) -> Results:
    """Splats in every format, as they are written and as they are read back."""
    tall = made_up_splats(150, seed=4, degree=3)
    tall = replace(tall, origin=np.array([10.0, -20.0, 30.0]))
    for name, splats in (("degree 1", inputs.ball), ("degree 3", tall)):
        for ending in FORMATS:
            path = inputs.folder / "formats" / name / f"scene{ending}"
            splats.save(path)
            yield f"{name}.{ending}.written", path
            yield f"{name}.{ending}.read", igsr.Splats.load(path)


def renders(inputs: Inputs) -> Results:
    """Color, alpha, depth, normals and 8-bit pictures by each backend."""
    scene = with_wall(inputs.ball, seed=2)
    antialiased = replace(scene, antialiased=True, origin=np.array([0.5, 0.0, -0.25]))
    for backend in ("reference", *inputs.fitting):
        for number, (right, up, width, height) in enumerate(((0, 0, 97, 61), (70, 20, 128, 128))):
            camera = camera_at(right, up, width, height)
            found = igsr.render(scene, camera, GRAY, backend=backend)
            yield f"{backend}.view {number}.color", [found.color, found.to_uint8()]
            yield f"{backend}.view {number}.alpha", [found.alpha, found.transmittance]
            yield f"{backend}.view {number}.depth", [found.depth, found.expected_depth]
            found = igsr.render(antialiased, camera, backend=backend)
            yield f"{backend}.view {number}.antialiased", found
        with torch.no_grad():
            _, _, meta = rasterized(inputs.ball, backend, normals=True)
        yield f"{backend}.normals", meta["render_normals"]


def rasterized(
    splats: igsr.Splats, backend: str, *, normals: bool = False, **options: Any
) -> tuple[torch.Tensor, torch.Tensor, dict[str, Any]]:
    """Two cameras' pictures by ``igsr.rasterization``; ``options`` replace what is given."""
    cameras = [camera_at(10.0, 5.0, 70, 52), camera_at(60.0, -8.0, 70, 52)]
    given: dict[str, Any] = {
        **tensors_of(splats),
        "viewmats": torch.tensor(np.stack([camera.viewmat for camera in cameras])),
        "Ks": torch.tensor(np.stack([camera.K for camera in cameras])),
        "width": 70,
        "height": 52,
        "sh_degree": splats.sh_degree,
        "backend": backend,
    }
    if normals:  # an option by either name
        known = inspect.signature(igsr.rasterization).parameters
        given["render_normals" if "render_normals" in known else "return_normals"] = True
    colors, alphas, meta = igsr.rasterization(**given | options)
    return colors, alphas, meta


def tensors_of(splats: igsr.Splats) -> dict[str, torch.Tensor]:
    """Splats as ``igsr.rasterization`` takes them."""
    return {
        "means": torch.from_numpy(splats.means.copy()),
        "quats": torch.from_numpy(splats.quats.copy()),
        "scales": torch.from_numpy(np.exp(splats.scales)),
        "opacities": torch.from_numpy(1.0 / (1.0 + np.exp(-splats.opacities))),
        "colors": torch.from_numpy(splats.sh.copy()),
    }


def gradients(inputs: Inputs) -> Results:
    """Pictures and gradients of ``igsr.rasterization``, by all that it is differentiable in."""
    backgrounds = torch.tensor([[0.1, 0.5, 0.9], [0.8, 0.3, 0.2]])
    modes: dict[str, dict[str, Any]] = {
        "RGB+ED": {"render_mode": "RGB+ED", "packed": False},
        "packed, absgrad": {"absgrad": True},
        "antialiased": {"rasterize_mode": "antialiased", "render_mode": "RGB+D"},
        "normals": {"normals": True},
    }
    for backend in ("reference", *inputs.fitting):
        for mode, options in modes.items():
            leaves = {**tensors_of(inputs.ball), "backgrounds": backgrounds.clone()}
            cameras = [camera_at(10.0, 5.0, 70, 52), camera_at(60.0, -8.0, 70, 52)]
            leaves["viewmats"] = torch.tensor(np.stack([camera.viewmat for camera in cameras]))
            leaves["Ks"] = torch.tensor(np.stack([camera.K for camera in cameras]))
            for leaf in leaves.values():
                leaf.requires_grad_()
            colors, alphas, meta = rasterized(inputs.ball, backend, **options, **leaves)
            meta["means2d"].retain_grad()
            normals = [meta["render_normals"]] if mode == "normals" else []
            pictures = [colors, alphas, *normals]
            loss = torch.zeros(())
            for number, picture in enumerate(pictures):
                weights = torch.from_numpy(
                    np.random.default_rng(number).normal(size=tuple(picture.shape))
                )
                loss = loss + (picture * weights).sum()
            loss.backward()
            yield f"{backend}.{mode}.pictures", pictures
            for name, leaf in leaves.items():
                yield f"{backend}.{mode}.{name}", leaf.grad
            yield f"{backend}.{mode}.means2d", meta["means2d"].grad
            if options.get("absgrad"):
                yield f"{backend}.{mode}.absolute means2d", meta["means2d"].absgrad


def scores(inputs: Inputs) -> Results:
    """Scores of splats on test and train photos."""
    rough = replace(inputs.ball, means=inputs.ball.means + np.float32(0.02))
    for backend in ("reference", *inputs.fitting):
        found = igsr.evaluate(rough, inputs.around, backend=backend)
        yield from prefixed(f"{backend}.test", named_numbers(found))
    for name, capture in (("masks", inputs.bent), ("room", inputs.room)):
        found = igsr.evaluate(rough, capture, "train", GRAY, backend="cpu")
        yield from prefixed(name, named_numbers(found))


def plain_photos(inputs: Inputs) -> Results:
    """Folders of photos without cameras: ``igsr pose``, ``fit`` and ``refine`` find them."""
    photos = write_plain_photos(inputs.folder / "plain")
    out = inputs.folder / "plain-out"
    report = json.loads(run("pose", photos, "--out", out / "pose", "--seed", 3, "--json"))
    yield from prefixed("pose", named_numbers(report))
    for path in sorted((out / "pose" / "sparse").rglob("*.*")):
        yield f"pose.{path.name}", path
    yield "pose.images", [pixels(path) for path in sorted((out / "pose" / "images").glob("*"))]
    smaller = ("--max-size", 160)
    run("fit", photos, "--out", out / "fit", "--steps", 120, "--max-splats", 900, *smaller)
    yield from prefixed("fit", fit_files(out / "fit"))
    # The cameras are kept, and used for photos of another size.
    run("fit", photos, "--out", out / "fit", "--steps", 60, "--max-splats", 700, "--holdout", 4)
    yield from prefixed("fit again", fit_files(out / "fit"))
    igsr.refine(
        photos,
        1,
        out=out / "refine",
        steps=100,
        max_size=160,
        exposure="on",
        backend="cpu",
    )
    yield from prefixed("refine", refinement_files(out / "refine"))
    found = igsr.find_cameras(photos, seed=1, max_size=200)
    yield "python", [[view.camera, view.image] for view in found.views]


def denoised(inputs: Inputs) -> Results:
    """Renders, cleaned by the denoiser of igsr without and with photos."""
    splats, _ = fit(inputs.around, 200, backend="cpu", max_splats=400, seed=1)
    camera = camera_at(33.0, 4.0, 80, 72)
    found = igsr.render(splats, camera, WHITE, backend="cpu")
    for name, given in (("render", found), ("picture", found.to_uint8())):
        yield name, list(igsr.denoise(given))
    photos = inputs.around.train_views
    support = photo_support(splats, photos, "cpu")
    buffers = render_buffers(splats, camera, support, WHITE, "cpu")
    yield "with photos", list(igsr.denoise(buffers, photo_sources(splats, photos, WHITE, "cpu")))


#: The parts of a run, by the first word of their results' names.
PARTS: dict[str, Callable[[Inputs], Results]] = {
    "capture": captures,
    "render": renders,
    "gradient": gradients,
    "format": formats,
    "score": scores,
    "denoise": denoised,
    "fit": fits,
    "poses": poses,
    "resume": resumed,
    "compact": compactions,
    "refine": refinements,
    "command": commands,
    "gpu_fit": gpu_fits,
    "photos": plain_photos,
}


def machine() -> dict[str, str | None]:
    """The environment on which the bits depend, apart from the code."""
    found: dict[str, str | None] = {
        "torch": torch.__version__,
        "numpy": np.__version__,
        "python": ".".join(platform.python_version_tuple()[:2]),
    }
    for backend in ("cpu", "gpu"):
        try:
            told = _core.backend_info(backend)
        except RuntimeError:
            told = {}
        found[f"{backend} device"] = told.get("device")
        found[f"{backend} instruction set"] = told.get("instruction_set")
    return found


def all_hashes(parts: Sequence[str], gpu: bool) -> dict[str, str]:
    """The hashes of all results of some parts, by name.

    A part that fails is reported on stderr, and its other results are missing.
    """
    hashes: dict[str, str] = {}
    with tempfile.TemporaryDirectory(prefix="same_bits_") as folder:
        inputs = made_inputs(Path(folder), gpu)
        for part in parts:
            began = time.perf_counter()
            try:
                for name, value in PARTS[part](inputs):
                    full = f"{part}.{name}"
                    if full in hashes:
                        raise ValueError(f"two results are called {full}")
                    hashes[full] = digest(value)
            except Exception:
                print(f"same_bits: {part} ended with an error:", file=sys.stderr)
                traceback.print_exc()
            print(f"{part}: {time.perf_counter() - began:.1f} s", file=sys.stderr)
    return hashes
