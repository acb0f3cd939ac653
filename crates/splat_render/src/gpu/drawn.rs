//! Shared by the device's density controls: sums over all splats, and sorting the new splats.

use bytemuck::{Pod, Zeroable};

use super::bin::SplatBins;
use super::device::{Gpu, Op};
use super::kernels::Kernel;
use crate::error::Result;
use crate::fit_device::Cells;

/// Workgroups of the scan and of the bounding box (density_scan.wgsl, density_order.wgsl).
const SEGMENTS: u32 = 256;
const BOUNDS_GROUPS: u32 = 64;
/// Floats per workgroup of density_rows.
const ROW_FLOATS_PER_GROUP: u32 = 256;

#[repr(C)]
#[derive(Debug, Clone, Copy, PartialEq, Pod, Zeroable)]
pub(super) struct Scan {
    pub splats: u32,
    pub round: u32,
}

/// The cells of Morton's curve.
#[repr(C)]
#[derive(Debug, Clone, Copy, PartialEq, Pod, Zeroable)]
pub(super) struct CellsUniform {
    pub low: [f32; 3],
    pub splats: u32,
    pub scale: [f32; 3],
    pub upper: u32,
}

/// An array that is put in order.
#[repr(C)]
#[derive(Debug, Clone, Copy, PartialEq, Pod, Zeroable)]
pub(super) struct Rows {
    pub splats: u32,
    pub floats: u32,
    pub kind: u32,
    pub unused: u32,
}

/// The result for a row of an array.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum RowKind {
    /// It is copied from its place in the drawn geometry.
    Geometry = 0,
    /// Copied from its source.
    Colors = 1,
    /// It is copied from there, or becomes zero.
    Moments = 2,
}

pub(super) fn words(gpu: &Gpu, label: &str, count: u32) -> Result<wgpu::Buffer> {
    gpu.bindable(label, 4 * u64::from(count))
}

/// Sums of two rounds over all splats.
#[derive(Debug)]
pub(super) struct Scans {
    splats: u32,
    segments: wgpu::Buffer,
    /// Sum and number of zeros of each round.
    pub totals: wgpu::Buffer,
}

impl Scans {
    pub const TOTAL_BYTES: u64 = 16;

    pub fn new(gpu: &Gpu, splats: u32) -> Result<Self> {
        Ok(Self {
            splats,
            segments: words(gpu, "segment sums", 2 * SEGMENTS)?,
            totals: words(gpu, "totals", 4)?,
        })
    }

    /// Replaces `[N]` `words` by their inclusive sums; `zeros` gets the indices of zero words.
    pub fn ops(
        &self,
        gpu: &Gpu,
        round: u32,
        words: &wgpu::Buffer,
        zeros: &wgpu::Buffer,
    ) -> [Op; 2] {
        let uniform = gpu.uniform(&Scan { splats: self.splats, round });
        let bindings = [
            (&uniform).into(),
            words.into(),
            (&self.segments).into(),
            zeros.into(),
            (&self.totals).into(),
        ];
        [Kernel::DensitySums, Kernel::DensityPrefix]
            .map(|kernel| gpu.op(kernel, &bindings, [SEGMENTS, 1]))
    }
}

/// Splats after a run, not yet in their new order.
#[derive(Debug)]
pub(super) struct Drawn {
    /// `[N after * GEOMETRY]`
    pub geometry: wgpu::Buffer,
    /// `[N after]` twice the row of a splat's colors and moments, plus 1 if its moments are zero.
    pub rows: wgpu::Buffer,
    pub splats: u32,
    pub cells: Cells,
}

/// The bounding box of the first splats' centers, in parts.
#[derive(Debug)]
pub(super) struct Bounds {
    pub corners: wgpu::Buffer,
    pub op: Op,
}

impl Bounds {
    pub const BYTES: u64 = 24 * BOUNDS_GROUPS as u64;

    /// `unused` is any buffer that is not written meanwhile.
    pub fn new(
        gpu: &Gpu,
        geometry: &wgpu::Buffer,
        splats: u32,
        unused: &wgpu::Buffer,
    ) -> Result<Self> {
        let corners = words(gpu, "corners", 6 * BOUNDS_GROUPS)?;
        let uniform = gpu.uniform(&CellsUniform { splats, ..CellsUniform::zeroed() });
        let bindings = [(&uniform).into(), geometry.into(), unused.into(), (&corners).into()];
        let op = gpu.op(Kernel::DensityBounds, &bindings, [BOUNDS_GROUPS, 1]);
        Ok(Self { corners, op })
    }

    /// The cells of the whole box, from the downloaded `corners`.
    pub fn cells(bytes: &[u8]) -> Cells {
        let corners: Vec<[f32; 6]> = bytemuck::pod_collect_to_vec(bytes);
        let (mut low, mut high) = ([f32::INFINITY; 3], [f32::NEG_INFINITY; 3]);
        for corner in corners {
            for k in 0..3 {
                low[k] = low[k].min(corner[k]);
                high[k] = high[k].max(corner[k + 3]);
            }
        }
        Cells::new(low, high)
    }
}

impl Drawn {
    /// Sorts the splats along Morton's curve; their order is `bins.order()` then.
    pub fn order_ops(&self, gpu: &Gpu, bins: &SplatBins) -> Vec<Op> {
        let codes = |upper: u32| {
            let uniform = gpu.uniform(&CellsUniform {
                low: self.cells.low,
                scale: self.cells.scale,
                splats: self.splats,
                upper,
            });
            let bindings = [
                (&uniform).into(),
                (&self.geometry).into(),
                bins.order().into(),
                bins.keys().into(),
            ];
            gpu.op(Kernel::DensityCodes, &bindings, gpu.groups(self.splats, 64))
        };
        let mut ops = vec![codes(0)];
        ops.extend(bins.depth_ops(gpu));
        ops.push(codes(1));
        ops.extend(bins.resort_ops(gpu));
        ops
    }

    /// Puts the rows of an array in that order.
    pub fn row_op(
        &self,
        gpu: &Gpu,
        bins: &SplatBins,
        (from, to): (&wgpu::Buffer, &wgpu::Buffer),
        floats: u32,
        kind: RowKind,
    ) -> Op {
        let uniform =
            gpu.uniform(&Rows { splats: self.splats, floats, kind: kind as u32, unused: 0 });
        let bindings =
            [(&uniform).into(), bins.order().into(), (&self.rows).into(), from.into(), to.into()];
        let groups = gpu.groups(self.splats * floats, ROW_FLOATS_PER_GROUP);
        gpu.op(Kernel::DensityRows, &bindings, groups)
    }
}
