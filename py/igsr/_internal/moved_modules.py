"""Old module names, which still import for one release, with a ``DeprecationWarning``.

``igsr.presets`` is now ``igsr.fitting.presets``, and so on. A finder at the end of
``sys.meta_path`` answers for names that no file has any more; the module that it makes looks each
attribute up where it lives now.
"""

from __future__ import annotations

import contextlib
import importlib
import sys
import warnings
from collections.abc import Sequence
from importlib.machinery import ModuleSpec
from types import ModuleType
from typing import Any

#: Modules of igsr 0.1 by their old names, and where their contents are now.
MOVED: dict[str, tuple[str, ...]] = {
    "igsr.atomic_write": ("igsr._internal.atomic_write",),
    "igsr.camera_holds": ("igsr.fitting.pose_priors",),
    "igsr.capture.colmap": ("igsr.capture.read_colmap",),
    "igsr.capture.folder": ("igsr.capture.load",),
    "igsr.capture.transforms": ("igsr.capture.read_transforms",),
    "igsr.checkpoint": ("igsr.fitting.checkpoint",),
    "igsr.compaction.plot": ("igsr.compaction.plot_curve",),
    "igsr.compaction.refinement": ("igsr.compaction.finetuning",),
    "igsr.compaction.yardstick": ("igsr.compaction.validation",),
    "igsr.denoiser.losses": ("igsr.denoiser.training.losses",),
    "igsr.denoiser.pair_files": ("igsr.denoiser.training.pair_files",),
    "igsr.denoiser.pair_renders": ("igsr.denoiser.training.pair_renders",),
    "igsr.denoiser.pairs": ("igsr.denoiser.training.pairs",),
    "igsr.denoiser.perceptual": ("igsr.denoiser.training.perceptual_distance",),
    "igsr.denoiser.plot": ("igsr.training.plot_training",),
    "igsr.fitter": ("igsr.fitting.fitter",),
    "igsr.halved": ("igsr.capture.downscaling",),
    "igsr.initialization": (
        "igsr.fitting.initialization.initial_splats",
        "igsr.geometry.focus_point",
    ),
    "igsr.metrics": ("igsr.evaluation.metrics",),
    "igsr.normals": ("igsr.rendering.normals",),
    "igsr.npz_damage": ("igsr._internal.untrusted_npz",),
    "igsr.orbit": ("igsr.geometry.camera_paths",),
    "igsr.photo_checks": ("igsr.capture.photo_checks",),
    "igsr.plane_sweep": ("igsr.fitting.initialization.plane_sweep",),
    "igsr.pose.accuracy": ("igsr.geometry.pose_errors",),
    "igsr.pose.alignment.alignment": ("igsr.pose.alignment.global_alignment",),
    "igsr.pose.alignment.similarity": ("igsr.geometry.similarity",),
    "igsr.pose.alignment.start": ("igsr.pose.alignment.initial_alignment",),
    "igsr.pose.kept": ("igsr.pose.cache",),
    "igsr.pose.plot": ("igsr.pose.plot_poses",),
    "igsr.poses": (
        "igsr.geometry.similarity",
        "igsr.geometry.pose_errors",
        "igsr.fitting.pose_refinement",
    ),
    "igsr.presets": ("igsr.fitting.presets",),
    "igsr.rasterization": ("igsr.rendering.rasterization",),
    "igsr.rasterization_arguments": ("igsr.rendering.rasterization_arguments",),
    "igsr.refinement_page": ("igsr.refinement.html_page",),
    "igsr.refinement_report": ("igsr.refinement.report",),
    "igsr.report": (
        "igsr.evaluation.contact_sheet",
        "igsr.capture.write_cameras",
        "igsr._internal.json_file",
    ),
    "igsr.selection": ("igsr.refinement.selection",),
    "igsr.sift_points": ("igsr.fitting.initialization.sift_points",),
    "igsr.study.fits": ("igsr.study.scored_fits",),
    "igsr.study.poor_fit_pictures": ("igsr.study.denoiser_plots", "igsr.study.picture_sheet"),
    "igsr.study.poor_fits": (
        "igsr.study.denoiser_comparison",
        "igsr.study.degraded_fits",
        "igsr.study.cleaned_renders",
        "igsr.study.denoiser_report",
    ),
    "igsr.study.refinement_protocols": ("igsr.study.loop_protocols",),
    "igsr.study.refinement_tables": ("igsr.study.loop_tables",),
    "igsr.study.refinements": ("igsr.study.loop_runs", "igsr.study.loop_methods"),
    "igsr.study.runs": ("igsr._internal.resumable_jobs",),
    "igsr.study.views": ("igsr.study.splits",),
    "igsr.video": ("igsr.rendering.video",),
    "igsr.views": ("igsr.refinement.novel_views",),
    "igsr.worker_processes": ("igsr._internal.worker_processes",),
}
#: Functions that have another name now, by module and old name.
RENAMED = {
    ("igsr.camera_holds", "CameraHolds"): "PosePriors",
    ("igsr.camera_holds", "camera_holds"): "pose_priors",
    ("igsr.compaction.refinement", "chosen"): "subset",
    ("igsr.compaction.yardstick", "Verdict"): "ValidationScore",
    ("igsr.compaction.yardstick", "Yardstick"): "Validation",
    ("igsr.compaction.yardstick", "own_yardstick"): "self_validation",
    ("igsr.compaction.yardstick", "photo_yardstick"): "photo_validation",
    ("igsr.study.refinements", "Given"): "StudySpec",
    ("igsr.study.refinements", "Refinement"): "RunSpec",
    ("igsr.study.refinements", "Rounds"): "Method",
    ("igsr.initialization", "looked_at"): "focus_point",
    ("igsr.report", "write_report"): "write_json",
    ("igsr.study.poor_fits", "PoorFit"): "DegradedFit",
    ("igsr.study.poor_fits", "poor_capture"): "degraded_capture",
}


class _Moved(ModuleType):
    """An old module: its attributes are those of the modules that took its place."""

    def __getattr__(self, name: str) -> Any:
        wanted = RENAMED.get((self.__name__, name), name)
        # Import machinery asks for dunder names that no module has.
        if not (name.startswith("__") and name.endswith("__")):
            for home in MOVED[self.__name__]:
                with contextlib.suppress(AttributeError):
                    return getattr(importlib.import_module(home), wanted)
        raise AttributeError(f"module {self.__name__!r} has no attribute {name!r}")

    def __call__(self, *args: Any, **kwargs: Any) -> Any:
        """``igsr.rasterization`` stays a function where its old module was imported."""
        return getattr(self, self.__name__.rpartition(".")[2])(*args, **kwargs)


class _Finder:
    """Finder and loader of old names, without ``importlib.abc``, whose import takes 20 ms."""

    def find_spec(
        self, fullname: str, path: Sequence[str] | None = None, target: ModuleType | None = None
    ) -> ModuleSpec | None:
        return ModuleSpec(fullname, self) if fullname in MOVED else None  # type: ignore[arg-type]

    def create_module(self, spec: ModuleSpec) -> ModuleType:
        return _Moved(spec.name)

    def exec_module(self, module: ModuleType) -> None:
        name = module.__name__
        warnings.warn(
            f"{name} is now {' and '.join(MOVED[name])}; the old name goes with the next release.",
            DeprecationWarning,
            stacklevel=2,
        )


def install() -> None:
    """Answer for the old names; once, however often it is called."""
    if not any(isinstance(finder, _Finder) for finder in sys.meta_path):
        sys.meta_path.append(_Finder())
