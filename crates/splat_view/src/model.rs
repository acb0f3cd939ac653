//! A scene in memory, and its extent.

use std::path::Path;

use glam::DVec3;
use splat_render::extent::extent;
use splat_render::io::{SplatFile, read_splats};
use splat_render::{Error, Result};

use crate::checkpoint::read_checkpoint;
use crate::detail::{BUDGET, Detail, is_in_levels};

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
        let (center, radius) = extent(&file.splats.means, &file.splats.opacities);
        let center = center + DVec3::from(file.origin);
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
