//! A scene in memory, and its extent.

use std::path::Path;

use glam::DVec3;
use splat_render::io::{SplatFile, read_splats};
use splat_render::{Error, Result};

use crate::checkpoint::read_checkpoint;
use crate::detail::{BUDGET, Detail, is_in_levels};

/// Splats of a lower opacity logit do not count for the extent.
const FAINT_LOGIT: f32 = -2.2;
/// Number of splats that the extent is computed from.
const SAMPLES: usize = 100_000;

#[derive(Debug)]
pub struct Model {
    pub file: SplatFile,
    /// Center of the visible splats, in world coordinates.
    pub center: DVec3,
    /// Radius with 90 % of the visible splats, at most four times the radius with 50 %.
    pub radius: f64,
    /// Messages about ignored content.
    pub notes: Vec<String>,
    /// For a scene in levels of detail; `file` is then its drawn part.
    pub detail: Option<Detail>,
    /// Number of splats of the whole scene, if `file` has another.
    pub whole: Option<usize>,
}

impl Model {
    /// Reads a splat file, a fit's checkpoint, or at most `budget` splats of a scene in levels.
    pub fn read(path: &Path, budget: Option<usize>) -> Result<Self> {
        if is_in_levels(path) {
            let (detail, file) = Detail::open(path, budget.unwrap_or(BUDGET))?;
            let whole = Some(detail.total().0);
            return Ok(Self { detail: Some(detail), whole, ..Self::new(file, Vec::new()) });
        }
        if path.extension().is_some_and(|ending| ending == "npz") {
            return Ok(Self::new(read_checkpoint(path)?, Vec::new()));
        }
        if path.is_dir() {
            return Err(Error::file(path, "is a folder; give a file of splats"));
        }
        let loaded = read_splats(path)?;
        Ok(Self::new(loaded.file, loaded.notes))
    }

    fn new(file: SplatFile, mut notes: Vec<String>) -> Self {
        let broken = (0..file.splats.len()).filter(|&i| !is_finite(&file, i)).count();
        if broken > 0 {
            notes.push(format!(
                "{broken} of {} splats have values that are not finite; the others are drawn.",
                file.splats.len()
            ));
        }
        let (center, radius) = extent(&file);
        Self { file, center, radius, notes, detail: None, whole: None }
    }
}

fn is_finite(file: &SplatFile, i: usize) -> bool {
    let s = &file.splats;
    let stride = s.stride();
    s.means[i].iter().chain(&s.quats[i]).chain(&s.scales[i]).all(|v| v.is_finite())
        && s.opacities[i].is_finite()
        && s.sh[i * stride..(i + 1) * stride].iter().flatten().all(|v| v.is_finite())
}

/// The value at a fraction of the way from the least to the greatest.
fn quantile(values: &mut [f64], part: f64) -> f64 {
    if values.is_empty() {
        return 0.0;
    }
    let at = ((values.len() - 1) as f64 * part) as usize;
    *values.select_nth_unstable_by(at, f64::total_cmp).1
}

/// Center and radius. Medians, because captures have a few splats very far out.
fn extent(file: &SplatFile) -> (DVec3, f64) {
    let step = file.splats.len().div_ceil(SAMPLES).max(1);
    let finite = (0..file.splats.len()).step_by(step).filter(|&i| is_finite(file, i));
    let all: Vec<usize> = finite.collect();
    let clear = |&i: &usize| file.splats.opacities[i] > FAINT_LOGIT;
    let mut seen: Vec<usize> = all.iter().copied().filter(clear).collect();
    if seen.is_empty() {
        seen = all;
    }
    let at = |i: usize| DVec3::from(file.splats.means[i].map(f64::from));
    let middle =
        |axis: usize| quantile(&mut seen.iter().map(|&i| at(i)[axis]).collect::<Vec<_>>(), 0.5);
    let center = DVec3::new(middle(0), middle(1), middle(2));
    let mut distances: Vec<f64> = seen.iter().map(|&i| at(i).distance(center)).collect();
    let radius = quantile(&mut distances, 0.9).min(4.0 * quantile(&mut distances, 0.5));
    let radius = if radius > 0.0 { radius } else { 1.0 };
    (center + DVec3::from(file.origin), radius)
}
