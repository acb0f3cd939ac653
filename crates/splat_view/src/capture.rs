//! The cameras of a capture: where they are found, and what is known of each.
//!
//! They are looked from, so lens distortion is left out.

use std::path::{Path, PathBuf};

use glam::{DMat3, DMat4, DVec3};
use splat_render::{Camera, Error, Result};

use crate::colmap::read_colmap;
use crate::transforms::read_json;

/// A photo's camera.
#[derive(Debug, Clone)]
pub struct CaptureCamera {
    /// The photo's name in the capture.
    pub name: String,
    /// The photo, where it is there.
    pub photo: Option<PathBuf>,
    /// As a pinhole, in the world.
    pub camera: Camera,
}

/// Reads the cameras at a file or in a folder: of JSON in the file's order, of COLMAP by name. Whatever
/// is read can be drawn with.
pub fn read_cameras(path: &Path) -> Result<Vec<CaptureCamera>> {
    let Some(source) = find_cameras(path) else {
        return Err(Error::file(
            path,
            "holds no cameras; give a transforms.json, a cameras.json, a COLMAP model or a folder \
             with one",
        ));
    };
    let cameras = if source.is_dir() { read_colmap(&source)? } else { read_json(&source)? };
    for camera in &cameras {
        camera
            .camera
            .validate()
            .map_err(|e| Error::file(&source, format!("{}: {e}", camera.name)))?;
    }
    Ok(cameras)
}

/// The JSON file or the COLMAP model's folder at a path, or in a folder.
pub fn find_cameras(path: &Path) -> Option<PathBuf> {
    if path.is_file() {
        return Some(path.to_owned());
    }
    let models = [path.to_owned(), path.join("sparse/0"), path.join("sparse")];
    let is_model =
        |folder: &PathBuf| ["images.bin", "images.txt"].iter().any(|n| folder.join(n).is_file());
    let files = ["cameras.json", "transforms.json", "transforms_train.json"];
    files
        .iter()
        .map(|name| path.join(name))
        .find(|file| file.is_file())
        .or_else(|| models.into_iter().find(is_model))
        // Where igsr keeps the cameras that it found itself.
        .or_else(|| path.join("capture").is_dir().then(|| find_cameras(&path.join("capture")))?)
}

/// A rigid viewmat of a camera-to-world rotation that may be scaled or a little off, and a centre.
pub fn viewmat(to_world: DMat3, center: DVec3) -> DMat4 {
    let x = to_world.x_axis.normalize_or_zero();
    let y = (to_world.y_axis - x * x.dot(to_world.y_axis)).normalize_or_zero();
    let rotation = DMat3::from_cols(x, y, x.cross(y)).transpose();
    DMat4::from_cols(
        rotation.x_axis.extend(0.0),
        rotation.y_axis.extend(0.0),
        rotation.z_axis.extend(0.0),
        (-(rotation * center)).extend(1.0),
    )
}

/// The file that a photo's name means.
pub fn photo_at(folder: &Path, name: &str) -> Option<PathBuf> {
    let path = folder.join(name);
    // NeRF-Synthetic leaves the ending out.
    let png = folder.join(format!("{name}.png"));
    [path, png].into_iter().find(|path| path.is_file())
}
