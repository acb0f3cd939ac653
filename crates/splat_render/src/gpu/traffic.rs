//! How many bytes kernels move: what each binding is to a kernel, times the size that is bound.
//!
//! A row counts once per load and once per store, as if nothing of it were in a cache from the
//! dispatch before, and as if all that a workgroup reads twice (margins of the loss's window, scans
//! of a histogram) came from one.

use super::device::{Gpu, Op};
use super::shaders::Kernel;

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
}

use Touch::{Pairs, PerPair, Small, Visible, Whole};

impl Touch {
    fn part(self, counts: &Counts) -> f64 {
        match self {
            Small => 0.0,
            Whole(times) => f64::from(times),
            Visible(times) => f64::from(times) * counts.visible / counts.splats,
            Pairs(times) => f64::from(times) * counts.pairs / counts.capacity,
            PerPair => counts.pairs / counts.splats,
        }
    }
}

/// What each binding is to a kernel, in the order of their numbers; `of_pairs` where a sort is one of
/// pairs. Weights, depths and list parts of the software adapters do not count.
fn touches(kernel: Kernel, of_pairs: bool) -> &'static [Touch] {
    match kernel {
        Kernel::Project => &[Small, Small, Whole(1), Visible(1), Whole(1)],
        Kernel::DepthKeys => &[Small, Small, Whole(1), Whole(1), Whole(1), Small],
        Kernel::TileCounts => &[Small, Small, Whole(1), Small, Whole(1), Whole(1)],
        Kernel::ScanSums => &[Small, Whole(1), Small, Small],
        Kernel::ScanApply => &[Small, Whole(3), Small, Small],
        Kernel::Emit => &[
            Small, Small, Whole(1), Small, Whole(1), Whole(1), Pairs(1), Pairs(1), Pairs(1),
        ],
        Kernel::SortHistogram if of_pairs => &[Small, Small, Pairs(1), Small, Small, Small, Small],
        Kernel::SortHistogram => &[Small, Small, Whole(1), Small, Small, Small, Small],
        Kernel::SortScan => &[Small; 7],
        Kernel::SortScatter if of_pairs => {
            &[Small, Small, Pairs(1), Pairs(1), Small, Pairs(1), Pairs(1)]
        }
        Kernel::SortScatter => &[Small, Small, Whole(1), Whole(1), Small, Whole(1), Whole(1)],
        Kernel::Ranges => &[Small, Small, Pairs(1), Pairs(1), Pairs(1), Pairs(1), Whole(1)],
        Kernel::Rasterize => {
            &[Small, Small, PerPair, Whole(1), Pairs(1), Whole(1), Whole(1)]
        }
        Kernel::RasterizeBackward | Kernel::RasterizeBackwardAbsolute => &[
            Small, Small, PerPair, Whole(1), Pairs(1), Pairs(1), Whole(1), Whole(1), Pairs(1), Small,
        ],
        Kernel::RasterizeBackwardSum | Kernel::RasterizeBackwardSumAbsolute => {
            &[Small, Small, Whole(1), Whole(1), Whole(1), Pairs(1), Whole(1)]
        }
        Kernel::Exposure => &[Small, Small, Whole(1), Whole(1), Small, Small, Small],
        Kernel::ExposureBackward => {
            &[Small, Small, Whole(1), Small, Whole(2), Whole(2), Small]
        }
        Kernel::LossSlopes => {
            &[Small, Small, Whole(1), Whole(1), Small, Whole(1), Small, Small, Small]
        }
        Kernel::LossGradient => {
            &[Small, Small, Whole(1), Whole(1), Small, Whole(1), Whole(1), Whole(1), Small]
        }
        Kernel::LossColumns => {
            &[Small, Small, Whole(1), Whole(1), Small, Whole(1), Small, Small, Small]
        }
        Kernel::LossRows => {
            &[Small, Small, Small, Small, Small, Whole(2), Small, Small, Small]
        }
        Kernel::LossColumnsGradient => {
            &[Small, Small, Whole(1), Whole(1), Small, Whole(1), Whole(1), Whole(1), Small]
        }
        Kernel::DepthLoss => {
            &[Small, Small, Whole(1), Whole(1), Whole(1), Whole(2), Whole(2), Small]
        }
        Kernel::ProjectBackward => &[
            Small, Small, Visible(1), Visible(1), Whole(1), Visible(1), Whole(1), Whole(1), Whole(1),
        ],
        Kernel::AdamGeometry => &[
            Small, Small, Small, Small, Whole(2), Whole(1), Whole(2), Whole(2), Whole(1),
            Visible(1), Visible(2),
        ],
        Kernel::AdamColors => &[
            Small, Small, Small, Small, Whole(2), Whole(1), Whole(2), Whole(2), Small, Small, Small,
        ],
    }
}

/// Bytes that a command reads and writes; `pair_keys` is the size of a buffer with a word for each pair.
pub(super) fn bytes(gpu: &Gpu, op: &Op, pair_keys: u64, counts: &Counts) -> f64 {
    match op {
        Op::Dispatch { kernel, bound, .. } => {
            let touches = touches(*kernel, bound.get(2) == Some(&pair_keys));
            let sizes = bound.iter().map(|&size| size as f64);
            sizes.zip(touches).map(|(size, touch)| size * touch.part(counts)).sum()
        }
        Op::Clear(buffer) => gpu.size_of(buffer) as f64,
        Op::Copy(.., bytes) => 2.0 * *bytes as f64,
    }
}
