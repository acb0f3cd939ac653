//! Chooses the level of each cell to draw: starts from the coarsest and refines the most visible cells
//! until a budget of splats is spent or a finer level would not be visible.

use std::cmp::Ordering;
use std::collections::BinaryHeap;

use glam::DVec3;

use super::manifest::{Cell, Manifest, face};
use crate::camera::Camera;

/// Cells out of the picture may take this part of the budget, coarse, so that a turn shows something.
const UNSEEN_PART: usize = 4;
/// A box and its splats, which reach out of it, are taken for a ball this much larger.
const REACH: f64 = 1.5;

/// A camera's view for the choice.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct View {
    /// The camera, in the world.
    pub camera: Camera,
    /// No cell is taken to be nearer than this.
    pub near: f64,
    /// Splats nearer to each other than this, in pixels, are fine enough.
    pub pixels: f64,
}

/// The level of each cell.
#[derive(Debug, Clone, PartialEq, Eq, Default)]
pub struct Choice {
    /// By cell; None: it is not drawn.
    pub levels: Vec<Option<usize>>,
    /// The cells that are drawn, the most important first.
    pub order: Vec<usize>,
    /// Splats that are held: of these levels, and the coarsest of each cell that is drawn.
    pub held: usize,
}

/// A cell that could be drawn finer.
#[derive(PartialEq)]
struct Candidate {
    /// How much it would gain, in pixels of an error.
    gain: f64,
    cell: usize,
}
impl Eq for Candidate {}
impl PartialOrd for Candidate {
    fn partial_cmp(&self, other: &Self) -> Option<Ordering> {
        Some(self.cmp(other))
    }
}
impl Ord for Candidate {
    fn cmp(&self, other: &Self) -> Ordering {
        self.gain.total_cmp(&other.gain).then(other.cell.cmp(&self.cell))
    }
}

/// Chooses levels for a view within the budget, which counts the chosen level of each cell and its
/// coarsest, kept for moving views.
pub fn choose(manifest: &Manifest, view: &View, budget: usize) -> Choice {
    let cells = &manifest.cells;
    let origin = DVec3::from(manifest.origin);
    let eye = view.camera.center() - origin;
    let distance = |cell: &Cell| {
        let nearest = eye.clamp(DVec3::from(cell.low), DVec3::from(cell.high));
        eye.distance(nearest).max(view.near)
    };
    let distances: Vec<f64> = cells.iter().map(distance).collect();
    let seen: Vec<bool> = cells.iter().map(|cell| is_seen(cell, &view.camera, origin)).collect();
    let mut order: Vec<usize> = (0..cells.len()).collect();
    order.sort_by(|&a, &b| {
        seen[b].cmp(&seen[a]).then(distances[a].total_cmp(&distances[b])).then(a.cmp(&b))
    });

    let mut out = Choice { levels: vec![None; cells.len()], order: Vec::new(), held: 0 };
    let mut unseen = 0;
    for &i in &order {
        let Some(level) = cells[i].runs.iter().rposition(Option::is_some) else { continue };
        let count = count(&cells[i], level);
        let fits =
            out.held + count <= budget && (seen[i] || unseen + count <= budget / UNSEEN_PART);
        if fits {
            out.levels[i] = Some(level);
            out.order.push(i);
            out.held += count;
            unseen += if seen[i] { 0 } else { count };
        }
    }
    let focal = view.camera.fx.max(view.camera.fy);
    let candidate = |i: usize, level: usize| -> Option<Candidate> {
        let cell = &cells[i];
        let scale = focal / distances[i];
        let spacing = (face(&cell.low, &cell.high) / count(cell, level) as f64).sqrt();
        let is_fine = spacing * scale <= view.pixels;
        let can_gain = seen[i] && !is_fine && finer(cell, level).is_some();
        can_gain.then(|| Candidate { gain: cell.errors[level] * scale, cell: i })
    };
    let start = out.order.iter().filter_map(|&i| candidate(i, out.levels[i]?));
    let mut candidates: BinaryHeap<Candidate> = start.collect();
    while let Some(Candidate { cell: i, .. }) = candidates.pop() {
        let cell = &cells[i];
        let Some((level, next)) = out.levels[i].and_then(|l| Some((l, finer(cell, l)?))) else {
            continue;
        };
        let more = held(cell, next).saturating_sub(held(cell, level));
        if out.held + more <= budget {
            out.held += more;
            out.levels[i] = Some(next);
            candidates.extend(candidate(i, next));
        }
    }
    out
}

/// All cells at their coarsest level, as far as the budget permits.
pub fn coarsest(manifest: &Manifest, budget: usize) -> Choice {
    let cells = &manifest.cells;
    let mut out = Choice { levels: vec![None; cells.len()], order: Vec::new(), held: 0 };
    for (i, cell) in cells.iter().enumerate() {
        let Some(level) = cell.runs.iter().rposition(Option::is_some) else { continue };
        if out.held + count(cell, level) <= budget {
            out.held += count(cell, level);
            out.levels[i] = Some(level);
            out.order.push(i);
        }
    }
    out
}

/// The next finer level that a cell has.
fn finer(cell: &Cell, level: usize) -> Option<usize> {
    cell.runs[..level].iter().rposition(Option::is_some)
}

fn count(cell: &Cell, level: usize) -> usize {
    cell.runs[level].map_or(0, |run| run.count)
}

/// Splats in memory for a cell at a level; the coarsest level stays loaded too.
fn held(cell: &Cell, level: usize) -> usize {
    let coarsest = cell.runs.iter().rposition(Option::is_some).filter(|&c| c != level);
    count(cell, level) + coarsest.map_or(0, |c| count(cell, c))
}

/// Whether a part of a cell may be in the picture.
fn is_seen(cell: &Cell, camera: &Camera, origin: DVec3) -> bool {
    let (low, high) = (DVec3::from(cell.low), DVec3::from(cell.high));
    let middle = camera.viewmat.transform_point3((low + high) * 0.5 + origin);
    let radius = 0.5 * low.distance(high) * REACH;
    // Distances to the planes through the eye and the picture's edges, and through the eye.
    let (width, height) = (f64::from(camera.width), f64::from(camera.height));
    let side = |along: f64, edge: f64| {
        let slope = edge.abs();
        (slope * middle.z - along * edge.signum()) / slope.hypot(1.0)
    };
    middle.z >= -radius
        && side(middle.x, -camera.cx / camera.fx) >= -radius
        && side(middle.x, (width - camera.cx) / camera.fx) >= -radius
        && side(middle.y, -camera.cy / camera.fy) >= -radius
        && side(middle.y, (height - camera.cy) / camera.fy) >= -radius
}

#[cfg(test)]
mod tests {
    use std::path::PathBuf;

    use glam::DMat4;

    use super::super::manifest::Run;
    use super::*;

    /// Ten cells in a row along z, of 100, 25 and 6 splats.
    fn row() -> Manifest {
        let cell = |i: usize| Cell {
            low: [-0.5, -0.5, i as f64],
            high: [0.5, 0.5, i as f64 + 1.0],
            runs: [100, 25, 6]
                .iter()
                .enumerate()
                .map(|(level, &count)| Some(Run { file: level, offset: i * count, count }))
                .collect(),
            errors: vec![0.0, 0.1, 0.2],
        };
        Manifest {
            folder: PathBuf::new(),
            files: vec![PathBuf::new(); 3],
            levels: 3,
            origin: [0.0, 0.0, 1000.0],
            cells: (0..10).map(cell).collect(),
            environment: None,
        }
    }

    fn view(z: f64, pixels: f64) -> View {
        let viewmat = DMat4::from_translation(DVec3::new(0.0, 0.0, -z));
        let [f, c] = [300.0, 100.0];
        let camera = Camera { viewmat, fx: f, fy: f, cx: c, cy: c, width: 200, height: 200 };
        View { camera, near: 0.1, pixels }
    }

    #[test]
    fn near_cells_are_finer_and_the_budget_is_never_exceeded() {
        let manifest = row();
        for budget in [0, 5, 6, 59, 60, 100, 171, 400, 1000, 5000] {
            let choice = choose(&manifest, &view(995.0, 0.0), budget);
            assert!(choice.held <= budget, "{} of {budget}", choice.held);
            let levels: Vec<usize> = choice.levels.iter().flatten().copied().collect();
            assert_eq!(levels.len(), (budget / 6).min(10));
            assert!(levels.is_sorted(), "{levels:?}");
        }
        assert_eq!(choose(&manifest, &view(995.0, 0.0), 5000).levels, vec![Some(0); 10]);
        // A small part of the budget is left over: the next cell would not fit.
        assert!(choose(&manifest, &view(995.0, 0.0), 400).held > 300);
    }

    #[test]
    fn cells_outside_of_the_picture_stay_coarse() {
        let choice = choose(&row(), &view(1005.2, 0.0), 5000);
        assert_eq!(choice.levels[..4], [Some(2); 4]);
        assert_eq!(choice.levels[6..], [Some(0); 4]);
        let few = choose(&row(), &view(1020.0, 0.0), 40);
        assert_eq!(few.levels.iter().flatten().count(), 1);
    }

    #[test]
    fn levels_are_no_finer_than_visible() {
        let manifest = row();
        let far = choose(&manifest, &view(700.0, 1.0), 5000);
        assert_eq!(far.levels, vec![Some(2); 10]);
        let near = choose(&manifest, &view(999.0, 1.0), 5000);
        assert_eq!(near.levels[0], Some(0));
        assert!(near.held > far.held);
    }
}
