//! The Cholesky factor of a matrix over a pose's degrees of freedom.

use super::motion::{POSE, PoseMatrix};

/// L^-1 for a positive definite matrix L L^T.
pub(super) fn inverse_cholesky(matrix: PoseMatrix) -> PoseMatrix {
    let mut l = [[0.0; POSE]; POSE];
    for i in 0..POSE {
        for j in 0..=i {
            let done: f64 = (0..j).map(|k| l[i][k] * l[j][k]).sum();
            let rest = matrix[i][j] - done;
            l[i][j] = if i == j { rest.max(f64::MIN_POSITIVE).sqrt() } else { rest / l[j][j] };
        }
    }
    let mut inverse = [[0.0; POSE]; POSE];
    for column in 0..POSE {
        for i in column..POSE {
            let done: f64 = (column..i).map(|k| l[i][k] * inverse[k][column]).sum();
            inverse[i][column] = (f64::from(u8::from(i == column)) - done) / l[i][i];
        }
    }
    inverse
}
