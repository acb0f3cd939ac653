//! A scene in levels of detail: which splats a view needs, read from the disk within a budget.

use std::collections::BTreeSet;
use std::path::Path;

use splat_render::io::SplatFile;
use splat_render::levels::{Choice, Drawn, INDEX, Manifest, Resident, View, choose, coarsest};
use splat_render::{Camera, Error, Result};

/// Default maximum number of splats in memory.
pub const BUDGET: usize = 1_000_000;
/// Distance of splats in pixels that is fine enough; finer ones are drawn too large.
const FINE: f64 = 1.5;

pub fn is_in_levels(path: &Path) -> bool {
    path.file_name().is_some_and(|name| name == INDEX)
}

pub fn view(camera: &Camera, near: f32) -> View {
    View { camera: *camera, near: f64::from(near), pixels: FINE }
}

/// A scene in levels of detail, and its loaded splats.
#[derive(Debug)]
pub struct Detail {
    manifest: Manifest,
    resident: Resident,
    /// Files that could not be read; they are not tried again.
    failed: BTreeSet<usize>,
}

impl Detail {
    /// Reads the list of cells, and all of them as coarse as there are.
    pub fn open(path: &Path, budget: usize) -> Result<(Self, SplatFile)> {
        let manifest = Manifest::read(path)?;
        let resident = Resident::new(&manifest, budget).map_err(|error| match error {
            Error::Argument { reason, .. } => Error::argument("--budget", reason),
            other => other,
        })?;
        let mut out = Self { manifest, resident, failed: BTreeSet::new() };
        let choice = coarsest(&out.manifest, out.resident.room());
        while let Some(loaded) = out.load_next(&choice) {
            loaded?;
        }
        let drawn = out.drawn(&choice);
        if drawn.file.splats.is_empty() {
            let least = out.manifest.cells.iter().filter_map(|c| c.runs.iter().flatten().last());
            let least = least.map(|run| run.count).min().unwrap_or(0);
            return Err(match least {
                0 => Error::file(path, "has no splats; write the levels again"),
                n => Error::argument(
                    "--budget",
                    format!("of {budget} splats is less than the coarsest cell's {n}; give more"),
                ),
            });
        }
        Ok((out, drawn.file))
    }

    /// Splats of all cells at their finest, and the number of cells.
    pub fn total(&self) -> (usize, usize) {
        let finest = |cell: &splat_render::levels::Cell| cell.runs.iter().flatten().next().copied();
        let runs = self.manifest.cells.iter().filter_map(finest);
        (runs.map(|run| run.count).sum(), self.manifest.cells.len())
    }

    /// Largest number of splats ever loaded.
    pub fn most(&self) -> usize {
        self.resident.most
    }

    pub fn choose(&self, view: &View) -> Choice {
        choose(&self.manifest, view, self.resident.room())
    }

    /// Reads the next file that a choice needs; None if there is none.
    pub fn load_next(&mut self, choice: &Choice) -> Option<Result<()>> {
        let missing = self.resident.missing(&self.manifest, choice);
        let file = missing.into_iter().find(|file| !self.failed.contains(file))?;
        let loaded = self.resident.load(&self.manifest, choice, file);
        if loaded.is_err() {
            self.failed.insert(file);
        }
        Some(loaded)
    }

    /// The loaded part of a choice.
    pub fn drawn(&self, choice: &Choice) -> Drawn {
        self.resident.drawn(&self.manifest, choice)
    }
}
