//! The discrete decisions of a render: central differences are valid between equal decisions.

use std::hash::{DefaultHasher, Hash, Hasher};

use super::project::{direction, geometry, sh_color};
use super::rasterize::{order, pair};
use crate::camera::Camera;
use crate::constants::TRANSMITTANCE_MIN;
use crate::stages::{Colors, ProjectOptions, Projected, SplatParams};

/// Hash of every decision: culling, clamps, depth order, contributing pairs, early stops.
pub fn decisions(
    splats: &SplatParams<'_, f64>,
    camera: &Camera,
    options: &ProjectOptions,
    projected: &Projected<f64>,
) -> u64 {
    let mut hash = DefaultHasher::new();
    let ids = order(projected);
    ids.hash(&mut hash);
    for &i in &ids {
        let Some(g) = geometry(splats, camera, options, i) else { continue };
        g.inside.hash(&mut hash);
        if let Colors::Sh { degree, stride, coeffs } = splats.colors {
            let dir = direction(camera, g.t).0;
            let color = sh_color(degree, &coeffs[i * stride..], dir);
            color.to_array().map(|c| c > 0.0).hash(&mut hash);
        }
    }
    for y in 0..projected.height {
        for x in 0..projected.width {
            let mut t = 1.0f64;
            for &i in &ids {
                let Some(pair) = pair(projected, i, x, y) else { continue };
                (x, y, i, pair.capped).hash(&mut hash);
                t *= 1.0 - pair.alpha;
                if t < f64::from(TRANSMITTANCE_MIN) {
                    break;
                }
            }
        }
    }
    hash.finish()
}
