//! Which pixels' depths other photos' maps confirm.

use super::DepthMap;
use super::search::{PlaneMap, Stage, there_and_back};

/// Minimum score of a pixel, and of one that a single map confirms.
const MIN_SCORE: f32 = 0.5;
const MIN_SCORE_OF_ONE: f32 = 0.7;
/// A map confirms a pixel whose image it maps back to within this many pixels and this fraction of depth.
const MAX_OFF_PX: f32 = 1.0;
const MAX_OFF_FRACTION: f32 = 0.01;
/// Distance in pixels that this fraction of the depth must move the pixel's image.
const MIN_PARALLAX_PX: f32 = 0.05;
/// Number of maps that must agree, or all that see the place.
const CONFIRMING: usize = 2;

/// The confirmed pixels of map `k`.
pub fn confirmed(stage: &Stage<'_>, k: usize, maps: &[PlaneMap]) -> DepthMap {
    let map = &maps[k];
    let pixels = map.planes.len();
    let (depth, confidence) = (vec![0.0; pixels], vec![0.0; pixels]);
    let mut out = DepthMap { depth, normal: vec![[0.0; 3]; pixels], confidence };
    for pixel in 0..pixels {
        let (x, y) = ((pixel % map.width) as f32, (pixel / map.width) as f32);
        let (plane, score) = (map.planes[pixel], map.scores[pixel]);
        if score < MIN_SCORE {
            continue;
        }
        let (mut agree, mut see, mut sum) = (0, 0, 1.0);
        for pair in &stage.pairs {
            let Some(other) = pair.map.map(|other| &maps[other]) else { continue };
            let Some([column, row, _]) = pair.there.project(x, y, plane.inverse_depth) else {
                continue;
            };
            let Some([back_x, back_y, depth]) = there_and_back(pair, other, column, row) else {
                continue;
            };
            see += 1;
            let farther = plane.inverse_depth * (1.0 - MAX_OFF_FRACTION);
            let moved = pair.there.project(x, y, farther);
            let parallax = moved.map_or(0.0, |[x, y, _]| (x - column).hypot(y - row));
            let is_near = (back_x - x).hypot(back_y - y) <= MAX_OFF_PX;
            let relative = depth * plane.inverse_depth;
            if is_near && parallax > MIN_PARALLAX_PX && (relative - 1.0).abs() <= MAX_OFF_FRACTION {
                agree += 1;
                sum += relative;
            }
        }
        let is_sure = agree >= CONFIRMING || score >= MIN_SCORE_OF_ONE;
        if agree >= CONFIRMING.min(see.max(1)) && is_sure {
            // The mean over all maps that agree is more precise than the pixel's own depth.
            out.depth[pixel] = sum / (1 + agree) as f32 / plane.inverse_depth;
            out.normal[pixel] = stage.own.normal(x, y, plane.slope);
            out.confidence[pixel] = score.min(1.0) * (1.0 - 0.5f32.powi(agree as i32));
        }
    }
    out
}
