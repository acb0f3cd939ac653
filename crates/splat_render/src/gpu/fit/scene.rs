//! A fit's buffers whose size depends on the number of splats or pairs.

use crate::error::Result;
use crate::fit_device::{FitState, McmcRun, OriginalRun};
use crate::gpu::adam::AdamBuffers;
use crate::gpu::bin::{PairBins, SplatBins, pair_limit};
use crate::gpu::device::{Gpu, Op};
use crate::gpu::drawn::{Drawn, RowKind};
use crate::gpu::layout::{CAMERA, GEOMETRY, GRADIENT};
use crate::gpu::project::{Projection, SPLAT_2D, count};
use crate::gpu::project_backward::{camera_buffer, camera_sums};
use crate::gpu::{mcmc, original};

/// Initial capacity, pairs per splat; grows on demand.
const PAIRS_PER_SPLAT: u32 = 4;

/// Buffers that depend on the number of splats or pairs.
#[derive(Debug)]
pub(super) struct Scene {
    pub adam: AdamBuffers,
    pub sh_degree: u32,
    pub splats2d: wgpu::Buffer,
    pub v_splats2d: wgpu::Buffer,
    pub v_camera: wgpu::Buffer,
    /// The camera sums of each pending step; None until a step is to have them.
    pub pending_cameras: Option<wgpu::Buffer>,
    pub bins: SplatBins,
    /// Copy of `bins.status` for the host.
    pub status_copy: wgpu::Buffer,
    /// Chunks that `bins` has counts for.
    pub chunks: u32,
    pub pairs: PairBins,
    pub slots: wgpu::Buffer,
    pub capacity: u32,
    /// Commands that bring all colors up to date. Empty until needed, and whenever a buffer was replaced.
    pub catch_up: Vec<Op>,
}

/// The pair buffers and their gradient slots.
pub(super) fn pair_buffers(
    gpu: &Gpu,
    capacity: u32,
    tiles: u32,
) -> Result<(PairBins, wgpu::Buffer)> {
    let bytes = u64::from(capacity) * GRADIENT as u64 * 4;
    Ok((PairBins::new(gpu, capacity, tiles)?, gpu.bindable("gradient slots", bytes)?))
}

impl Scene {
    /// Of this state, with room for `capacity` pairs at least.
    pub fn upload(
        gpu: &Gpu,
        state: &FitState,
        tiles: u32,
        capacity: u32,
        chunks: u32,
    ) -> Result<Self> {
        let adam = AdamBuffers::upload(
            gpu,
            [&state.splats, &state.first, &state.second].map(|a| a.params(a.sh_degree)),
            &state.stats,
            state.moving() as u32,
        )?;
        Self::new(gpu, adam, state.splats.sh_degree, tiles, capacity, chunks)
    }

    pub fn new(
        gpu: &Gpu,
        adam: AdamBuffers,
        sh_degree: u32,
        tiles: u32,
        capacity: u32,
        chunks: u32,
    ) -> Result<Self> {
        let n = adam.splats.splats;
        let first_guess = n.saturating_mul(PAIRS_PER_SPLAT).max(4096);
        let capacity = capacity.max(first_guess).min(pair_limit(gpu, GRADIENT));
        let (pairs, slots) = pair_buffers(gpu, capacity, tiles)?;
        let row = |floats: usize| u64::from(n) * floats as u64 * 4;
        Ok(Self {
            sh_degree,
            splats2d: gpu.bindable("splats2d", row(SPLAT_2D))?,
            v_splats2d: gpu.bindable("v_splats2d", row(GRADIENT))?,
            v_camera: camera_buffer(gpu, n)?,
            pending_cameras: None,
            bins: SplatBins::new(gpu, n, chunks)?,
            status_copy: gpu.readable(SplatBins::status_bytes(chunks)),
            chunks,
            pairs,
            slots,
            capacity,
            catch_up: Vec::new(),
            adam,
        })
    }

    /// Whether density control with a result of `splats` splats runs on the device.
    fn binds(&self, gpu: &Gpu, splats: u32) -> bool {
        let floats = self.adam.splats.color_floats.max(GEOMETRY as u64);
        self.adam.moving == self.len() && u64::from(splats) * 4 * floats <= gpu.binding_limit
    }

    /// The scene after MCMC's density control; None if an array exceeds a binding or splats are frozen.
    pub fn after_mcmc(
        &self,
        gpu: &Gpu,
        run: &McmcRun,
        tiles: u32,
        shares: &wgpu::Buffer,
    ) -> Result<Option<Self>> {
        let splats = &self.adam.splats;
        if !self.binds(gpu, count(run.target.max(self.len() as usize))?) {
            return Ok(None);
        }
        let arrays = (&splats.geometry, &splats.colors);
        let drawn = mcmc::draw(gpu, arrays, (self.len(), splats.color_floats as u32), run, shares)?;
        self.after(gpu, &drawn, tiles).map(Some)
    }

    /// The scene after a run of the original density control; None as in [`Self::after_mcmc`].
    pub fn after_original(&self, gpu: &Gpu, run: &OriginalRun, tiles: u32) -> Result<Option<Self>> {
        if !self.binds(gpu, self.len()) {
            return Ok(None);
        }
        let now = (&self.adam, &self.bins);
        let drawn = original::draw(gpu, now, run, |splats| self.binds(gpu, splats))?;
        drawn.map(|drawn| self.after(gpu, &drawn, tiles)).transpose()
    }

    fn after(&self, gpu: &Gpu, drawn: &Drawn, tiles: u32) -> Result<Self> {
        let (next, ops) = self.arranged(gpu, drawn, tiles)?;
        gpu.submit(&[&ops])?;
        Ok(next)
    }

    /// A new scene after density control, and the commands that fill it; statistics are reset.
    pub fn arranged(&self, gpu: &Gpu, drawn: &Drawn, tiles: u32) -> Result<(Self, Vec<Op>)> {
        let AdamBuffers { splats, first, second, .. } = &self.adam;
        let floats = [GEOMETRY as u32, splats.color_floats as u32];
        // The old buffers stay until all new ones are allocated.
        let adam = AdamBuffers::new(gpu, drawn.splats, splats.color_floats)?;
        let next = Self::new(gpu, adam, self.sh_degree, tiles, self.capacity, self.chunks)?;
        let mut ops = drawn.order_ops(gpu, &next.bins);
        let mut put = |from, to, floats, kind| {
            ops.push(drawn.row_op(gpu, &next.bins, (from, to), floats, kind));
        };
        let to = &next.adam;
        put(&drawn.geometry, &to.splats.geometry, floats[0], RowKind::Geometry);
        put(&splats.colors, &to.splats.colors, floats[1], RowKind::Colors);
        for (from, to) in [(first, &to.first), (second, &to.second)] {
            put(&from.geometry, &to.geometry, floats[0], RowKind::Moments);
            put(&from.colors, &to.colors, floats[1], RowKind::Moments);
        }
        ops.push(Op::Clear(next.adam.notes.clone()));
        Ok((next, ops))
    }

    /// Makes the commands that bring all colors up to date, unless they are there already.
    pub fn prepare(&mut self, gpu: &Gpu, view: &wgpu::Buffer, color_steps: &wgpu::Buffer) {
        if self.catch_up.is_empty() {
            let drawn = Projection { view, splats2d: &self.splats2d };
            self.catch_up = self.adam.catch_up_ops(gpu, drawn, &self.bins, color_steps);
        }
    }

    pub fn len(&self) -> u32 {
        self.adam.splats.splats
    }

    pub fn camera_bytes(&self) -> u64 {
        u64::from(camera_sums(self.len())) * CAMERA as u64 * 4
    }

    /// The state as it is now; all steps must be done, and all colors up to date.
    pub fn download(&self, gpu: &Gpu) -> Result<FitState> {
        let ([splats, first, second], stats) = self.adam.download(gpu, &[], self.sh_degree)?;
        Ok(FitState {
            splats,
            first,
            second,
            stats,
            frozen: (self.len() - self.adam.moving) as usize,
        })
    }
}
