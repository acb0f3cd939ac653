//! What a step costs on scenes that no device at hand could hold: the commands of a fit, made and counted
//! without being run.

use bytemuck::Zeroable;

use super::frame::{Frame, Parts, Uniforms};
use super::scene::Scene;
use crate::error::Result;
use crate::fit_device::COLOR_WAIT;
use crate::gpu::adam::AdamBuffers;
use crate::gpu::device::{Gpu, Op};
use crate::gpu::layout::{ColorSteps, Step, View};
use crate::gpu::project::count;
use crate::gpu::traffic::{Counts, bytes};
use crate::sh;

/// Bytes that the device of a plan binds at once: all that a signed 32-bit number counts, as the common
/// drivers of discrete GPUs.
const BINDING_LIMIT: u64 = (1 << 31) - 4;

/// A fit on a discrete GPU of which nothing is run.
#[derive(Debug)]
pub struct PlannedFit {
    gpu: Gpu,
    scene: Scene,
    ops: Vec<Op>,
}

/// What a step is made of.
#[derive(Debug, Clone, PartialEq)]
pub struct StepWork {
    /// Kernels that are started.
    pub dispatches: usize,
    /// Bytes of buffers that are read and written, and the step's share of what brings all colours up
    /// to date every [`COLOR_WAIT`] steps.
    pub bytes: f64,
    /// The same by kernel, in the order of their first dispatches; buffers that are cleared and copied by
    /// those names.
    pub kernels: Vec<(&'static str, usize, f64)>,
}

impl StepWork {
    fn add(&mut self, name: &'static str, runs: usize, bytes: f64) {
        self.bytes += bytes;
        match self.kernels.iter_mut().find(|(known, ..)| *known == name) {
            Some((_, count, sum)) => {
                *count += runs;
                *sum += bytes;
            }
            None => self.kernels.push((name, runs, bytes)),
        }
    }
}

impl PlannedFit {
    /// The commands of a step with one photo, without exposure and depth, at room for `pairs` pairs.
    ///
    /// # Errors
    /// [`Error::Device`](crate::Error::Device) if a buffer could not be bound at once.
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
        let tiles = crate::gpu::bin::tile_count(width, height);
        let mut scene = Scene::new(&gpu, adam, sh_degree, tiles, pairs, 1)?;
        let (view, step) = (gpu.uniform(&View::zeroed()), gpu.uniform(&Step::zeroed()));
        let color_steps = gpu.uniform(&ColorSteps::zeroed());
        let uniforms = Uniforms { view: &view, step: &step, color_steps: &color_steps };
        frame.prepare(&gpu, uniforms, Parts { exposure: None, depth: None }, &scene)?;
        scene.prepare(&gpu, &view, &color_steps);
        let photo = gpu.bindable("photo", u64::from(width) * u64::from(height) * 4)?;
        let mut ops = vec![frame.copy_photo(&photo)];
        ops.append(&mut frame.ops);
        Ok(Self { gpu, scene, ops })
    }

    /// A step in which so many splats are not culled and make so many (splat, tile) pairs.
    pub fn step(&self, visible: usize, pairs: u32) -> StepWork {
        let counts = Counts {
            splats: f64::from(self.scene.len()),
            visible: visible as f64,
            pairs: f64::from(pairs),
            capacity: f64::from(self.scene.capacity),
        };
        let mut work = StepWork { dispatches: 0, bytes: 0.0, kernels: Vec::new() };
        let pair_keys = u64::from(self.scene.capacity) * 4;
        let of_step = self.ops.iter().zip(bytes(&self.gpu, &self.ops, pair_keys, &counts));
        for (op, bytes) in of_step {
            let (name, runs) = match op {
                Op::Dispatch { kernel, .. } => (kernel.entry().1, 1),
                Op::Clear(_) => ("clear", 0),
                Op::Copy(..) => ("copy", 0),
            };
            work.dispatches += runs;
            work.add(name, 1, bytes);
        }
        let now_and_then = bytes(&self.gpu, &self.scene.catch_up, pair_keys, &counts);
        work.add("catch_up_all", 0, now_and_then.iter().sum::<f64>() / COLOR_WAIT as f64);
        work
    }
}
