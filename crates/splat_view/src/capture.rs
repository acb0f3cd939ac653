//! The cameras of a capture, from igsr's `cameras.json`.
//!
//! The layout is nerfstudio's `transforms.json` with every field given for every photo:
//!
//! ```json
//! {
//!   "camera_model": "PINHOLE",
//!   "frames": [
//!     {
//!       "file_path": "images/0001.jpg",
//!       "w": 800, "h": 600,
//!       "fl_x": 700.0, "fl_y": 700.0, "cx": 400.0, "cy": 300.0,
//!       "transform_matrix": [[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 4], [0, 0, 0, 1]]
//!     }
//!   ]
//! }
//! ```
//!
//! `file_path` is the photo's name, or its path from the file's folder if the photo is there. Sizes, focal
//! lengths and principal points are in pixels. `transform_matrix` is camera-to-world, row by row, in OpenGL
//! axes (x right, y up, z backward). Other fields are ignored.

use std::io::Read;
use std::path::{Path, PathBuf};

use glam::{DMat4, DVec3};
use serde::Deserialize;
use splat_render::io::open_file;
use splat_render::{Camera, Error, Result};

const NAME: &str = "cameras.json";
/// Largest file that is read, in bytes: some 100,000 cameras as igsr writes them.
const FILE_MAX: u64 = 64 << 20;
/// Hint for cameras in another format.
const OTHERS: &str = "igsr view shows other captures too (COLMAP, transforms.json), and igsr export \
                      --format transforms rewrites them for splat-view";

#[derive(Debug, Clone)]
pub struct CaptureCamera {
    pub name: String,
    /// The photo, if the file exists.
    pub photo: Option<PathBuf>,
    /// The pinhole camera, in world coordinates.
    pub camera: Camera,
}

#[derive(Deserialize)]
struct Cameras {
    #[serde(rename = "camera_model")]
    _model: Model,
    frames: Vec<Frame>,
}

/// The only camera model: lenses that distort would be drawn without their distortion.
#[derive(Deserialize)]
enum Model {
    #[serde(rename = "PINHOLE")]
    Pinhole,
}

#[derive(Deserialize)]
struct Frame {
    file_path: String,
    w: u32,
    h: u32,
    fl_x: f64,
    fl_y: f64,
    cx: f64,
    cy: f64,
    transform_matrix: [[f64; 4]; 4],
}

impl Frame {
    fn camera(&self) -> Camera {
        let opengl = DMat4::from_cols_array_2d(&self.transform_matrix).transpose();
        // To OpenCV axes: y down, z forward.
        let to_world = opengl * DMat4::from_scale(DVec3::new(1.0, -1.0, -1.0));
        Camera {
            viewmat: to_world.inverse(),
            fx: self.fl_x,
            fy: self.fl_y,
            cx: self.cx,
            cy: self.cy,
            width: self.w,
            height: self.h,
        }
    }
}

/// Reads the cameras of a file or of a folder's `cameras.json`, in order; all are valid.
pub fn read_cameras(path: &Path) -> Result<Vec<CaptureCamera>> {
    let Some(file) = find_cameras(path) else {
        let reason = match path.is_dir() {
            true => format!("holds no {NAME}; {OTHERS}"),
            false => format!("does not exist; give a {NAME} of igsr, or a folder with one"),
        };
        return Err(Error::file(path, reason));
    };
    let unreadable = |e: std::io::Error| Error::file(&file, format!("cannot be read ({e})"));
    let opened = open_file(&file)?;
    let size = opened.metadata().map_err(unreadable)?.len();
    if size > FILE_MAX {
        let reason =
            format!("is {size} bytes, more than the limit of {FILE_MAX}; give fewer cameras");
        return Err(Error::file(&file, reason));
    }
    let mut bytes = Vec::new();
    opened.take(FILE_MAX).read_to_end(&mut bytes).map_err(unreadable)?;
    let cameras: Cameras = serde_json::from_slice(&bytes).map_err(|e| {
        Error::file(&file, format!("is not a cameras.json of igsr ({e}); {OTHERS}"))
    })?;
    if cameras.frames.is_empty() {
        return Err(Error::file(&file, "has no cameras; give a file with at least one"));
    }
    let folder = file.parent().unwrap_or(Path::new(""));
    let read = |frame: Frame| {
        let camera = frame.camera();
        camera
            .validate()
            .map_err(|e| Error::file(&file, format!("camera of {}: {e}", frame.file_path)))?;
        let photo = Some(folder.join(&frame.file_path)).filter(|photo| photo.is_file());
        Ok(CaptureCamera { name: frame.file_path, photo, camera })
    };
    cameras.frames.into_iter().map(read).collect()
}

/// The file of cameras that a path names: itself, or the `cameras.json` in a folder.
pub fn find_cameras(path: &Path) -> Option<PathBuf> {
    let is_there = |file: &PathBuf| file.metadata().is_ok_and(|kind| !kind.is_dir());
    [path.to_owned(), path.join(NAME)].into_iter().find(is_there)
}
