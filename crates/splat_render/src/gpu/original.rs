//! The original density control on the device, with the bits of `fit_device::original`. The host reads
//! the numbers of splats that stay and grow, and the bounding box.

use bytemuck::{Pod, Zeroable};

use super::adam::AdamBuffers;
use super::bin::SplatBins;
use super::device::{Bound, Gpu, Op};
use super::drawn::{Bounds, Drawn, Scans, words};
use super::kernels::Kernel;
use super::layout::{GEOMETRY, SPLATS_PER_GROUP};
use super::project::{count, window_uniform};
use crate::error::Result;
use crate::fit_device::OriginalRun;

#[repr(C)]
#[derive(Debug, Clone, Copy, PartialEq, Pod, Zeroable)]
pub(super) struct RunUniform {
    pub splats: u32,
    pub color_floats: u32,
    pub room: u32,
    pub seed: u32,
    pub log_split: f32,
    pub log_huge: f32,
    pub keeps_all: u32,
    /// Always 0 (`rounded` in shared.wgsl).
    pub zero: u32,
}

/// A run: the choice of splats that stay and grow.
#[derive(Debug)]
pub(super) struct Choice<'a> {
    adam: &'a AdamBuffers,
    /// Bins of the scene before the run, reused for a sort; no step needs their contents.
    bins: &'a SplatBins,
    run: RunUniform,
    uniform: wgpu::Buffer,
    /// Flags of each splat (original_run.wgsl).
    flags: wgpu::Buffer,
    growing: wgpu::Buffer,
    /// Indices of splats that stay, and of staying splats that grow, ascending.
    lists: [wgpu::Buffer; 2],
    scans: Scans,
}

impl<'a> Choice<'a> {
    pub fn new(
        gpu: &Gpu,
        adam: &'a AdamBuffers,
        bins: &'a SplatBins,
        run: &OriginalRun,
    ) -> Result<Self> {
        let n = adam.splats.splats;
        let [log_split, log_huge] = run.log_limits();
        let run = RunUniform {
            splats: n,
            color_floats: adam.splats.color_floats as u32,
            room: u32::try_from(run.max_splats.saturating_sub(n as usize)).unwrap_or(u32::MAX),
            seed: run.seed,
            log_split,
            log_huge,
            keeps_all: 0,
            zero: 0,
        };
        Ok(Self {
            adam,
            bins,
            run,
            uniform: gpu.uniform(&run),
            flags: words(gpu, "flags of splats", n)?,
            growing: words(gpu, "growing", n)?,
            lists: [words(gpu, "staying splats", n)?, words(gpu, "growing splats", n)?],
            scans: Scans::new(gpu, n)?,
        })
    }

    fn choose_op(&self, gpu: &Gpu, kernel: Kernel, uniform: &wgpu::Buffer) -> Op {
        let AdamBuffers { splats, notes, .. } = self.adam;
        let bindings: [Bound<'_>; 9] = [
            uniform.into(),
            (&splats.geometry).into(),
            (&splats.colors).into(),
            notes.into(),
            self.bins.keys().into(),
            self.bins.order().into(),
            (&self.bins.status).into(),
            (&self.flags).into(),
            (&self.growing).into(),
        ];
        gpu.op(kernel, &bindings, gpu.groups(self.run.splats, SPLATS_PER_GROUP))
    }

    /// Marks the splats that grow.
    pub fn grow_ops(&self, gpu: &Gpu) -> Vec<Op> {
        let mut ops = vec![self.choose_op(gpu, Kernel::OriginalPull, &self.uniform)];
        ops.extend(self.bins.depth_ops(gpu));
        ops.push(self.choose_op(gpu, Kernel::OriginalGrow, &self.uniform));
        ops
    }

    /// Lists the splats that stay (all if `keeps_all`), and the growing ones among them.
    pub fn list_ops(&self, gpu: &Gpu, keeps_all: bool) -> Vec<Op> {
        let uniform = gpu.uniform(&RunUniform { keeps_all: u32::from(keeps_all), ..self.run });
        let mut ops = vec![self.choose_op(gpu, Kernel::OriginalKeep, &uniform)];
        let [staying, growing] = &self.lists;
        ops.extend(self.scans.ops(gpu, 0, self.bins.keys(), staying));
        ops.extend(self.scans.ops(gpu, 1, &self.growing, growing));
        ops
    }

    /// How many splats there are after the run; runs `ops` before.
    fn splats(&self, gpu: &Gpu, ops: &[Op]) -> Result<Option<u32>> {
        let data = gpu.download(ops, &[(&self.scans.totals, Scans::TOTAL_BYTES)])?;
        let [_, staying, _, growing]: [u32; 4] = bytemuck::pod_read_unaligned(&data[0]);
        if staying == 0 { Ok(None) } else { count((staying + growing) as usize).map(Some) }
    }

    /// Makes room for the `splats` splats that there will be, and the commands that fill it.
    pub fn draw(&self, gpu: &Gpu, splats: u32) -> Result<Halfway> {
        let geometry = gpu.bindable("geometry", u64::from(splats) * GEOMETRY as u64 * 4)?;
        let rows = words(gpu, "rows", splats)?;
        let [staying, growing] = &self.lists;
        let bindings = [
            (&self.uniform).into(),
            (&self.adam.splats.geometry).into(),
            (&self.flags).into(),
            staying.into(),
            growing.into(),
            (&self.scans.totals).into(),
            (&geometry).into(),
            (&rows).into(),
        ];
        let op = gpu.op(Kernel::OriginalDraw, &bindings, gpu.groups(splats, SPLATS_PER_GROUP));
        let bounds = Bounds::new(gpu, &geometry, splats, &rows)?;
        Ok(Halfway { geometry, rows, splats, ops: [op, bounds.op], corners: bounds.corners })
    }
}

/// Splats whose bounding box the host does not know yet.
#[derive(Debug)]
pub(super) struct Halfway {
    geometry: wgpu::Buffer,
    rows: wgpu::Buffer,
    splats: u32,
    pub ops: [Op; 2],
    corners: wgpu::Buffer,
}

impl Halfway {
    /// Adds the cells of the box, from the downloaded corners.
    pub fn ordered(self, corners: &[u8]) -> Drawn {
        let Self { geometry, rows, splats, .. } = self;
        Drawn { geometry, rows, splats, cells: Bounds::cells(corners) }
    }
}

/// Makes the splats of a run; None if the result does not fit `binds`.
pub(super) fn draw(
    gpu: &Gpu,
    (adam, bins): (&AdamBuffers, &SplatBins),
    run: &OriginalRun,
    binds: impl Fn(u32) -> bool,
) -> Result<Option<Drawn>> {
    let choice = Choice::new(gpu, adam, bins, run)?;
    let mut ops = choice.grow_ops(gpu);
    ops.extend(choice.list_ops(gpu, false));
    let splats = match choice.splats(gpu, &ops)? {
        Some(splats) => splats,
        // A fit without splats cannot recover: keep all.
        None => choice.splats(gpu, &choice.list_ops(gpu, true))?.unwrap_or(0),
    };
    if !binds(splats) {
        return Ok(None);
    }
    let halfway = choice.draw(gpu, splats)?;
    let data = gpu.download(&halfway.ops, &[(&halfway.corners, Bounds::BYTES)])?;
    Ok(Some(halfway.ordered(&data[0])))
}

/// Lowers the opacities of the splats that are moved, and restarts their moments.
pub(super) fn reset_op(gpu: &Gpu, adam: &AdamBuffers) -> Op {
    // Geometry is bound whole: rows of 2D splats are longer, and are.
    let uniform = window_uniform(gpu, &(0..adam.moving));
    let bindings = [
        (&uniform).into(),
        (&adam.splats.geometry).into(),
        (&adam.first.geometry).into(),
        (&adam.second.geometry).into(),
    ];
    gpu.op(Kernel::OriginalReset, &bindings, gpu.groups(adam.moving, SPLATS_PER_GROUP))
}
