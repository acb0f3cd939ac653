//! From where a scene is looked at when nobody has said.

use std::path::{Path, PathBuf};

use glam::DVec3;
use splat_render::Result;
use splat_render::constants::NEAR;

use crate::arguments::Arguments;
use crate::capture::{CaptureCamera, find_cameras, read_cameras};
use crate::model::Model;
use crate::viewpoint::{Viewpoint, up_of};

/// What is up where no camera says: COLMAP's and so most captures' y is down.
const UP: DVec3 = DVec3::NEG_Y;
/// The near plane of small scenes, in parts of their radius.
const NEAR_PART: f64 = 0.05;

/// A capture's cameras, those that were named or those that lie in or beside a scene. Cameras that
/// nobody named and that cannot be read are left out, with a sentence.
pub fn cameras_of(
    named: Option<&Path>,
    scene: Option<&Path>,
) -> Result<(Vec<CaptureCamera>, Option<String>)> {
    if let Some(path) = named {
        return Ok((read_cameras(path)?, None));
    }
    match scene.and_then(beside) {
        None => Ok((Vec::new(), None)),
        Some(path) => Ok(match read_cameras(&path) {
            Ok(cameras) => (cameras, None),
            Err(error) => (Vec::new(), Some(format!("{error}; no cameras are shown"))),
        }),
    }
}

/// The cameras in a scene's folder, or in the folder that a round's folder is in.
fn beside(scene: &Path) -> Option<PathBuf> {
    if scene.is_dir() {
        return find_cameras(scene);
    }
    let folder = scene.parent()?;
    let folder = if folder.as_os_str().is_empty() { Path::new(".") } else { folder };
    find_cameras(folder)
}

/// What is up: as said, as the cameras have it, or as most captures do.
pub fn up(arguments: &Arguments, cameras: &[CaptureCamera]) -> DVec3 {
    let said = arguments.up.map(DVec3::from);
    said.or_else(|| up_of(cameras.iter().map(|c| &c.camera))).unwrap_or(UP)
}

/// The near plane of a scene: the renderer's, but nearer for scenes so small that it would lie beyond
/// them. All of a scene is seen from about three times its radius.
pub fn near(model: &Model) -> f32 {
    let own = (NEAR_PART * model.radius) as f32;
    own.clamp(f32::MIN_POSITIVE, NEAR)
}

/// The first view of a scene: the capture's first camera, else all of the scene.
pub fn first_view(model: &Model, cameras: &[CaptureCamera], up: DVec3, fov: f64) -> Viewpoint {
    match cameras.first() {
        Some(first) => Viewpoint::of_camera(&first.camera, model.center, model.radius),
        None => Viewpoint::framing(model.center, model.radius, up, fov),
    }
}
