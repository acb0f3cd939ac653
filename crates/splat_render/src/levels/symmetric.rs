//! Axes of symmetric matrices: the method of Jacobi, for 3 x 3.

/// Sweeps over the three pairs of axes; it converges quadratically, and four are enough for f64.
const SWEEPS: usize = 12;

/// Eigenvalues of a symmetric matrix, and its eigenvectors as columns of a rotation.
pub fn axes(mut a: [[f64; 3]; 3]) -> ([f64; 3], [[f64; 3]; 3]) {
    let mut v = [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]];
    for _ in 0..SWEEPS {
        for (p, q) in [(0, 1), (0, 2), (1, 2)] {
            if a[p][q] == 0.0 {
                continue;
            }
            let theta = (a[q][q] - a[p][p]) / (2.0 * a[p][q]);
            let t = theta.signum() / (theta.abs() + theta.hypot(1.0));
            let c = 1.0 / t.hypot(1.0);
            let s = t * c;
            // Rows, then columns, are turned by the angle that makes a[p][q] zero.
            for row in &mut a {
                (row[p], row[q]) = (c * row[p] - s * row[q], s * row[p] + c * row[q]);
            }
            for k in 0..3 {
                (a[p][k], a[q][k]) = (c * a[p][k] - s * a[q][k], s * a[p][k] + c * a[q][k]);
            }
            for row in &mut v {
                (row[p], row[q]) = (c * row[p] - s * row[q], s * row[p] + c * row[q]);
            }
        }
    }
    ([a[0][0], a[1][1], a[2][2]], v)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn eigenvectors_and_eigenvalues_give_the_matrix() {
        for a in [
            [[2.0, 0.3, -0.7], [0.3, 1.0, 0.2], [-0.7, 0.2, 3.0]],
            [[1.0, 1.0, 1.0]; 3],
            [[1e-12, 0.0, 0.0], [0.0, 1.0, 1e-7], [0.0, 1e-7, 1e6]],
            [[0.0; 3]; 3],
        ] {
            let (values, v) = axes(a);
            let largest = values.iter().fold(1e-300f64, |m, x| m.max(x.abs()));
            for i in 0..3 {
                for j in 0..3 {
                    let again: f64 = (0..3).map(|k| v[i][k] * values[k] * v[j][k]).sum();
                    assert!((again - a[i][j]).abs() <= 1e-14 * largest, "{a:?}: {again}");
                }
            }
            let turned = glam::DMat3::from_cols_array_2d(&v).determinant();
            assert!((turned - 1.0).abs() < 1e-12, "{turned}");
        }
    }
}
