//! Cameras from Python's viewmat and intrinsics.

use glam::DMat4;
use pyo3::prelude::*;
use splat_render::Camera;

use crate::arrays::{array, row, rows};

/// A matrix from its rows: numpy is row-major, glam column-major.
pub fn viewmat(rows: &[[f64; 4]; 4]) -> DMat4 {
    DMat4::from_cols_array_2d(rows).transpose()
}

fn camera_of(
    viewmat: &[[f64; 4]; 4],
    &[fx, fy, cx, cy]: &[f64; 4],
    (width, height): (u32, u32),
) -> Camera {
    Camera { viewmat: self::viewmat(viewmat), fx, fy, cx, cy, width, height }
}

/// A camera from `viewmat` f64 [4, 4], `intrinsics` f64 [4] (fx, fy, cx, cy) and a size.
pub fn camera(
    viewmat: &Bound<'_, PyAny>,
    intrinsics: &Bound<'_, PyAny>,
    width: u32,
    height: u32,
) -> PyResult<Camera> {
    let viewmat = array::<f64>("viewmat", viewmat)?;
    let matrix = rows::<f64, 4>("viewmat", &viewmat, &[4])?;
    let intrinsics = row::<f64, 4>("intrinsics", intrinsics)?;
    Ok(camera_of(&matrix.as_chunks().0[0], &intrinsics, (width, height)))
}

/// Cameras from `viewmats` f64 [V, 4, 4], `intrinsics` f64 [V, 4] and V sizes.
pub fn cameras(
    viewmats: &Bound<'_, PyAny>,
    intrinsics: &Bound<'_, PyAny>,
    sizes: &[(u32, u32)],
) -> PyResult<Vec<Camera>> {
    let count = sizes.len() as isize;
    let viewmats = array::<f64>("viewmats", viewmats)?;
    let viewmats = rows::<f64, 4>("viewmats", &viewmats, &[count, 4])?.as_chunks::<4>().0;
    let intrinsics = array::<f64>("intrinsics", intrinsics)?;
    let intrinsics = rows::<f64, 4>("intrinsics", &intrinsics, &[count])?;
    Ok((0..sizes.len()).map(|i| camera_of(&viewmats[i], &intrinsics[i], sizes[i])).collect())
}
