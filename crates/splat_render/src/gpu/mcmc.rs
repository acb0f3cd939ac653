//! MCMC's density control on the device, with the bits of `fit_device::mcmc`: dead splats move to living
//! ones, fresh ones are added, and all are put in the order of Morton's curve. The host learns the
//! centres of a sample, what the weights add up to, and the bounding box.

use bytemuck::{Pod, Zeroable};
use rayon::prelude::*;

use super::bin::SplatBins;
use super::device::{Bound, Gpu, Op};
use super::layout::GEOMETRY;
use super::shaders::Kernel;
use crate::error::Result;
use crate::fit_device::{Cells, FogCamera, McmcRun, sampled_every, share_table, weight_table};

/// Workgroups of the scan over weights and of the bounding box (mcmc_weigh.wgsl, mcmc_order.wgsl).
const SEGMENTS: u32 = 256;
const BOUNDS_GROUPS: u32 = 64;
/// Floats per workgroup of mcmc_rows.
const ROW_FLOATS_PER_GROUP: u32 = 256;

/// What the kernels are told of a round.
#[repr(C)]
#[derive(Debug, Clone, Copy, PartialEq, Pod, Zeroable)]
pub(super) struct Run {
    pub splats: u32,
    pub fresh: u32,
    pub seed: u32,
    pub round: u32,
    pub cameras: u32,
    pub every: u32,
    pub color_floats: u32,
    pub unused: u32,
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

/// What a row of an array becomes.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum RowKind {
    /// It is copied from its place in the drawn geometry.
    Geometry = 0,
    /// It is copied from where its source was.
    Colors = 1,
    /// It is copied, or becomes zero.
    Moments = 2,
}

/// The table of shares on the device, made once.
pub(super) fn shares(gpu: &Gpu) -> Result<wgpu::Buffer> {
    gpu.upload("shares", share_table())
}

/// Splats after a run, not yet in their new order.
#[derive(Debug)]
pub(super) struct Drawn {
    /// `[N after * GEOMETRY]`
    pub geometry: wgpu::Buffer,
    /// `[N after]` twice the row of a splat's colours, and 1 where its moments are zero.
    rows: wgpu::Buffer,
    /// Splats after the run.
    pub splats: u32,
    cells: Cells,
}

impl Drawn {
    /// Draws what `run` moves and adds; `geometry` and `colors` of `n` splats are only read.
    pub fn new(
        gpu: &Gpu,
        (geometry, colors): (&wgpu::Buffer, &wgpu::Buffer),
        (n, color_floats): (u32, u32),
        run: &McmcRun,
        shares: &wgpu::Buffer,
    ) -> Result<Self> {
        let fresh = (run.target as u64).saturating_sub(u64::from(n)) as u32;
        let words = |label, count: u32| gpu.bindable(label, 4 * u64::from(count));
        let row_bytes = GEOMETRY as u64 * 4;
        let drawn = gpu.bindable("geometry", u64::from(n + fresh) * row_bytes)?;
        let copy = Op::Copy(geometry.clone(), drawn.clone(), 0, u64::from(n) * row_bytes);
        let every = sampled_every(n as usize) as u32;
        let first = Run {
            splats: n,
            fresh,
            seed: run.seed,
            round: 0,
            cameras: run.cameras.len() as u32,
            every,
            color_floats,
            unused: 0,
        };
        let rounds = [first, Run { round: 1, cameras: 0, ..first }].map(|run| gpu.uniform(&run));
        let table = gpu.upload("weights by opacity", &weight_table((n + fresh) as usize))?;
        let weights = words("weights", n)?;
        let segments = words("segment sums", 2 * SEGMENTS)?;
        let dead = words("dead splats", n)?;
        let totals = words("totals", 4)?;
        let weigh = |kernel, run, cameras: &wgpu::Buffer, words: &wgpu::Buffer, groups| {
            let bindings: [Bound<'_>; 9] = [
                run,
                (&drawn).into(),
                colors.into(),
                cameras.into(),
                (&table).into(),
                words.into(),
                (&segments).into(),
                (&dead).into(),
                (&totals).into(),
            ];
            gpu.op(kernel, &bindings, groups)
        };
        let samples = n.div_ceil(every);
        let sample = words("sample", 3 * samples)?;
        // Bound and not read where only centres are asked for.
        let none = gpu.buffer("cameras", size_of::<FogCamera>() as u64)?;
        let centres: Vec<[f32; 3]> = if run.cameras.is_empty() {
            gpu.submit(&[&[copy]])?;
            Vec::new()
        } else {
            let of = gpu.groups(samples, 64);
            let op = weigh(Kernel::McmcSample, (&rounds[0]).into(), &none, &sample, of);
            let data = gpu.download(&[copy, op], &[(&sample, 12 * u64::from(samples))])?;
            bytemuck::pod_collect_to_vec(&data[0])
        };
        let fog: Vec<FogCamera> =
            run.cameras.par_iter().map(|camera| FogCamera::new(camera, &centres)).collect();
        let cameras = if fog.is_empty() { none } else { gpu.upload("cameras", &fog)? };

        let copies = words("copies", n + fresh)?;
        let sources = words("sources", n.max(fresh))?;
        let rows = words("rows", n + fresh)?;
        let spread = |kernel, round: usize, count: u32| {
            let bindings = [
                (&rounds[round]).into(),
                (&drawn).into(),
                (&weights).into(),
                (&dead).into(),
                (&totals).into(),
                (&copies).into(),
                (&sources).into(),
                (&rows).into(),
                shares.into(),
            ];
            gpu.op(kernel, &bindings, gpu.groups(count, 64))
        };
        let mut ops = vec![spread(Kernel::McmcStart, 0, n + fresh)];
        for (round, targets) in [n, fresh].into_iter().enumerate() {
            let weigh =
                |kernel, groups| weigh(kernel, (&rounds[round]).into(), &cameras, &weights, groups);
            ops.extend([
                weigh(Kernel::McmcWeigh, gpu.groups(n, 64)),
                weigh(Kernel::McmcSums, [SEGMENTS, 1]),
                weigh(Kernel::McmcPrefix, [SEGMENTS, 1]),
                spread(Kernel::McmcDraw, round, targets),
                spread(Kernel::McmcShare, round, n),
                spread(Kernel::McmcCopy, round, targets),
            ]);
        }
        // Fresh splats lie where their sources do.
        let corners = words("corners", 6 * BOUNDS_GROUPS)?;
        let whole = CellsUniform { splats: n, ..CellsUniform::zeroed() };
        let whole = gpu.uniform(&whole);
        let bounds = [(&whole).into(), (&drawn).into(), (&rows).into(), (&corners).into()];
        ops.push(gpu.op(Kernel::McmcBounds, &bounds, [BOUNDS_GROUPS, 1]));
        let wanted = [(&totals, 16), (&corners, 24 * u64::from(BOUNDS_GROUPS))];
        let data = gpu.download(&ops, &wanted)?;
        let totals: [u32; 4] = bytemuck::pod_read_unaligned(&data[0]);
        let corners: Vec<[f32; 6]> = bytemuck::pod_collect_to_vec(&data[1]);
        let (mut low, mut high) = ([f32::INFINITY; 3], [f32::NEG_INFINITY; 3]);
        for corner in corners {
            for k in 0..3 {
                low[k] = low[k].min(corner[k]);
                high[k] = high[k].max(corner[k + 3]);
            }
        }
        Ok(Self {
            geometry: drawn,
            rows,
            // Nothing grows of dead splats alone.
            splats: if totals[2] == 0 { n } else { n + fresh },
            cells: Cells::new(low, high),
        })
    }

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
            gpu.op(Kernel::McmcCodes, &bindings, gpu.groups(self.splats, 64))
        };
        let mut ops = vec![codes(0)];
        ops.extend(bins.depth_ops(gpu, true));
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
        gpu.op(Kernel::McmcRows, &bindings, groups)
    }
}
