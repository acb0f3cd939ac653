//! Fitting on the GPU: parameters, Adam's moments, photos and all intermediate data stay in its memory; a
//! step is one submission of prepared commands.
//!
//! Buffers for (splat, tile) pairs have a capacity. A step that needs more detects it on the device and
//! leaves the state unchanged, as do the steps after it. The host reads that flag some steps late,
//! enlarges the buffers and repeats those steps, so that steps do not wait for the host.
//!
//! Colors of splats that a step does not see wait ([`crate::fit_device::COLOR_WAIT`]).
//!
//! Memory. Per splat with K SH coefficients, the parameters take P = 4 (11 + 3 K) bytes: P and two
//! moments make 3 P; statistics, the gradient of a color, 2D splats, their gradients and the depth order
//! take 144. A (splat, tile) pair takes 60 bytes, 40 of them its gradient slot; the initial capacity is 4
//! pairs per splat, later a quarter more than any step has needed. A pixel takes 84 bytes, 36 of them
//! slopes of SSIM (96 and 48 on software adapters), 16 more if exposures are fitted and 8 more if photos
//! have depths; a photo 4 per pixel, 4 more for weights and 8 more for depths. A test checks the sum per
//! splat. Density control temporarily needs a second copy of splats and moments, and 60 to 70 bytes per
//! splat for its draws.

mod frame;
mod plan;
mod scene;

use std::sync::Arc;

use super::bin::{SplatBins, pair_limit, tile_count};
use super::depth_loss::{DepthBuffers, depth_rows};
use super::device::{Gpu, Op};
use super::exposure::ExposureBuffers;
use super::layout::{
    ChunkCount, ColorSteps, DepthStep, ExposureUniform, GRADIENT, StatusHead, Step, View,
};
use super::loss::{LossBuffers, rgba};
use super::mcmc::shares;
use super::original::reset_op;
use super::project_backward::camera_sum;
use crate::error::{Error, Result};
use crate::fit_device::{
    CameraGradient, ColorStep, CommandTime, ExposureGradient, FitDevice, FitState, McmcRun,
    OriginalRun, StepInput, WaitingSteps, control_on_host, dropout_threshold, mcmc, original,
};
use crate::sh;
use crate::stages::ProjectOptions;
use crate::target::{Target, Weight};
use frame::{Frame, Parts, Uniforms};
pub use plan::PlannedFit;
use scene::{Scene, pair_buffers};

/// Steps in a batch. After each, the host asks whether all pairs fitted; it reads the answer after the next
/// batch, or at once if it also reads sums of the steps, for which there is room for one batch.
const STEPS_AHEAD: usize = 16;

/// Offset of the status's overflow, bytes.
const OVERFLOW_AT: u64 = std::mem::offset_of!(StatusHead, overflow) as u64;

/// Most bytes of a step's [`Inputs`].
const INPUT_BYTES: u64 = (size_of::<View>()
    + size_of::<Step>()
    + size_of::<[u32; 2]>()
    + size_of::<[f32; 4]>()
    + size_of::<ExposureUniform>()
    + size_of::<DepthStep>()
    + 2 * size_of::<u32>()) as u64;

/// Fits on the GPU.
#[derive(Debug)]
pub struct GpuFit {
    gpu: Arc<Gpu>,
    photos: Vec<Photo>,
    frames: Vec<Frame>,
    /// Most tiles that a photo has.
    tiles: u32,
    view: wgpu::Buffer,
    step: wgpu::Buffer,
    color_steps: wgpu::Buffer,
    exposure: wgpu::Buffer,
    depth: wgpu::Buffer,
    inputs: wgpu::Buffer,
    scene: Option<Scene>,
    /// MCMC's table of shares; None until density control runs.
    shares: Option<wgpu::Buffer>,
    /// Submitted, unconfirmed steps, each with the number of steps that colors waited for before it.
    pending: Vec<(StepInput, usize)>,
    /// The overflow flag, copied after a batch of steps.
    flag: wgpu::Buffer,
    /// The submission that copies it, until it is read; it is about the first pending steps.
    flagged: Option<wgpu::SubmissionIndex>,
    /// While pending steps are done again: the last of them that was submitted again.
    redone: Option<usize>,
    /// The steps that colors may wait for, pending ones included.
    waiting: WaitingSteps,
    camera_gradients: Vec<CameraGradient>,
    exposure_gradients: Vec<ExposureGradient>,
    /// The exposure sums of each pending step; None until a step has them.
    pending_exposures: Option<wgpu::Buffer>,
    /// The last step: its photo, SSIM weight, and whether it compared depths.
    last: Option<(usize, f32, bool)>,
    /// Times of the commands of each step, while they are measured.
    times: Option<Vec<Vec<CommandTime>>>,
}

#[derive(Debug)]
struct Photo {
    frame: usize,
    rgba: wgpu::Buffer,
    weights: Option<wgpu::Buffer>,
    weight: Weight,
    depth: Option<PhotoDepth>,
}

#[derive(Debug)]
struct PhotoDepth {
    rows: wgpu::Buffer,
    /// Weight of one depth in the loss, before the step's `depth_weight`.
    scale: f64,
}

/// Uniforms of a step and words of the status, which the host writes at once.
#[derive(Debug)]
struct Inputs<'a> {
    buffer: &'a wgpu::Buffer,
    bytes: Vec<u8>,
    copies: Vec<Op>,
}

impl Inputs<'_> {
    fn add(&mut self, to: &wgpu::Buffer, offset: u64, bytes: &[u8]) {
        let from = (self.buffer.clone(), self.bytes.len() as u64);
        let to = (to.clone(), offset);
        self.copies.push(Op::Copy { from, to, bytes: bytes.len() as u64 });
        self.bytes.extend_from_slice(bytes);
    }

    /// Writes them, and returns the commands that bring them to their places.
    fn send(self, gpu: &Gpu) -> Vec<Op> {
        gpu.write(self.buffer, 0, &self.bytes);
        self.copies
    }
}

/// Whether the host reads sums of the step.
fn has_sums(input: &StepInput) -> bool {
    input.exposure.is_some() || input.camera_gradient
}

impl GpuFit {
    /// A fitting device without photos or splats yet.
    pub fn new(gpu: Arc<Gpu>) -> Self {
        Self {
            view: gpu.uniform(&View::of_picture(1, 1, [0.0; 3])),
            step: gpu.uniform(&<Step as bytemuck::Zeroable>::zeroed()),
            color_steps: gpu.uniform(&<ColorSteps as bytemuck::Zeroable>::zeroed()),
            exposure: gpu.uniform(&<ExposureUniform as bytemuck::Zeroable>::zeroed()),
            depth: gpu.uniform(&<DepthStep as bytemuck::Zeroable>::zeroed()),
            inputs: gpu.inputs(INPUT_BYTES),
            flag: gpu.readable(size_of::<u32>() as u64),
            flagged: None,
            gpu,
            photos: Vec::new(),
            frames: Vec::new(),
            tiles: 1,
            scene: None,
            shares: None,
            pending: Vec::new(),
            redone: None,
            waiting: WaitingSteps::default(),
            camera_gradients: Vec::new(),
            exposure_gradients: Vec::new(),
            pending_exposures: None,
            last: None,
            times: None,
        }
    }

    /// Limits the steps that colors of unseen splats wait, by default to
    /// [`COLOR_WAIT`](crate::fit::COLOR_WAIT). The bits do not change.
    pub fn with_color_wait(self, steps: usize) -> Self {
        Self { waiting: WaitingSteps::at_most(steps), ..self }
    }

    fn scene(&self) -> Result<&Scene> {
        self.scene
            .as_ref()
            .ok_or_else(|| Error::argument("splats", "have not been uploaded to the device"))
    }

    /// Brings all colors up to date; all steps must be done.
    fn catch_up(&mut self) -> Result<()> {
        if self.waiting.get().is_empty() {
            return Ok(());
        }
        let scene = self
            .scene
            .as_mut()
            .ok_or_else(|| Error::argument("splats", "have not been uploaded to the device"))?;
        scene.prepare(&self.gpu, &self.view, &self.color_steps);
        let head = [self.waiting.get().len() as u32, scene.adam.moving];
        self.gpu.write(&self.color_steps, 0, bytemuck::bytes_of(&head));
        self.gpu.submit(&[&scene.catch_up])?;
        self.waiting.clear();
        Ok(())
    }

    /// Submits one step without waiting for it, as number `at` of the pending steps; colors wait for
    /// `waiting` steps before it. `again` if its pairs did not fit before.
    fn enqueue(&mut self, input: &StepInput, at: usize, waiting: usize, again: bool) -> Result<()> {
        let scene = self
            .scene
            .as_mut()
            .ok_or_else(|| Error::argument("splats", "have not been uploaded to the device"))?;
        let photo = &self.photos[input.view];
        let frame = &mut self.frames[photo.frame];
        let depth = photo.depth.as_ref().filter(|_| input.depth_weight > 0.0);
        let parts = Parts {
            exposure: input.exposure.map(|_| &self.exposure),
            depth: depth.map(|_| &self.depth),
        };
        let uniforms =
            Uniforms { view: &self.view, step: &self.step, color_steps: &self.color_steps };
        frame.prepare(&self.gpu, uniforms, parts, scene)?;
        scene.prepare(&self.gpu, &self.view, &self.color_steps);
        let view = View {
            sh_degree: input.sh_degree.min(scene.sh_degree),
            sh_stride: sh::coeffs(scene.sh_degree) as u32,
            raw: 1,
            dropout_threshold: dropout_threshold(input.dropout),
            dropout_seed: input.noise_seed,
            compensation: 1.0 / (1.0 - input.dropout),
            ..View::of_view(&input.camera, &ProjectOptions::default(), input.background)
        };
        let adam = input.adam();
        let step = Step::of_adam(&adam, scene.adam.moving).with_loss(
            input.ssim_weight,
            photo.weight,
            photo.weights.is_some(),
        );
        let mut inputs = Inputs { buffer: &self.inputs, bytes: Vec::new(), copies: Vec::new() };
        inputs.add(&self.view, 0, bytemuck::bytes_of(&view));
        inputs.add(&self.step, 0, bytemuck::bytes_of(&step));
        let head = [waiting as u32, scene.adam.moving];
        inputs.add(&self.color_steps, 0, bytemuck::bytes_of(&head));
        if !adam.is_frozen() {
            let (offset, entry) = ColorSteps::entry(waiting, &ColorStep::new(&adam));
            inputs.add(&self.color_steps, offset, bytemuck::bytes_of(&entry));
        }
        if let Some(exposure) = &input.exposure {
            let uniform = ExposureUniform::from(exposure);
            inputs.add(&self.exposure, 0, bytemuck::bytes_of(&uniform));
        }
        if again {
            inputs.add(&scene.bins.status, OVERFLOW_AT, bytemuck::bytes_of(&0u32));
        }
        let step_at = std::mem::offset_of!(StatusHead, step) as u64;
        inputs.add(&scene.bins.status, step_at, bytemuck::bytes_of(&input.step));
        if let Some(depth) = depth {
            let scale = (f64::from(input.depth_weight) * depth.scale) as f32;
            inputs.add(&self.depth, 0, bytemuck::bytes_of(&DepthStep { scale }));
        }
        let mut copies = inputs.send(&self.gpu);
        let bytes = u64::from(frame.width) * u64::from(frame.height) * 4;
        copies.push(frame.copy_photo(&photo.rgba));
        if let Some(weights) = &photo.weights {
            copies.push(Op::copy(weights, &frame.loss.weights, 0, bytes));
        }
        if let (Some(depth), Some(buffers)) = (depth, &frame.depth) {
            copies.push(Op::copy(&depth.rows, &buffers.photo, 0, 2 * bytes));
        }
        let mut sums = Vec::new();
        if let (Some(_), Some(buffers)) = (input.exposure, &frame.exposure) {
            let bytes = ExposureBuffers::SUM_BYTES;
            let log = match &self.pending_exposures {
                Some(log) => log,
                None => {
                    let log = self.gpu.readable(STEPS_AHEAD as u64 * bytes);
                    self.pending_exposures.insert(log)
                }
            };
            sums.push(Op::copy(&buffers.sums, log, at as u64 * bytes, bytes));
        }
        if input.camera_gradient {
            let bytes = scene.camera_bytes();
            let log = match &scene.pending_cameras {
                Some(log) => log,
                None => {
                    let log = self.gpu.readable(STEPS_AHEAD as u64 * bytes);
                    scene.pending_cameras.insert(log)
                }
            };
            sums.push(Op::copy(&scene.v_camera, log, at as u64 * bytes, bytes));
        }
        self.last = Some((input.view, input.ssim_weight, depth.is_some()));
        let frame = &self.frames[self.photos[input.view].frame];
        let lists: [&[Op]; 3] = [&copies, &frame.ops, &sums];
        match &mut self.times {
            Some(times) => times.push(self.gpu.submit_timed(&lists)?),
            None => {
                self.gpu.submit(&lists)?;
            }
        }
        Ok(())
    }

    /// Takes in the sums of these steps, which have been done, for cameras and exposures.
    fn read_sums(&mut self, steps: &[(StepInput, usize)]) -> Result<()> {
        let steps: Vec<StepInput> = steps.iter().map(|(input, _)| *input).collect();
        self.read_exposures(&steps)?;
        self.read_cameras(&steps)
    }

    fn read_exposures(&mut self, steps: &[StepInput]) -> Result<()> {
        let Some(log) = &self.pending_exposures else { return Ok(()) };
        if steps.iter().all(|input| input.exposure.is_none()) {
            return Ok(());
        }
        let bytes = ExposureBuffers::SUM_BYTES;
        let data = self.gpu.read(&[(log, steps.len() as u64 * bytes)])?;
        for (input, sums) in steps.iter().zip(data[0].chunks_exact(bytes as usize)) {
            if input.exposure.is_some() {
                let [v_gain, v_offset] = ExposureBuffers::gradients(sums);
                let gradient = ExposureGradient { view: input.view, v_gain, v_offset };
                self.exposure_gradients.push(gradient);
            }
        }
        Ok(())
    }

    fn read_cameras(&mut self, steps: &[StepInput]) -> Result<()> {
        if !steps.iter().any(|input| input.camera_gradient) {
            return Ok(());
        }
        let scene = self.scene()?;
        let Some(log) = &scene.pending_cameras else { return Ok(()) };
        let bytes = scene.camera_bytes();
        let data = self.gpu.read(&[(log, steps.len() as u64 * bytes)])?;
        for (input, sums) in steps.iter().zip(data[0].chunks_exact(bytes as usize)) {
            if input.camera_gradient {
                let (v_viewmat, v_intrinsics) = camera_sum(sums);
                self.camera_gradients.push(CameraGradient {
                    view: input.view,
                    v_viewmat,
                    v_intrinsics,
                });
            }
        }
        Ok(())
    }

    /// Reads the flag and the counts of the last step.
    fn status(&self) -> Result<(StatusHead, Vec<ChunkCount>)> {
        let scene = self.scene()?;
        let bytes = SplatBins::status_bytes(scene.chunks);
        let copy = Op::copy(&scene.bins.status, &scene.status_copy, 0, bytes);
        self.gpu.submit(&[&[copy]])?;
        let data = self.gpu.read(&[(&scene.status_copy, bytes)])?;
        let (head, counts) = data[0].split_at(size_of::<StatusHead>());
        Ok((bytemuck::pod_read_unaligned(head), bytemuck::pod_collect_to_vec(counts)))
    }

    /// Makes sure that all steps so far have been done.
    fn settle(&mut self) -> Result<()> {
        if self.pending.is_empty() {
            return Ok(());
        }
        self.read_flag()?;
        let (head, _) = self.status()?;
        let pending = std::mem::take(&mut self.pending);
        let first = match (head.overflow, self.redone) {
            (0, None) => pending.len(),
            // The steps behind the last one that was done again still wait for that.
            (0, Some(at)) => at + 1,
            (overflow, _) => pending.iter().position(|(p, _)| p.step == overflow).unwrap_or(0),
        };
        let settled = self.redo(&pending, first);
        if let Err(error) = settled.and_then(|()| self.read_sums(&pending)) {
            // The next read of the state reports this error again.
            self.pending = pending;
            return Err(error);
        }
        Ok(())
    }

    /// The overflow flag after the first pending steps, if it is on its way.
    fn read_flag(&mut self) -> Result<Option<u32>> {
        let Some(submission) = self.flagged.take() else { return Ok(None) };
        let flag = self.gpu.finish_read(submission, &self.flag, size_of::<u32>() as u64)?;
        Ok(Some(bytemuck::pod_read_unaligned(&flag)))
    }

    /// Before the next step: after every batch, makes sure that the batch before has been done, while this
    /// one is under way.
    fn confirm(&mut self, next: &StepInput) -> Result<()> {
        let steps = self.pending.len();
        let sums = has_sums(next) || self.pending.iter().any(|(input, _)| has_sums(input));
        let most = if sums { STEPS_AHEAD - 1 } else { 2 * STEPS_AHEAD };
        if self.redone.is_some() || steps > most {
            // Steps that are to be done again come first.
            return self.settle();
        }
        if steps == 0 || !steps.is_multiple_of(STEPS_AHEAD) {
            return Ok(());
        }
        match self.read_flag()? {
            None => {}
            Some(0) => drop(self.pending.drain(..STEPS_AHEAD)),
            Some(_) => return self.settle(),
        }
        let flag = (self.scene()?.bins.status.clone(), OVERFLOW_AT);
        let copy = Op::Copy { from: flag, to: (self.flag.clone(), 0), bytes: 4 };
        self.flagged = Some(self.gpu.submit_read(&[copy], &self.flag)?);
        Ok(())
    }

    /// Does the pending steps again from `first` on, whose pairs did not fit, with room for them.
    fn redo(&mut self, pending: &[(StepInput, usize)], first: usize) -> Result<()> {
        // One at a time, so that the counts read belong to the step that needs the room.
        for (at, (input, waiting)) in pending.iter().enumerate().skip(first) {
            loop {
                if let Err(error) = self.enqueue(input, at, *waiting, true) {
                    // It may have cleared the flag, and the step was not done.
                    self.set_overflow(input.step)?;
                    return Err(error);
                }
                self.redone = Some(at);
                let (head, counts) = self.status()?;
                if head.overflow == 0 {
                    break;
                }
                self.grow(self.photos[input.view].frame, &counts)?;
            }
        }
        self.redone = None;
        Ok(())
    }

    /// Sets the first step whose pairs did not fit, from the next submission on.
    fn set_overflow(&self, step: u32) -> Result<()> {
        self.gpu.write(&self.scene()?.bins.status, OVERFLOW_AT, bytemuck::bytes_of(&step));
        Ok(())
    }

    /// Goes on with these splats, and returns their number.
    fn replace(&mut self, scene: Scene) -> usize {
        for frame in &mut self.frames {
            frame.ops.clear();
        }
        let splats = scene.len() as usize;
        self.scene = Some(scene);
        splats
    }

    /// Makes room for the pairs that a step needs.
    fn grow(&mut self, frame: usize, counts: &[ChunkCount]) -> Result<()> {
        let gpu = Arc::clone(&self.gpu);
        let limit = pair_limit(&gpu, GRADIENT);
        let mut chunks = Vec::new();
        let mut need = 0;
        for (range, count) in self.frames[frame].chunks.iter().zip(counts) {
            if count.total <= limit {
                need = need.max(count.total);
                chunks.push(range.clone());
            } else if range.len() > 1 {
                let middle = range.start + range.len() as u32 / 2;
                chunks.extend([range.start..middle, middle..range.end]);
            } else {
                return Err(Error::argument(
                    "splats",
                    format!(
                        "{} are in one 16x16 tile, but the device takes {limit}; lower max_splats or \
                         use backend cpu",
                        count.total
                    ),
                ));
            }
        }
        let tiles = self.tiles;
        let scene = self
            .scene
            .as_mut()
            .ok_or_else(|| Error::argument("splats", "have not been uploaded to the device"))?;
        if need > scene.capacity {
            // If allocation fails, the old buffers and their capacity stay.
            let capacity = need.saturating_add(need / 4).min(limit);
            (scene.pairs, scene.slots) = pair_buffers(&gpu, capacity, tiles)?;
            scene.capacity = capacity;
        }
        if chunks.len() as u32 > scene.chunks {
            let count = chunks.len() as u32;
            scene.bins = SplatBins::new(&gpu, scene.len(), count)?;
            scene.chunks = count;
            scene.status_copy = gpu.readable(SplatBins::status_bytes(scene.chunks));
        }
        self.frames[frame].chunks = chunks;
        scene.catch_up.clear();
        for frame in &mut self.frames {
            frame.ops.clear();
        }
        Ok(())
    }
}

impl FitDevice for GpuFit {
    fn set_targets(&mut self, targets: Vec<Target>) -> Result<()> {
        self.settle()?;
        for (k, target) in targets.iter().enumerate() {
            target.validate(k)?;
        }
        self.photos.clear();
        self.frames.clear();
        self.last = None;
        self.tiles = 1;
        for target in targets {
            let (width, height) = (target.width, target.height);
            let known = self.frames.iter().position(|f| (f.width, f.height) == (width, height));
            let frame = match known {
                Some(frame) => frame,
                None => {
                    self.frames.push(Frame::new(&self.gpu, width, height)?);
                    self.frames.len() - 1
                }
            };
            let weight = target.weight();
            let weights =
                target.weights.as_ref().map(|w| self.gpu.upload("weights", w)).transpose()?;
            self.tiles = self.tiles.max(tile_count(width, height));
            let rgba = self.gpu.upload("photo", &rgba(&target))?;
            let depth = match &target.depth {
                None => None,
                Some(depth) => Some(PhotoDepth {
                    rows: self.gpu.upload("depths of a photo", &depth_rows(depth))?,
                    scale: depth.scale(),
                }),
            };
            self.photos.push(Photo { frame, rgba, weights, weight, depth });
        }
        // Pair buffers are laid out for the largest photo.
        if self.scene.is_some() {
            let state = self.download()?;
            self.upload(state)?;
        }
        Ok(())
    }

    fn upload(&mut self, state: FitState) -> Result<()> {
        state.validate()?;
        self.read_flag()?;
        self.pending.clear();
        self.redone = None;
        self.waiting.clear();
        // Keep the capacity of the last scene, which is likely to be needed again.
        let capacity = self.scene.take().map_or(0, |scene| scene.capacity);
        let chunks = self.frames.iter().map(|frame| frame.chunks.len() as u32).max().unwrap_or(1);
        for frame in &mut self.frames {
            frame.ops.clear();
        }
        self.scene = Some(Scene::upload(&self.gpu, &state, self.tiles, capacity, chunks)?);
        Ok(())
    }

    fn download(&mut self) -> Result<FitState> {
        self.settle()?;
        self.catch_up()?;
        self.scene()?.download(&self.gpu)
    }

    fn mcmc(&mut self, run: &McmcRun) -> Result<usize> {
        self.settle()?;
        self.catch_up()?;
        let gpu = Arc::clone(&self.gpu);
        let shares = match &self.shares {
            Some(shares) => shares.clone(),
            None => self.shares.insert(shares(&gpu)?).clone(),
        };
        let Some(next) = self.scene()?.after_mcmc(&gpu, run, self.tiles, &shares)? else {
            return control_on_host(self, &|state| mcmc(state, run));
        };
        Ok(self.replace(next))
    }

    fn original(&mut self, run: &OriginalRun) -> Result<usize> {
        self.settle()?;
        self.catch_up()?;
        let gpu = Arc::clone(&self.gpu);
        let Some(next) = self.scene()?.after_original(&gpu, run, self.tiles)? else {
            return control_on_host(self, &|state| original(state, run));
        };
        Ok(self.replace(next))
    }

    fn reset_opacities(&mut self) -> Result<()> {
        self.settle()?;
        let op = reset_op(&self.gpu, &self.scene()?.adam);
        self.gpu.submit(&[&[op]])?;
        Ok(())
    }

    fn step(&mut self, input: &StepInput) -> Result<()> {
        input.validate(self.photos.iter().map(|photo| {
            let frame = &self.frames[photo.frame];
            (frame.width, frame.height)
        }))?;
        self.confirm(input)?;
        let adam = input.adam();
        if self.waiting.must_end_before(&adam) {
            self.settle()?;
            self.catch_up()?;
        }
        let waiting = self.waiting.get().len();
        self.enqueue(input, self.pending.len(), waiting, false)?;
        self.pending.push((*input, waiting));
        self.waiting.add(&adam);
        Ok(())
    }

    fn camera_gradients(&mut self) -> Result<Vec<CameraGradient>> {
        self.settle()?;
        Ok(std::mem::take(&mut self.camera_gradients))
    }

    fn exposure_gradients(&mut self) -> Result<Vec<ExposureGradient>> {
        self.settle()?;
        Ok(std::mem::take(&mut self.exposure_gradients))
    }

    fn loss(&mut self) -> Result<f32> {
        self.settle()?;
        let Some((view, ssim_weight, has_depth)) = self.last else { return Ok(0.0) };
        let photo = &self.photos[view];
        let frame = &self.frames[photo.frame];
        let mut wanted = vec![(&frame.loss.sums, frame.loss.sum_bytes())];
        let depth = frame.depth.as_ref().filter(|_| has_depth);
        wanted.extend(depth.map(|buffers| (&buffers.sums, DepthBuffers::SUM_BYTES)));
        let data = self.gpu.download(&[], &wanted)?;
        let [ssim, l1] = LossBuffers::total(&data[0]);
        let depth = data.get(1).map_or(0.0, |bytes| DepthBuffers::total(bytes));
        Ok((photo.weight.loss(f64::from(ssim_weight), l1, ssim) + depth) as f32)
    }

    fn measure_commands(&mut self, on: bool) -> Result<()> {
        self.settle()?;
        self.times = on.then(Vec::new);
        Ok(())
    }

    fn command_times(&mut self) -> Vec<Vec<CommandTime>> {
        self.times.as_mut().map(std::mem::take).unwrap_or_default()
    }
}
