"""Old names of modules and functions still import for one release, with a DeprecationWarning."""

from __future__ import annotations

import importlib
import subprocess
import sys

import pytest

import igsr
from igsr._internal.moved_modules import MOVED

#: Public functions and classes of igsr 0.1 by the module that had them.
OLD_NAMES = {
    "igsr.atomic_write": "atomic_folder atomic_write check_folder check_writable remove_unfinished",
    "igsr.camera_holds": "CameraHolds camera_holds",
    "igsr.capture.colmap": "find_model load_colmap",
    "igsr.capture.folder": "holds_cameras load_capture",
    "igsr.capture.transforms": "load_split_transforms load_transforms",
    "igsr.checkpoint": "load_checkpoint save_checkpoint",
    "igsr.compaction.plot": "write_plot",
    "igsr.compaction.refinement": "chosen fresh_state refined splats_of with_sh_degree",
    "igsr.compaction.yardstick": "Verdict Yardstick loss_of_change own_yardstick photo_yardstick",
    "igsr.denoiser.losses": "Discriminator Loss Prediction charbonnier error_likelihood "
    "perceptual perceptual_ratio regret squared_ratio "
    "structure_ratio",
    "igsr.denoiser.pair_files": "Pairs packed read_pairs write_pairs",
    "igsr.denoiser.pair_renders": "check_one_size rendered_pairs",
    "igsr.denoiser.pairs": "PairFit capture_of_pairs make_pairs",
    "igsr.denoiser.perceptual": "SqueezeNetDistance distance_name lpips_distance picture_distance",
    "igsr.denoiser.plot": "plot_training",
    "igsr.fitter": "camera_rows fitted_cameras fitter_of with_camera_rows with_train_cameras",
    "igsr.halved": "halved",
    "igsr.initialization": "chosen_start initial_splats looked_at",
    "igsr.metrics": "flip ms_ssim psnr score ssim",
    "igsr.normals": "facing_normals",
    "igsr.npz_damage": "DAMAGE",
    "igsr.orbit": "cameras_around look_at orbit",
    "igsr.photo_checks": "check_photos",
    "igsr.plane_sweep": "can_sweep swept_points",
    "igsr.pose.accuracy": "pose_accuracy",
    "igsr.pose.alignment.alignment": "Alignment align",
    "igsr.pose.alignment.similarity": "apply is_spread similarity_of_points",
    "igsr.pose.alignment.start": "start",
    "igsr.pose.kept": "found_before kept_cameras not_placed photos_note",
    "igsr.pose.plot": "plot_poses",
    "igsr.poses": "Similarity pose_errors refine_cameras rotation_angle similarity_between",
    "igsr.presets": "PRESETS Preset preset_settings",
    "igsr.rasterization": "rasterization",
    "igsr.rasterization_arguments": "check_arguments",
    "igsr.refinement_page": "write_page",
    "igsr.refinement_report": "seconds_so_far write_refinement",
    "igsr.report": "contact_sheet error_picture rounds_sheet save_sheet "
    "sheet_names write_cameras write_report",
    "igsr.selection": "Candidate Passed candidate passed select trust_of",
    "igsr.sift_points": "sift_points",
    "igsr.study.fits": "Fit fitted run_fit",
    "igsr.study.poor_fit_pictures": "plot_confidence plot_gains write_sheet",
    "igsr.study.poor_fits": "Cleaning PoorFit denoiser_table markdown poor_capture "
    "run_cleaning run_fit scenes_in",
    "igsr.study.refinement_protocols": "refinement_ablation sweep table2 table3",
    "igsr.study.refinement_tables": "plot_rounds summarized write_table",
    "igsr.study.refinements": "Given Refinement Rounds run_refinement split",
    "igsr.study.runs": "Run file_hash finished_runs folder_hash",
    "igsr.study.views": "dtu_views llff_views localized scattered spread_out with_train_views",
    "igsr.video": "write_video",
    "igsr.views": "UnseenView unseen_views",
    "igsr.worker_processes": "worker_processes",
}
#: Names of igsr 0.1 in modules that are packages of the same name now.
OLD_NAMES_OF_PACKAGES = {
    "igsr.evaluation": "BLACK WHITE check_masks default_background default_split known_background "
    "over_background views_of_split",
    "igsr.rendering": "intrinsics_of project viewmat_about",
}


@pytest.fixture
def forgotten(monkeypatch):
    """Imports an old module as if for the first time; nothing of it stays imported."""

    def forget(name):
        parent, _, child = name.rpartition(".")
        importlib.import_module(parent)
        # Set first, so that the end of the test brings back what was there, or nothing.
        monkeypatch.setitem(sys.modules, name, None)
        monkeypatch.delitem(sys.modules, name)
        had = vars(sys.modules[parent])
        monkeypatch.setitem(had, child, had.get(child))
        if child not in igsr.__all__:
            monkeypatch.delitem(had, child)
        return name

    return forget


def test_the_list_is_of_all_moved_modules():
    assert set(OLD_NAMES) == set(MOVED)


@pytest.mark.parametrize("name", OLD_NAMES)
def test_old_modules_import_with_a_warning_and_have_their_names(name, forgotten):
    with pytest.warns(DeprecationWarning, match=f"{name} is now {MOVED[name][0]}") as warned:
        module = importlib.import_module(forgotten(name))
    assert len(warned) == 1
    for attribute in OLD_NAMES[name].split():
        assert getattr(module, attribute) is not None
    with pytest.raises(AttributeError, match="no attribute 'abacus'"):
        _ = module.abacus


@pytest.mark.parametrize("name", OLD_NAMES_OF_PACKAGES)
def test_old_names_of_packages_resolve_with_a_warning(name):
    package = importlib.import_module(name)
    for attribute in OLD_NAMES_OF_PACKAGES[name].split():
        with pytest.warns(DeprecationWarning, match=f"{name}.{attribute} is now {name}."):
            assert getattr(package, attribute) is not None
    with pytest.raises(AttributeError, match="no attribute 'abacus'"):
        _ = package.abacus


def test_rasterization_is_callable_as_the_function_and_as_its_old_module():
    code = (
        "import warnings; warnings.simplefilter('ignore')\n"
        "import inspect, igsr\n"
        "assert inspect.isfunction(igsr.rasterization)\n"
        "import igsr.rasterization\n"
        "from igsr.rendering.rasterization import rasterization\n"
        "assert igsr.rasterization.rasterization is rasterization\n"
        "try: igsr.rasterization(None, None, None, None, None, None, None, 8, 8)\n"
        "except ValueError as error: print(error)\n"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=120)
    assert done.stdout.startswith("means: must be a torch tensor"), done.stderr


def test_importing_igsr_alone_warns_of_nothing():
    code = "import igsr, igsr.cli"
    done = subprocess.run(
        [sys.executable, "-W", "error", "-c", code], capture_output=True, text=True, timeout=120
    )
    assert done.returncode == 0, done.stderr
