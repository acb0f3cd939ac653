//! The command line's view of a scene, with its defaults.

use std::path::Path;

use glam::DVec3;
use splat_render::{Error, Result};

use crate::arguments::Arguments;
use crate::capture::{CaptureCamera, read_cameras};
use crate::model::Model;
use crate::surroundings::{background_beside, cameras_beside};
use crate::up_axis::up_of_splats;
use crate::viewpoint::{Viewpoint, up_of};

/// The named cameras, else the scene's fit's; a note reports unreadable ones.
pub fn cameras_of(
    named: Option<&Path>,
    scene: Option<&Path>,
) -> Result<(Vec<CaptureCamera>, Option<String>)> {
    if let Some(path) = named {
        return Ok((read_cameras(path)?, None));
    }
    match scene.and_then(cameras_beside) {
        None => Ok((Vec::new(), None)),
        Some(path) => Ok(match read_cameras(&path) {
            Ok(cameras) => (cameras, None),
            Err(error) => (Vec::new(), Some(format!("{error}; no cameras are shown"))),
        }),
    }
}

/// Background color: the command line's, else the fit's, else black.
pub fn background(arguments: &Arguments, scene: Option<&Path>) -> [f32; 3] {
    let said = arguments.background;
    said.or_else(|| scene.and_then(background_beside)).unwrap_or_default()
}

pub fn numbered(cameras: &[CaptureCamera], number: usize) -> Result<&CaptureCamera> {
    cameras.get(number).ok_or_else(|| {
        Error::argument(
            "--camera",
            match cameras.len() {
                0 => "no cameras were found; name them with --cameras".to_owned(),
                count => format!("must be less than {count}, the number of cameras"),
            },
        )
    })
}

/// The up axis: of the command line, else the cameras', else estimated from the splats.
pub fn up(arguments: &Arguments, cameras: &[CaptureCamera], model: &Model) -> DVec3 {
    let said = arguments.up.map(DVec3::from);
    said.or_else(|| up_of(cameras.iter().map(|c| &c.camera)))
        .unwrap_or_else(|| up_of_splats(&model.file, model.center, model.radius))
}

/// The first picture's camera: the named one, else the capture's first unless --fov is given.
pub fn first_camera(arguments: &Arguments, cameras: &[CaptureCamera]) -> Result<Option<usize>> {
    if let Some(number) = arguments.camera {
        return numbered(cameras, number).map(|_| Some(number));
    }
    let is_photo = arguments.fov.is_none() && !cameras.is_empty();
    Ok(is_photo.then_some(0))
}

/// First view of a scene: the capture's first camera, else the whole scene.
pub fn first_view(model: &Model, cameras: &[CaptureCamera], up: DVec3, fov: f64) -> Viewpoint {
    match cameras.first() {
        Some(first) => Viewpoint::of_camera(&first.camera, model.center, model.radius),
        None => Viewpoint::framing(model.center, model.radius, up, fov),
    }
}
