//! The two frames of splat files.
//!
//! COLMAP's and so INRIA's scenes, and ours, have y down and z forward at the first camera; .spz and glTF
//! have y up and z back. The half turn about x converts between them: it changes the signs of y and z, of
//! two components of each rotation and of some SH coefficients, so that nothing is rounded.

use crate::sh;
use crate::splats::SplatArrays;

/// The half turn of a point.
pub fn turn_point<T: std::ops::Neg<Output = T>>([x, y, z]: [T; 3]) -> [T; 3] {
    [x, -y, -z]
}

/// The half turn of a rotation wxyz. The splat's own axes are turned too, which leaves its shape.
pub fn turn_quat<T: std::ops::Neg<Output = T>>([w, x, y, z]: [T; 4]) -> [T; 4] {
    [w, x, -y, -z]
}

/// The factor, 1 or -1, of each SH coefficient.
pub fn sh_signs() -> [f32; crate::constants::SH_COEFFS_MAX] {
    // Any direction on which no basis function vanishes.
    let dir = [0.48, 0.6, 0.64];
    let here = sh::basis::<f64>(crate::constants::SH_DEGREE_MAX, dir);
    let there = sh::basis::<f64>(crate::constants::SH_DEGREE_MAX, turn_point(dir));
    std::array::from_fn(|k| (here[k] * there[k]).signum() as f32)
}

/// The half turn of a scene.
pub fn turn(splats: &mut SplatArrays) {
    for mean in &mut splats.means {
        *mean = turn_point(*mean);
    }
    for quat in &mut splats.quats {
        *quat = turn_quat(*quat);
    }
    let signs = sh_signs();
    let stride = splats.stride();
    for (i, coefficient) in splats.sh.iter_mut().enumerate() {
        *coefficient = coefficient.map(|c| c * signs[i % stride]);
    }
}
