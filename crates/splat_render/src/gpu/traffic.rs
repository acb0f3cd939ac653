//! How many bytes kernels move: what each binding is to a kernel, times the size that is bound.
//!
//! A row counts once per load and once per store, as if nothing of it were in a cache from the
//! dispatch before, and as if all that a workgroup reads twice (margins of the loss's window, scans
//! of a histogram) came from one.

use super::device::{Gpu, Op};
use super::kernels::Kernel;
use super::project::SPLAT_2D;

/// What a picture's work is made of.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Counts {
    pub splats: f64,
    /// Splats that are not culled.
    pub visible: f64,
    /// (splat, tile) pairs.
    pub pairs: f64,
    /// Pairs that there is room for.
    pub capacity: f64,
}

/// The part of a binding that a kernel touches, and how often.
#[derive(Debug, Clone, Copy)]
enum Touch {
    /// Nothing that grows with the scene: uniforms, histograms.
    Small,
    /// All of it, so often: 1 to read or to write, 2 to do both.
    Whole(u32),
    /// Rows of splats that are not culled.
    Visible(u32),
    /// Rows of the pairs there are, of those that there is room for.
    Pairs(u32),
    /// Rows of splats, one for each pair.
    PerPair,
    /// The radii of all 2D splats, of which such rows are, and the rest of those that are not culled.
    Radii,
}

use Touch::{Pairs, PerPair, Radii, Small, Visible, Whole};

/// Radii in a 2D splat.
const RADII_PART: f64 = 2.0 / SPLAT_2D as f64;

impl Touch {
    fn part(self, counts: &Counts) -> f64 {
        match self {
            Small => 0.0,
            Whole(times) => f64::from(times),
            Visible(times) => f64::from(times) * counts.visible / counts.splats,
            Pairs(times) => f64::from(times) * counts.pairs / counts.capacity,
            PerPair => counts.pairs / counts.splats,
            Radii => RADII_PART + (1.0 - RADII_PART) * counts.visible / counts.splats,
        }
    }
}

/// What a pass of a sort goes through.
#[derive(Debug, Clone, Copy)]
enum Sorted {
    /// Keys of all splats, to those of the splats that are not culled.
    All,
    Visible,
    Pairs,
}

/// What each binding is to a kernel, in the order of their numbers, and a sort's pass. Weights of pixels
/// and what only software adapters keep do not count.
fn touches(kernel: Kernel, sorted: Sorted) -> &'static [Touch] {
    match kernel {
        Kernel::Project => &[Small, Small, Whole(1), Visible(1), Radii, Whole(1)],
        Kernel::FitProject => &[
            Small,
            Small,
            Whole(1),
            Visible(2),
            Radii,
            Whole(1),
            Visible(2),
            Visible(2),
            Visible(2),
            Small,
            Small,
        ],
        Kernel::CatchUpAll => &[
            Small,
            Small,
            Small,
            Whole(2),
            Small,
            Small,
            Whole(2),
            Whole(2),
            Whole(2),
            Small,
            Small,
        ],
        Kernel::DepthKeys => &[Small, Small, Whole(1), Small, Small, Whole(1)],
        Kernel::TileCounts => &[Small, Small, Visible(1), Small, Visible(1), Visible(1)],
        Kernel::ScanSums => &[Small, Visible(1), Small, Small, Small],
        Kernel::ScanApply => &[Small, Visible(3), Small, Small, Small],
        Kernel::Emit => {
            &[Small, Small, Visible(1), Small, Visible(1), Visible(1), Pairs(1), Pairs(1), Pairs(1)]
        }
        Kernel::SortHistogram | Kernel::SortCount => match sorted {
            Sorted::All => &[Small, Small, Whole(1), Small, Small, Small, Small],
            Sorted::Visible => &[Small, Small, Visible(1), Small, Small, Small, Small],
            Sorted::Pairs => &[Small, Small, Pairs(1), Small, Small, Small, Small],
        },
        Kernel::SortScan => &[Small; 7],
        Kernel::SortScatter | Kernel::SortPlace => match sorted {
            Sorted::All => &[Small, Small, Whole(1), Small, Small, Visible(1), Visible(1)],
            Sorted::Visible => {
                &[Small, Small, Visible(1), Visible(1), Small, Visible(1), Visible(1)]
            }
            Sorted::Pairs => &[Small, Small, Pairs(1), Pairs(1), Small, Pairs(1), Pairs(1)],
        },
        Kernel::Ranges => &[Small, Small, Pairs(1), Pairs(1), Pairs(1), Pairs(1), Whole(1)],
        Kernel::Rasterize => &[Small, Small, PerPair, Whole(1), Pairs(1), Whole(1), Whole(1)],
        Kernel::RasterizeBackward | Kernel::RasterizeBackwardAbsolute => &[
            Small,
            Small,
            PerPair,
            Whole(1),
            Pairs(1),
            Pairs(1),
            Whole(1),
            Whole(1),
            Pairs(1),
            Small,
        ],
        Kernel::RasterizeBackwardSum | Kernel::RasterizeBackwardSumAbsolute => {
            &[Small, Small, Visible(1), Visible(1), Visible(1), Pairs(1), Visible(1)]
        }
        Kernel::Exposure => &[Small, Small, Whole(1), Whole(1), Small, Small, Small],
        Kernel::ExposureBackward => &[Small, Small, Whole(1), Small, Whole(2), Whole(2), Small],
        Kernel::LossSlopes => {
            &[Small, Small, Whole(1), Whole(1), Small, Whole(1), Small, Small, Small]
        }
        Kernel::LossGradient => {
            &[Small, Small, Whole(1), Whole(1), Small, Whole(1), Whole(1), Whole(1), Small]
        }
        Kernel::LossColumns => {
            &[Small, Small, Whole(1), Whole(1), Small, Whole(1), Small, Small, Small]
        }
        Kernel::LossRows => &[Small, Small, Small, Small, Small, Whole(2), Small, Small, Small],
        Kernel::LossColumnsGradient => {
            &[Small, Small, Whole(1), Whole(1), Small, Whole(1), Whole(1), Whole(1), Small]
        }
        Kernel::DepthLoss => {
            &[Small, Small, Whole(1), Whole(1), Whole(1), Whole(2), Whole(2), Small]
        }
        Kernel::ProjectBackward => {
            &[Small, Small, Visible(1), Visible(1), Radii, Visible(1), Whole(1), Whole(1), Whole(1)]
        }
        Kernel::FitGeometry => &[
            Small,
            Small,
            Whole(2),
            Visible(1),
            Radii,
            Visible(1),
            Visible(2),
            Whole(1),
            Whole(2),
            Whole(2),
            Small,
        ],
        Kernel::AdamGeometry => &[Small, Small, Whole(2), Whole(1), Whole(2), Whole(2)],
        Kernel::AdamColors => &[Small, Small, Small, Whole(2), Whole(1), Whole(2), Whole(2)],
        Kernel::DensitySums => &[Small, Whole(1), Small, Small, Small],
        Kernel::DensityPrefix => &[Small, Whole(3), Small, Whole(1), Small],
        Kernel::DensityBounds => &[Small, Whole(1), Small, Small],
        Kernel::DensityCodes => &[Small, Whole(1), Whole(1), Whole(1)],
        Kernel::DensityRows => &[Small, Whole(1), Whole(1), Whole(1), Whole(1)],
        Kernel::OriginalPull => {
            &[Small, Whole(1), Whole(1), Whole(1), Whole(1), Small, Small, Whole(1), Small]
        }
        Kernel::OriginalGrow => {
            &[Small, Small, Small, Small, Small, Visible(1), Small, Visible(2), Small]
        }
        Kernel::OriginalKeep => {
            &[Small, Whole(1), Small, Small, Whole(1), Small, Small, Whole(1), Whole(1)]
        }
        Kernel::OriginalDraw => {
            &[Small, Whole(1), Whole(1), Whole(1), Whole(1), Small, Whole(1), Whole(1)]
        }
        Kernel::OriginalReset => &[Small, Whole(2), Whole(1), Whole(1)],
        // Not counted.
        Kernel::McmcSample
        | Kernel::McmcWeigh
        | Kernel::McmcStart
        | Kernel::McmcDraw
        | Kernel::McmcShare
        | Kernel::McmcCopy => &[],
    }
}

/// Bytes that each command reads and writes; `pair_keys` is the size of a buffer with a word per pair.
pub(super) fn bytes(gpu: &Gpu, ops: &[Op], pair_keys: u64, counts: &Counts) -> Vec<f64> {
    // The sort of the splats begins with the keys that project has made; each kernel of a pass once.
    let mut first_pass = vec![Kernel::SortCount, Kernel::SortPlace];
    let mut of = |op: &Op| match op {
        Op::Dispatch { kernel, bound, .. } => {
            let sorted = if bound.get(2) == Some(&pair_keys) {
                Sorted::Pairs
            } else if first_pass.contains(kernel) {
                first_pass.retain(|first| first != kernel);
                Sorted::All
            } else {
                Sorted::Visible
            };
            let touches = touches(*kernel, sorted);
            let sizes = bound.iter().map(|&size| size as f64);
            sizes.zip(touches).map(|(size, touch)| size * touch.part(counts)).sum()
        }
        Op::Clear(buffer) => gpu.size_of(buffer) as f64,
        Op::Copy(.., bytes) => 2.0 * *bytes as f64,
    };
    ops.iter().map(&mut of).collect()
}
