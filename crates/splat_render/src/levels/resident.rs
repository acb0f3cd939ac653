//! Splats of cells in memory, never more than a budget.

use std::collections::{BTreeMap, BTreeSet};
use std::path::Path;

use super::choice::Choice;
use super::manifest::{Manifest, Run};
use crate::error::{Error, Result};
use crate::io::{SplatFile, is_drawn, read_splats};
use crate::splats::SplatArrays;

/// The splats to draw.
#[derive(Debug, Clone, PartialEq)]
pub struct Drawn {
    /// The splats.
    pub file: SplatFile,
    /// Cells with splats among them.
    pub cells: usize,
    /// Cells that are coarser or finer than was chosen.
    pub waiting: usize,
}

/// Cells by their number and level.
#[derive(Debug, Default)]
pub struct Resident {
    runs: BTreeMap<(usize, usize), SplatArrays>,
    environment: SplatArrays,
    antialiased: bool,
    /// Splats that are held.
    splats: usize,
    budget: usize,
    /// The most that were ever held.
    pub most: usize,
}

impl Resident {
    /// Starts with the environment, which is always drawn. Fails if the budget is too small for it.
    pub fn new(manifest: &Manifest, budget: usize) -> Result<Self> {
        let mut out = Self { budget, ..Self::default() };
        if let Some(name) = &manifest.environment {
            let file = read_splats(&manifest.folder.join(name))?.file;
            if file.splats.len() >= budget {
                let n = file.splats.len();
                let what =
                    format!("of {budget} splats is no more than the {n} that are always drawn");
                return Err(Error::argument("budget", format!("{what}; give more")));
            }
            out.environment = file.splats;
            out.antialiased = file.antialiased;
            out.splats = out.environment.len();
            out.most = out.splats;
        }
        Ok(out)
    }

    /// Splats that cells may take.
    pub fn room(&self) -> usize {
        self.budget - self.environment.len()
    }

    /// The files to read for a choice: files of coarsest levels first, then by importance.
    pub fn missing(&self, manifest: &Manifest, choice: &Choice) -> Vec<usize> {
        let (mut seen, mut out) = (BTreeSet::new(), Vec::new());
        for key in wanted(manifest, choice) {
            let file = manifest.cells[key.0].runs[key.1].map(|run| run.file);
            if !self.runs.contains_key(&key)
                && let Some(file) = file
                && seen.insert(file)
            {
                out.push(file);
            }
        }
        out
    }

    /// Keeps the splats of a file that a choice needs; others are dropped as room is required.
    pub fn load(&mut self, manifest: &Manifest, choice: &Choice, file: usize) -> Result<()> {
        let read = read_file(manifest, file)?;
        self.keep(manifest, choice, file, &read);
        Ok(())
    }

    fn keep(&mut self, manifest: &Manifest, choice: &Choice, file: usize, read: &SplatFile) {
        self.antialiased |= read.antialiased;
        let wanted: BTreeSet<_> = wanted(manifest, choice).into_iter().collect();
        for key in &wanted {
            let Some(run) = manifest.cells[key.0].runs[key.1].filter(|run| run.file == file) else {
                continue;
            };
            if self.runs.contains_key(key) {
                continue;
            }
            while self.splats + run.count > self.budget {
                let Some(old) = self.runs.keys().find(|key| !wanted.contains(key)).copied() else {
                    return;
                };
                self.splats -= self.runs.remove(&old).map_or(0, |old| old.len());
            }
            self.runs.insert(*key, rows(&read.splats, &run));
            self.splats += run.count;
            self.most = self.most.max(self.splats);
        }
    }

    /// The splats to draw now: of each cell the chosen level, or the nearest to it that is there.
    pub fn drawn(&self, manifest: &Manifest, choice: &Choice) -> Drawn {
        let mut parts = vec![&self.environment];
        let (mut cells, mut waiting) = (0, 0);
        for (cell, level) in choice.levels.iter().enumerate() {
            let Some(level) = *level else { continue };
            let there = self.runs.range((cell, 0)..=(cell, usize::MAX));
            let nearest = there.min_by_key(|((_, there), _)| there.abs_diff(level));
            waiting += usize::from(nearest.is_none_or(|((_, there), _)| *there != level));
            if let Some((_, splats)) = nearest {
                cells += 1;
                parts.push(splats);
            }
        }
        let file = SplatFile {
            splats: joined(&parts),
            origin: manifest.origin,
            antialiased: self.antialiased,
        };
        Drawn { file, cells, waiting }
    }
}

/// Cells and levels of a choice: the coarsest of each cell, then the chosen ones.
fn wanted(manifest: &Manifest, choice: &Choice) -> Vec<(usize, usize)> {
    let coarsest = |&cell: &usize| {
        manifest.cells[cell].runs.iter().rposition(Option::is_some).map(|level| (cell, level))
    };
    let chosen = |&cell: &usize| choice.levels[cell].map(|level| (cell, level));
    let order = &choice.order;
    order.iter().filter_map(coarsest).chain(order.iter().filter_map(chosen)).collect()
}

/// Reads a file and checks its number of splats against the manifest.
fn read_file(manifest: &Manifest, file: usize) -> Result<SplatFile> {
    let path = manifest.folder.join(&manifest.files[file]);
    let mut read = read_splats(&path)?.file;
    let (there, said) = (read.splats.len(), manifest.size_of(file));
    if there != said {
        let what = format!("holds {there} splats, but {} says {said}", super::INDEX);
        return Err(Error::file(&path, format!("{what}; write the levels again")));
    }
    // Cells keep their rows: invalid splats become faint and tiny instead of being removed.
    for i in 0..there {
        if !is_drawn(&read.splats, i) {
            read.splats.clear(i);
            read.splats.quats[i] = [1.0, 0.0, 0.0, 0.0];
            read.splats.scales[i] = [-30.0; 3];
            read.splats.opacities[i] = -30.0;
        }
    }
    Ok(read)
}

fn rows(splats: &SplatArrays, run: &Run) -> SplatArrays {
    splats.select(&(run.offset..run.offset + run.count).collect::<Vec<_>>())
}

/// All parts concatenated, at their highest SH degree.
fn joined(parts: &[&SplatArrays]) -> SplatArrays {
    let degree = parts.iter().map(|part| part.sh_degree).max().unwrap_or(0);
    let mut out = SplatArrays { sh_degree: degree, ..SplatArrays::default() };
    let count = parts.iter().map(|part| part.len()).sum();
    out.means.reserve_exact(count);
    out.quats.reserve_exact(count);
    out.scales.reserve_exact(count);
    out.opacities.reserve_exact(count);
    out.sh.reserve_exact(count * out.stride());
    for part in parts {
        if part.sh_degree == degree {
            out.append(part);
            continue;
        }
        out.means.extend_from_slice(&part.means);
        out.quats.extend_from_slice(&part.quats);
        out.scales.extend_from_slice(&part.scales);
        out.opacities.extend_from_slice(&part.opacities);
        for row in part.sh.chunks_exact(part.stride()) {
            out.sh.extend_from_slice(row);
            out.sh.resize(out.sh.len() + out.stride() - part.stride(), [0.0; 3]);
        }
    }
    out
}

/// Reads the finest level whose cells together fit a budget of splats; fails if even the coarsest does
/// not. For viewers that do not choose levels by distance.
pub fn read_within(path: &Path, budget: usize) -> Result<(SplatFile, usize)> {
    let manifest = Manifest::read(path)?;
    let mut resident = Resident::new(&manifest, budget.max(1))?;
    // A cell without a level has nothing to show there.
    let counts = manifest.counts();
    let level = counts.iter().position(|&n| n > 0 && n <= resident.room()).ok_or_else(|| {
        let least = counts.last().copied().unwrap_or(0);
        if least == 0 {
            return Error::file(path, "has no splats; write the levels again");
        }
        let what = format!("has {least} splats at its coarsest level, more than {budget}");
        Error::file(path, format!("{what}; write more levels"))
    })?;
    let levels: Vec<_> = manifest.cells.iter().map(|c| c.runs[level].map(|_| level)).collect();
    let files: BTreeSet<usize> =
        manifest.cells.iter().filter_map(|c| Some(c.runs[level]?.file)).collect();
    let choice = Choice { levels, order: Vec::new(), held: 0 };
    for file in files {
        let read = read_file(&manifest, file)?;
        resident.antialiased |= read.antialiased;
        for (cell, part) in manifest.cells.iter().enumerate() {
            if let Some(run) = part.runs[level].filter(|run| run.file == file) {
                resident.runs.insert((cell, level), rows(&read.splats, &run));
            }
        }
    }
    Ok((resident.drawn(&manifest, &choice).file, level))
}
