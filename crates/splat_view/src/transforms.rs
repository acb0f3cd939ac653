//! Cameras in JSON: `transforms.json` of NeRF-Synthetic, nerfstudio and igsr (camera-to-world in
//! OpenGL axes), and the `cameras.json` that INRIA's trainer leaves (OpenCV axes).

use std::fs::File;
use std::io::Read;
use std::path::Path;

use glam::{DMat3, DVec3};
use serde_json::Value;
use splat_render::{Camera, Error, Result};

use crate::capture::{CaptureCamera, photo_at, viewmat};
use crate::photo::photo_size;

/// Largest file that is read.
const FILE_MAX: u64 = 256 << 20;

/// Reads the cameras of a JSON file of either kind.
pub fn read_json(path: &Path) -> Result<Vec<CaptureCamera>> {
    let unreadable = |e: std::io::Error| Error::file(path, format!("cannot be read ({e})"));
    let mut bytes = Vec::new();
    let file = File::open(path).map_err(unreadable)?;
    file.take(FILE_MAX).read_to_end(&mut bytes).map_err(unreadable)?;
    let root: Value = serde_json::from_slice(&bytes)
        .map_err(|e| Error::file(path, format!("is no JSON ({e}); give a file of cameras")))?;
    let folder = path.parent().unwrap_or(Path::new(""));
    let frames = root.as_array().or_else(|| root.get("frames").and_then(Value::as_array));
    let Some(frames) = frames else {
        return Err(Error::file(path, "has no \"frames\"; give a transforms.json or cameras.json"));
    };
    if frames.is_empty() {
        return Err(Error::file(path, "names no cameras; give a file with some, or none"));
    }
    let read = |(i, frame): (usize, &Value)| {
        let camera = if frame.get("transform_matrix").is_some() {
            transform(frame, &root, folder)
        } else {
            inria(frame)
        };
        camera.ok_or_else(|| {
            Error::file(
                path,
                format!("frame {i} lacks a matrix of numbers, a focal length or a size"),
            )
        })
    };
    frames.iter().enumerate().map(read).collect()
}

fn vector(value: &Value) -> Option<DVec3> {
    let row = value.as_array()?.iter().map(Value::as_f64).collect::<Option<Vec<f64>>>()?;
    (row.len() >= 3).then(|| DVec3::new(row[0], row[1], row[2]))
}

fn rows(value: &Value) -> Option<[DVec3; 3]> {
    let rows = value.as_array()?;
    Some([vector(rows.first()?)?, vector(rows.get(1)?)?, vector(rows.get(2)?)?])
}

/// A frame of a transforms.json; what it lacks stands in the file's root.
fn transform(frame: &Value, root: &Value, folder: &Path) -> Option<CaptureCamera> {
    let number = |name: &str| frame.get(name).or_else(|| root.get(name)).and_then(Value::as_f64);
    let matrix = frame.get("transform_matrix")?;
    let [x, y, z] = rows(matrix)?;
    let fourth = |row: usize| matrix.get(row)?.get(3)?.as_f64();
    let center = DVec3::new(fourth(0)?, fourth(1)?, fourth(2)?);
    let opengl = DMat3::from_cols(x, y, z).transpose();
    let opencv = DMat3::from_cols(opengl.x_axis, -opengl.y_axis, -opengl.z_axis);
    let name = frame.get("file_path")?.as_str()?.trim_start_matches("./").to_owned();
    let photo = photo_at(folder, &name);
    let [width, height] = match (number("w"), number("h")) {
        (Some(width), Some(height)) => [width, height],
        _ => photo_size(photo.as_ref()?).ok()?.map(|side| side as f64),
    };
    let focal = |angle: &str, side: f64| Some(0.5 * side / (0.5 * number(angle)?).tan());
    let fx = number("fl_x").or_else(|| focal("camera_angle_x", width))?;
    let fy = number("fl_y").or_else(|| focal("camera_angle_y", height)).unwrap_or(fx);
    let camera = Camera {
        viewmat: viewmat(opencv, center),
        fx,
        fy,
        cx: number("cx").unwrap_or(0.5 * width),
        cy: number("cy").unwrap_or(0.5 * height),
        width: width as u32,
        height: height as u32,
    };
    Some(CaptureCamera { name, photo, camera })
}

fn inria(frame: &Value) -> Option<CaptureCamera> {
    let number = |name: &str| frame.get(name).and_then(Value::as_f64);
    let [x, y, z] = rows(frame.get("rotation")?)?;
    let (width, height) = (number("width")?, number("height")?);
    let camera = Camera {
        viewmat: viewmat(DMat3::from_cols(x, y, z).transpose(), vector(frame.get("position")?)?),
        fx: number("fx")?,
        fy: number("fy")?,
        cx: 0.5 * width,
        cy: 0.5 * height,
        width: width as u32,
        height: height as u32,
    };
    let name = frame.get("img_name").and_then(Value::as_str).unwrap_or("camera").to_owned();
    Some(CaptureCamera { name, photo: None, camera })
}
