//! What a step costs on scenes that no device at hand could hold: the commands of a fit, made and counted
//! without being run.

use bytemuck::Zeroable;

use super::frame::{Frame, Parts, Uniforms};
use super::scene::Scene;
use crate::error::Result;
use crate::fit_device::{COLOR_WAIT, OriginalRun};
use crate::gpu::adam::AdamBuffers;
use crate::gpu::device::{Gpu, Op};
use crate::gpu::drawn::{Bounds, Scans};
use crate::gpu::layout::{ColorSteps, Step, View};
use crate::gpu::original::Choice;
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
    tiles: u32,
    ops: Vec<Op>,
}

/// What a step, or a run of density control, is made of.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct StepWork {
    /// Kernels that are started.
    pub dispatches: usize,
    /// Bytes of buffers that are read and written, and a step's share of what brings all colours up
    /// to date every [`COLOR_WAIT`] steps.
    pub bytes: f64,
    /// The same by kernel, in the order of their first dispatches; buffers that are cleared and copied by
    /// those names.
    pub kernels: Vec<(&'static str, usize, f64)>,
}

impl StepWork {
    /// Adds commands and the bytes of each.
    fn add_all(&mut self, ops: &[Op], bytes: &[f64]) {
        for (op, &bytes) in ops.iter().zip(bytes) {
            let (name, runs) = match op {
                Op::Dispatch { kernel, .. } => (kernel.entry(), 1),
                Op::Clear(_) => ("clear", 0),
                Op::Copy(..) => ("copy", 0),
            };
            self.dispatches += runs;
            self.add(name, 1, bytes);
        }
    }

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
        Ok(Self { gpu, scene, tiles, ops })
    }

    /// A step in which so many splats are not culled and make so many (splat, tile) pairs.
    pub fn step(&self, visible: usize, pairs: u32) -> StepWork {
        let counts = Counts {
            splats: f64::from(self.scene.len()),
            visible: visible as f64,
            pairs: f64::from(pairs),
            capacity: f64::from(self.scene.capacity),
        };
        let mut work = StepWork::default();
        let pair_keys = u64::from(self.scene.capacity) * 4;
        work.add_all(&self.ops, &bytes(&self.gpu, &self.ops, pair_keys, &counts));
        let now_and_then = bytes(&self.gpu, &self.scene.catch_up, pair_keys, &counts);
        work.add("catch_up_all", 0, now_and_then.iter().sum::<f64>() / COLOR_WAIT as f64);
        work
    }

    /// A run of the original density control by which `wanting` splats want to grow and `splats` are there
    /// in the end, and the bytes that go between host and device for it.
    ///
    /// # Errors
    /// [`Error::Device`](crate::Error::Device) if a buffer could not be bound at once.
    pub fn original(
        &self,
        run: &OriginalRun,
        wanting: usize,
        splats: usize,
    ) -> Result<(StepWork, u64)> {
        let (gpu, scene) = (&self.gpu, &self.scene);
        let before = gpu.host_bytes();
        let counts = |all: f64, visible: f64| {
            // Of no dispatch here.
            let (pairs, capacity) = (0.0, 1.0);
            Counts { splats: all, visible, pairs, capacity }
        };
        let mut work = StepWork::default();
        let choice = Choice::new(gpu, &scene.adam, &scene.bins, run)?;
        let grow = choice.grow_ops(gpu);
        let of_growth = counts(f64::from(scene.len()), wanting as f64);
        work.add_all(&grow, &bytes(gpu, &grow, 0, &of_growth));
        let mut rest = choice.list_ops(gpu, false);
        let halfway = choice.draw(gpu, count(splats)?)?;
        rest.extend(halfway.ops.iter().cloned());
        // Where the centres lie changes no count.
        let (_, order) = scene.arranged(gpu, &halfway.ordered(&[]), self.tiles)?;
        rest.extend(order);
        work.add_all(&rest, &bytes(gpu, &rest, 0, &counts(1.0, 1.0)));
        let read = Scans::TOTAL_BYTES + Bounds::BYTES;
        Ok((work, gpu.host_bytes() - before + read))
    }
}
