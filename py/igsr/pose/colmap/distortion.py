"""Lens distortion left out where photos fit nearly as well without."""

from __future__ import annotations

import copy
from typing import Any

from igsr._internal.load_pycolmap import load_pycolmap

#: Squared errors may grow by this factor for lenses to count as free of distortion: photos that are
#: not resampled stay sharp, and from few photos a distortion is often no more than a wrong focal.
DISTORTION_WORTH = 1.02


def without_distortion(model: Any) -> Any:
    """The model adjusted to lenses without distortion where that fits nearly as well."""
    pycolmap = load_pycolmap()
    if all(camera.params[3] == 0.0 for camera in model.cameras.values()):
        return model
    pinhole = copy.deepcopy(model)
    for camera in pinhole.cameras.values():
        camera.params = [*camera.params[:3], 0.0]
    options = pycolmap.BundleAdjustmentOptions()
    options.refine_extra_params = False
    options.refine_sensor_from_rig = False
    options.print_summary = False
    options.ceres.solver_options.num_threads = 1
    config = pycolmap.BundleAdjustmentConfig()
    for image_id in pinhole.reg_image_ids():
        config.add_image(image_id)
    for rig in pinhole.rigs.values():
        if rig.num_sensors() > 1:  # the views of a panorama, which are known
            for sensor in rig.sensor_ids():
                config.set_constant_cam_intrinsics(sensor.id)
    config.fix_gauge(pycolmap.BundleAdjustmentGauge.TWO_CAMS_FROM_WORLD)
    # pycolmap.bundle_adjustment writes to the log whatever its level.
    pycolmap.create_default_bundle_adjuster(options, config, pinhole).solve()
    needed = _squared_error(pinhole) > DISTORTION_WORTH * _squared_error(model)
    return model if needed else pinhole


def _squared_error(model: Any) -> float:
    model.update_point_3d_errors()
    return float(sum(p.error**2 * len(p.track.elements) for p in model.points3D.values()))
