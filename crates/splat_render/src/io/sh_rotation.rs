//! SH coefficients of a scene that is turned.

use crate::constants::{SH_COEFFS_MAX, SH_DEGREE_MAX};
use crate::sh;

/// Directions at which a band's functions are compared, far more than the 9 functions of degree 4.
const DIRECTIONS: usize = 64;

/// The matrix of each degree from 1 on, `[2 degree + 1]^2`, that gives the turned coefficients.
pub struct ShRotation(Vec<Vec<f64>>);

impl ShRotation {
    /// Of a rotation whose inverse is `back`.
    pub fn new(back: impl Fn([f64; 3]) -> [f64; 3]) -> Self {
        let bases: Vec<_> = (0..DIRECTIONS)
            .map(|i| {
                // Fibonacci's lattice.
                let z = 1.0 - (2.0 * i as f64 + 1.0) / DIRECTIONS as f64;
                let angle = i as f64 * std::f64::consts::PI * (3.0 - 5.0f64.sqrt());
                let radius = (1.0 - z * z).sqrt();
                let dir = [radius * angle.cos(), radius * angle.sin(), z];
                (sh::basis::<f64>(SH_DEGREE_MAX, dir), sh::basis::<f64>(SH_DEGREE_MAX, back(dir)))
            })
            .collect();
        Self((1..=SH_DEGREE_MAX).map(|degree| band_matrix(degree, &bases)).collect())
    }

    /// Turns the coefficients of one splat, DC first.
    pub fn apply(&self, row: &mut [[f32; 3]]) {
        for (band, matrix) in self.0.iter().enumerate() {
            let degree = band as u32 + 1;
            let (start, end) = (sh::coeffs(degree - 1), sh::coeffs(degree));
            if end > row.len() {
                return;
            }
            let each = end - start;
            let before: [[f32; 3]; SH_COEFFS_MAX] =
                std::array::from_fn(|k| row.get(start + k).copied().unwrap_or_default());
            for a in 0..each {
                row[start + a] = std::array::from_fn(|c| {
                    (0..each).map(|b| matrix[a * each + b] * f64::from(before[b][c])).sum::<f64>()
                        as f32
                });
            }
        }
    }
}

type Basis = [f64; SH_COEFFS_MAX];

/// Solves sum_a x[a][b] Y_a(d) = Y_b(back(d)) by least squares; exact, since bands are closed.
fn band_matrix(degree: u32, bases: &[(Basis, Basis)]) -> Vec<f64> {
    let start = sh::coeffs(degree - 1);
    let each = sh::coeffs(degree) - start;
    let width = 2 * each;
    // Rows of [AᵀA | AᵀB], brought to [1 | X] by Gauss and Jordan.
    let mut rows: Vec<Vec<f64>> = (0..each)
        .map(|a| {
            (0..width)
                .map(|k| {
                    bases
                        .iter()
                        .map(|(here, back)| {
                            let other =
                                if k < each { here[start + k] } else { back[start + k - each] };
                            here[start + a] * other
                        })
                        .sum()
                })
                .collect()
        })
        .collect();
    for pivot in 0..each {
        // The matrix is near a multiple of the unit matrix: its diagonal needs no exchange.
        let scale = rows[pivot][pivot];
        for k in 0..width {
            rows[pivot][k] /= scale;
        }
        for row in 0..each {
            let factor = rows[row][pivot];
            if row != pivot {
                for k in 0..width {
                    rows[row][k] -= factor * rows[pivot][k];
                }
            }
        }
    }
    rows.iter().flat_map(|row| row[each..].iter().copied()).collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use glam::{DQuat, DVec3};

    #[test]
    fn a_turned_scene_keeps_its_colors_in_each_direction() {
        let turn = DQuat::from_axis_angle(DVec3::new(0.3, -0.5, 0.8).normalize(), 1.1);
        let rotation = ShRotation::new(|d| (turn.inverse() * DVec3::from_array(d)).to_array());
        let before: Vec<[f32; 3]> =
            (0..25).map(|k| [(k as f32 * 1.7).sin(), (k as f32 * 0.9).cos(), 0.1]).collect();
        for degree in 1..=4 {
            let count = sh::coeffs(degree);
            let mut after = before[..count].to_vec();
            rotation.apply(&mut after);
            for dir in [DVec3::X, DVec3::new(0.6, 0.0, -0.8), DVec3::new(-0.48, 0.6, 0.64)] {
                let seen = |row: &[[f32; 3]], dir: DVec3| -> f64 {
                    let basis = sh::basis::<f64>(degree, dir.to_array());
                    row.iter().zip(basis).map(|(rgb, b)| f64::from(rgb[0]) * b).sum()
                };
                let (was, is) = (seen(&before[..count], dir), seen(&after, turn * dir));
                assert!((was - is).abs() < 1e-5, "degree {degree}: {was} became {is}");
            }
        }
    }
}
