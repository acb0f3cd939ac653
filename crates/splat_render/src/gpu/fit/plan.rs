//! The commands of a fit, made without being run: for scenes larger than the memory at hand.

use bytemuck::Zeroable;

use super::frame::{Frame, Parts, Uniforms};
use super::scene::Scene;
use crate::error::Result;
use crate::fit_device::OriginalRun;
use crate::gpu::adam::AdamBuffers;
use crate::gpu::bin::tile_count;
use crate::gpu::device::{Gpu, Op};
use crate::gpu::drawn::{Bounds, Scans};
use crate::gpu::layout::{ColorSteps, Step, View};
use crate::gpu::original::Choice;
use crate::gpu::project::count;
use crate::sh;

/// Largest binding of a plan, bytes: the limit of common drivers of discrete GPUs.
const BINDING_LIMIT: u64 = (1 << 31) - 4;

/// The plan of a fit on a discrete GPU.
#[derive(Debug)]
pub struct PlannedFit {
    gpu: Gpu,
    scene: Scene,
    tiles: u32,
    ops: Vec<Op>,
}

fn names(ops: &[Op]) -> Vec<&'static str> {
    ops.iter().map(Op::name).collect()
}

impl PlannedFit {
    /// Plans a step with one photo, without exposure and depth, with room for `pairs` pairs.
    pub fn new(
        gpu: Gpu,
        splats: usize,
        sh_degree: u32,
        (width, height): (u32, u32),
        pairs: u32,
    ) -> Result<Self> {
        let gpu = gpu.planning(BINDING_LIMIT);
        let adam = AdamBuffers::new(&gpu, count(splats)?, 3 * sh::coeffs(sh_degree) as u64)?;
        let mut frame = Frame::new(&gpu, width, height)?;
        let tiles = tile_count(width, height);
        let mut scene = Scene::new(&gpu, adam, sh_degree, tiles, pairs, 1)?;
        let (view, step) = (gpu.uniform(&View::zeroed()), gpu.uniform(&Step::zeroed()));
        let color_steps = gpu.uniform(&ColorSteps::zeroed());
        let uniforms = Uniforms { view: &view, step: &step, color_steps: &color_steps };
        frame.prepare(&gpu, uniforms, Parts { exposure: None, depth: None }, &scene)?;
        scene.prepare(&gpu, &view, &color_steps);
        Ok(Self { gpu, scene, tiles, ops: frame.ops })
    }

    /// Names of a step's commands in order: the entry points of kernels, "clear" and "copy".
    pub fn step(&self) -> Vec<&'static str> {
        names(&self.ops)
    }

    /// Names of the commands in a run of the original density control that leaves `splats` splats, and
    /// the number of bytes that the run moves between host and device.
    pub fn original(&self, run: &OriginalRun, splats: usize) -> Result<(Vec<&'static str>, u64)> {
        let (gpu, scene) = (&self.gpu, &self.scene);
        let before = gpu.host_bytes();
        let choice = Choice::new(gpu, &scene.adam, &scene.bins, run)?;
        let mut ops = choice.grow_ops(gpu);
        ops.extend(choice.list_ops(gpu, false));
        let halfway = choice.draw(gpu, count(splats)?)?;
        ops.extend(halfway.ops.iter().cloned());
        // The commands do not depend on the means.
        ops.extend(scene.arranged(gpu, &halfway.ordered(&[]), self.tiles)?.1);
        let read = Scans::TOTAL_BYTES + Bounds::BYTES;
        Ok((names(&ops), gpu.host_bytes() - before + read))
    }
}
