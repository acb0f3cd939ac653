//! Cameras of a COLMAP model, text or binary; points are passed over.

use std::collections::HashMap;
use std::path::{Path, PathBuf};

use glam::{DMat3, DQuat, DVec3};
use splat_render::{Camera, Error, Result};

use crate::capture::{CaptureCamera, photo_at, viewmat};

/// COLMAP's camera models in the order of their numbers: name, number of parameters, and whether
/// one focal length stands for both.
const MODELS: [(&str, usize, bool); 11] = [
    ("SIMPLE_PINHOLE", 3, true),
    ("PINHOLE", 4, false),
    ("SIMPLE_RADIAL", 4, true),
    ("RADIAL", 5, true),
    ("OPENCV", 8, false),
    ("OPENCV_FISHEYE", 8, false),
    ("FULL_OPENCV", 12, false),
    ("FOV", 5, false),
    ("SIMPLE_RADIAL_FISHEYE", 4, true),
    ("RADIAL_FISHEYE", 5, true),
    ("THIN_PRISM_FISHEYE", 12, false),
];
/// Bytes of a point in an image of a binary model.
const POINT: usize = 24;
/// Longest name of a photo.
const NAME_MAX: usize = 4096;

/// Width, height, fx, fy, cx, cy.
type Lens = [f64; 6];

struct Pose {
    quat: [f64; 4],
    translation: [f64; 3],
    lens: u32,
    name: String,
}

/// Reads the model in a folder.
pub fn read_colmap(folder: &Path) -> Result<Vec<CaptureCamera>> {
    let binary = folder.join("images.bin").is_file();
    let path = |name: &str| folder.join(format!("{name}.{}", if binary { "bin" } else { "txt" }));
    let (lens_path, pose_path) = (path("cameras"), path("images"));
    let read = |path: &Path| {
        std::fs::read(path).map_err(|e| Error::file(path, format!("cannot be read ({e})")))
    };
    let bad = |path: &Path| {
        Error::file(path, "is damaged or of another version of COLMAP; export the model again")
    };
    let (lens_bytes, pose_bytes) = (read(&lens_path)?, read(&pose_path)?);
    let parsed = if binary {
        (binary_lenses(&lens_bytes), binary_poses(&pose_bytes))
    } else {
        let text = String::from_utf8_lossy;
        (text_lenses(&text(&lens_bytes)), text_poses(&text(&pose_bytes)))
    };
    let lenses = parsed.0.ok_or_else(|| bad(&lens_path))?;
    let mut poses = parsed.1.ok_or_else(|| bad(&pose_path))?;
    // COLMAP's own order is that of its threads.
    poses.sort_by(|a, b| a.name.cmp(&b.name));
    let photos = photo_folder(folder);
    poses
        .into_iter()
        .map(|pose| {
            let &[width, height, fx, fy, cx, cy] = lenses.get(&pose.lens).ok_or_else(|| {
                Error::file(
                    &pose_path,
                    format!("names camera {}, which is not in {}", pose.lens, lens_path.display()),
                )
            })?;
            let [w, x, y, z] = pose.quat;
            let to_camera = DMat3::from_quat(DQuat::from_xyzw(x, y, z, w).normalize());
            let center = -(to_camera.transpose() * DVec3::from(pose.translation));
            Ok(CaptureCamera {
                photo: photos.as_deref().and_then(|photos| photo_at(photos, &pose.name)),
                camera: Camera {
                    viewmat: viewmat(to_camera.transpose(), center),
                    fx,
                    fy,
                    cx,
                    cy,
                    width: width as u32,
                    height: height as u32,
                },
                name: pose.name,
            })
        })
        .collect()
}

/// The photos of the model in `capture`, `capture/sparse` or `capture/sparse/0`.
fn photo_folder(model: &Path) -> Option<PathBuf> {
    model.ancestors().take(3).map(|folder| folder.join("images")).find(|images| images.is_dir())
}

fn lens(model: usize, width: f64, height: f64, params: &[f64]) -> Option<Lens> {
    let &(_, count, one_focal) = MODELS.get(model)?;
    if params.len() != count {
        return None;
    }
    let (fy, center) = if one_focal { (0, 1) } else { (1, 2) };
    Some([width, height, params[0], params[fy], params[center], params[center + 1]])
}

fn lines(text: &str) -> impl Iterator<Item = &str> {
    text.lines().filter(|line| !line.starts_with('#'))
}

fn text_lenses(text: &str) -> Option<HashMap<u32, Lens>> {
    let read = |line: &str| {
        let words: Vec<&str> = line.split_whitespace().collect();
        let model = MODELS.iter().position(|(name, ..)| Some(name) == words.get(1))?;
        let numbers: Option<Vec<f64>> = words[2..].iter().map(|w| w.parse().ok()).collect();
        let numbers = numbers.filter(|numbers| numbers.len() > 2)?;
        Some((words[0].parse().ok()?, lens(model, numbers[0], numbers[1], &numbers[2..])?))
    };
    lines(text).filter(|line| !line.trim().is_empty()).map(read).collect()
}

fn text_poses(text: &str) -> Option<Vec<Pose>> {
    let read = |line: &str| {
        let mut words = line.split_whitespace();
        let numbers: Vec<f64> =
            words.by_ref().take(9).map_while(|word| word.parse().ok()).collect();
        let &[_, qw, qx, qy, qz, tx, ty, tz, lens] = numbers.as_slice() else { return None };
        Some(Pose {
            quat: [qw, qx, qy, qz],
            translation: [tx, ty, tz],
            lens: lens as u32,
            name: words.collect::<Vec<_>>().join(" "),
        })
    };
    // Every second line holds an image's points, and may be empty.
    lines(text).step_by(2).filter(|line| !line.trim().is_empty()).map(read).collect()
}

/// Bytes from the front of a binary file, None where it ends.
struct Bytes<'a>(&'a [u8]);

impl<'a> Bytes<'a> {
    fn take(&mut self, count: usize) -> Option<&'a [u8]> {
        let (head, rest) = self.0.split_at_checked(count)?;
        self.0 = rest;
        Some(head)
    }

    fn u32(&mut self) -> Option<u32> {
        self.take(4)?.try_into().ok().map(u32::from_le_bytes)
    }

    fn u64(&mut self) -> Option<u64> {
        self.take(8)?.try_into().ok().map(u64::from_le_bytes)
    }

    fn f64(&mut self) -> Option<f64> {
        self.take(8)?.try_into().ok().map(f64::from_le_bytes)
    }

    fn f64s<const N: usize>(&mut self) -> Option<[f64; N]> {
        let mut out = [0.0; N];
        for value in &mut out {
            *value = self.f64()?;
        }
        Some(out)
    }
}

fn binary_lenses(bytes: &[u8]) -> Option<HashMap<u32, Lens>> {
    let mut bytes = Bytes(bytes);
    let mut out = HashMap::new();
    for _ in 0..bytes.u64()? {
        let (id, model) = (bytes.u32()?, bytes.u32()? as usize);
        let (width, height) = (bytes.u64()? as f64, bytes.u64()? as f64);
        let count = MODELS.get(model)?.1;
        let params: Option<Vec<f64>> = (0..count).map(|_| bytes.f64()).collect();
        out.insert(id, lens(model, width, height, &params?)?);
    }
    Some(out)
}

fn binary_poses(bytes: &[u8]) -> Option<Vec<Pose>> {
    let mut bytes = Bytes(bytes);
    let mut out = Vec::new();
    for _ in 0..bytes.u64()? {
        bytes.u32()?;
        let (quat, translation, lens) = (bytes.f64s()?, bytes.f64s()?, bytes.u32()?);
        let length = bytes.0.iter().take(NAME_MAX).position(|&b| b == 0)?;
        let name = String::from_utf8_lossy(bytes.take(length)?).into_owned();
        bytes.take(1)?;
        let points = usize::try_from(bytes.u64()?).ok()?.checked_mul(POINT)?;
        bytes.take(points)?;
        out.push(Pose { quat, translation, lens, name });
    }
    Some(out)
}
