//! The GPU as a fitting device: parameters, Adam's moments, photos and everything between stay in
//! its memory; a step is one submission of prepared commands.
//!
//! Buffers for (splat, tile) pairs have a capacity. A step that needs more finds out on the device
//! and leaves the state as it was, as do the steps after it; the host looks at that flag now and
//! then, makes room and repeats those steps, so that no step waits for a read-back.
//!
//! Memory. Per splat with K SH coefficients, the parameters are P = 4 (11 + 3 K) bytes: P, their
//! gradient and two moments make 4 P, statistics, 2D splats, their gradients and the depth order 120
//! bytes. A (splat, tile) pair has 60 bytes, 40 of them its gradient slot; there is room for 4 per
//! splat at first, later for a quarter more than any step has needed. A pixel has 84 bytes, 36 of them
//! slopes of SSIM; a photo 4 per pixel, and 4 more for weights. A test holds the sum per splat.

use std::ops::Range;
use std::sync::Arc;

use super::bin::{PairBins, SplatBins, TileChunk, pair_limit, tile_count};
use super::device::{Gpu, Op};
use super::layout::{
    CAMERA, Chunk, ChunkCount, GEOMETRY, GRADIENT, SPLATS_PER_GROUP, STATS, Splat2d, StatusHead,
    Step, View, Window,
};
use super::loss::LossBuffers;
use super::project::{SplatBuffers, project_ops, rows};
use super::project_backward::{GradientBuffers, camera_sum, camera_sums, project_backward_ops};
use super::rasterize::rasterize_ops;
use super::rasterize_backward::{BackwardBuffers, rasterize_backward_ops};
use super::shaders::Kernel;
use crate::error::{Error, Result};
use crate::fit::{
    ADAM, CameraGradient, DensityStats, FitDevice, FitState, SplatArrays, StepInput, Target,
    Weight, dropout_threshold,
};
use crate::sh;
use crate::stages::ProjectOptions;

/// Steps that may be under way before the host looks whether all pairs fitted.
const STEPS_AHEAD: usize = 16;

/// Pairs per splat that buffers have room for at first; they grow by what a step needs.
const PAIRS_PER_SPLAT: u32 = 4;

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
    scene: Option<Scene>,
    /// Steps not known to have been done.
    pending: Vec<StepInput>,
    camera_gradients: Vec<CameraGradient>,
    /// The last step: its photo and SSIM weight.
    last: Option<(usize, f32)>,
}

/// A photo on the device.
#[derive(Debug)]
struct Photo {
    frame: usize,
    rgba: wgpu::Buffer,
    weights: Option<wgpu::Buffer>,
    weight: Weight,
}

/// Buffers for pictures of one size, and the commands of a step with them.
#[derive(Debug)]
struct Frame {
    width: u32,
    height: u32,
    picture: wgpu::Buffer,
    depths: wgpu::Buffer,
    v_picture: wgpu::Buffer,
    totals: wgpu::Buffer,
    transmittances: wgpu::Buffer,
    loss: LossBuffers,
    /// Tiles of each chunk; more than one only where the pairs of all do not fit one binding.
    chunks: Vec<Range<u32>>,
    /// Empty until needed, and again whenever a buffer was replaced.
    ops: Vec<Op>,
}

/// Buffers that depend on the number of splats or pairs.
#[derive(Debug)]
struct Scene {
    splats: SplatBuffers,
    first: SplatBuffers,
    second: SplatBuffers,
    stats: wgpu::Buffer,
    sh_degree: u32,
    splats2d: wgpu::Buffer,
    v_splats2d: wgpu::Buffer,
    gradients: GradientBuffers,
    /// The camera sums of each pending step; None until a step is to have them.
    pending_cameras: Option<wgpu::Buffer>,
    bins: SplatBins,
    /// What the host reads of `bins.status`.
    status_copy: wgpu::Buffer,
    /// Chunks that `bins` has counts for.
    chunks: u32,
    pairs: PairBins,
    slots: wgpu::Buffer,
    capacity: u32,
}

fn upload_arrays(gpu: &Gpu, arrays: &SplatArrays) -> Result<SplatBuffers> {
    SplatBuffers::upload(gpu, &arrays.params(arrays.sh_degree))
}

fn arrays_from_bytes(geometry: &[u8], colors: &[u8], sh_degree: u32) -> SplatArrays {
    let mut out = SplatArrays {
        sh: bytemuck::pod_collect_to_vec(colors),
        sh_degree,
        ..SplatArrays::default()
    };
    for bytes in geometry.chunks_exact(GEOMETRY * 4) {
        let row: [f32; GEOMETRY] = bytemuck::pod_read_unaligned(bytes);
        out.means.push([row[0], row[1], row[2]]);
        out.scales.push([row[3], row[4], row[5]]);
        out.quats.push([row[6], row[7], row[8], row[9]]);
        out.opacities.push(row[10]);
    }
    out
}

/// The pair buffers and their gradient slots.
fn pair_buffers(gpu: &Gpu, capacity: u32, tiles: u32) -> Result<(PairBins, wgpu::Buffer)> {
    let bytes = u64::from(capacity) * GRADIENT as u64 * 4;
    Ok((PairBins::new(gpu, capacity, tiles)?, gpu.bindable("gradient slots", bytes)?))
}

impl Scene {
    fn new(gpu: &Gpu, state: &FitState, tiles: u32, capacity: u32, chunks: u32) -> Result<Self> {
        let splats = upload_arrays(gpu, &state.splats)?;
        let n = splats.splats;
        let stats: Vec<[f32; STATS]> =
            (0..n as usize).map(|i| [state.stats.grad_sum[i], state.stats.seen[i]]).collect();
        let first_guess = n.saturating_mul(PAIRS_PER_SPLAT).max(4096);
        let capacity = capacity.max(first_guess).min(pair_limit(gpu, GRADIENT));
        let (pairs, slots) = pair_buffers(gpu, capacity, tiles)?;
        let row = |floats: usize| u64::from(n) * floats as u64 * 4;
        Ok(Self {
            first: upload_arrays(gpu, &state.first)?,
            second: upload_arrays(gpu, &state.second)?,
            stats: gpu.upload("stats", &stats)?,
            sh_degree: state.splats.sh_degree,
            splats2d: gpu.bindable("splats2d", row(size_of::<Splat2d>() / 4))?,
            v_splats2d: gpu.bindable("v_splats2d", row(GRADIENT))?,
            gradients: GradientBuffers::new(gpu, &splats)?,
            pending_cameras: None,
            bins: SplatBins::new(gpu, n, chunks)?,
            status_copy: gpu.readable(SplatBins::status_bytes(chunks)),
            chunks,
            pairs,
            slots,
            capacity,
            splats,
        })
    }

    /// Size of one step's camera sums.
    fn camera_bytes(&self) -> u64 {
        u64::from(camera_sums(self.splats.splats)) * CAMERA as u64 * 4
    }

    fn adam_ops(&self, gpu: &Gpu, view: &wgpu::Buffer, step: &wgpu::Buffer) -> Vec<Op> {
        let mut ops = Vec::new();
        let geometry = GEOMETRY as u64;
        let colors = self.splats.color_floats;
        for window in self.splats.windows(gpu) {
            let count = window.len() as u32;
            let uniform = gpu.uniform(&Window { first: window.start, count });
            let kinds = [
                (
                    Kernel::AdamGeometry,
                    geometry,
                    [
                        &self.splats.geometry,
                        &self.gradients.geometry,
                        &self.first.geometry,
                        &self.second.geometry,
                    ],
                    gpu.groups(count, SPLATS_PER_GROUP),
                ),
                (
                    Kernel::AdamColors,
                    colors,
                    [
                        &self.splats.colors,
                        &self.gradients.colors,
                        &self.first.colors,
                        &self.second.colors,
                    ],
                    gpu.groups(count * colors as u32, 256),
                ),
            ];
            for (kernel, floats, [values, gradient, first, second], groups) in kinds {
                ops.push(gpu.op(
                    kernel,
                    &[
                        view.into(),
                        step.into(),
                        (&uniform).into(),
                        (&self.bins.status).into(),
                        rows(values, &window, floats),
                        rows(gradient, &window, floats),
                        rows(first, &window, floats),
                        rows(second, &window, floats),
                        rows(&self.splats2d, &window, (size_of::<Splat2d>() / 4) as u64),
                        rows(&self.v_splats2d, &window, GRADIENT as u64),
                        rows(&self.stats, &window, STATS as u64),
                    ],
                    groups,
                ));
            }
        }
        ops
    }
}

impl Frame {
    fn new(gpu: &Gpu, width: u32, height: u32) -> Result<Self> {
        let pixels = u64::from(width) * u64::from(height);
        Ok(Self {
            width,
            height,
            picture: gpu.bindable("picture", 16 * pixels)?,
            depths: gpu.bindable("depths", 4 * pixels)?,
            v_picture: gpu.bindable("v_picture", 16 * pixels)?,
            totals: gpu.bindable("totals", 4 * pixels)?,
            transmittances: gpu.transmittances(pixels)?,
            loss: LossBuffers::new(gpu, width, height)?,
            chunks: std::iter::once(0..tile_count(width, height)).collect(),
            ops: Vec::new(),
        })
    }

    /// The commands of a whole step.
    fn step_ops(
        &self,
        gpu: &Gpu,
        view: &wgpu::Buffer,
        step: &wgpu::Buffer,
        scene: &Scene,
    ) -> Vec<Op> {
        let last = self.chunks.len() - 1;
        let chunks: Vec<TileChunk> = self
            .chunks
            .iter()
            .enumerate()
            .map(|(i, tiles)| {
                let chunk = Chunk {
                    tile_begin: tiles.start,
                    tile_end: tiles.end,
                    capacity: scene.capacity,
                    splats: scene.splats.splats,
                    index: i as u32,
                    is_first: u32::from(i == 0),
                    is_last: u32::from(i == last),
                    list_begin: 0,
                    list_end: u32::MAX,
                };
                TileChunk::new(gpu, chunk)
            })
            .collect();
        let (bins, pairs, splats2d) = (&scene.bins, &scene.pairs, &scene.splats2d);
        let bin = |ops: &mut Vec<Op>, chunk: &TileChunk| {
            ops.extend(bins.count_ops(gpu, view, chunk, splats2d));
            ops.extend(bins.pair_ops(gpu, view, chunk, splats2d, pairs));
        };
        let backward = BackwardBuffers {
            v_picture: self.v_picture.clone(),
            totals: self.totals.clone(),
            transmittances: self.transmittances.clone(),
            slots: scene.slots.clone(),
            v_splats2d: scene.v_splats2d.clone(),
        };
        let mut ops = project_ops(gpu, view, &scene.splats, splats2d);
        ops.extend(bins.depth_ops(gpu, view, &chunks[0], splats2d));
        for chunk in &chunks {
            bin(&mut ops, chunk);
            ops.extend(rasterize_ops(
                gpu,
                view,
                chunk,
                splats2d,
                pairs,
                &self.picture,
                &self.depths,
            ));
        }
        ops.extend(self.loss.ops(gpu, view, step, &self.picture, &self.v_picture, &self.totals));
        for chunk in &chunks {
            // Chunks share the pair buffers, so that the lists of all but one are gone by now.
            if chunks.len() > 1 {
                bin(&mut ops, chunk);
            }
            ops.extend(rasterize_backward_ops(
                gpu, view, chunk, splats2d, bins, pairs, &backward, false,
            ));
        }
        ops.extend(project_backward_ops(
            gpu,
            view,
            &scene.splats,
            splats2d,
            &scene.v_splats2d,
            &scene.gradients,
        ));
        ops.extend(scene.adam_ops(gpu, view, step));
        ops
    }
}

impl GpuFit {
    /// A fitting device without photos or splats yet.
    pub fn new(gpu: Arc<Gpu>) -> Self {
        Self {
            view: gpu.uniform(&View::of_picture(1, 1, [0.0; 3])),
            step: gpu.uniform(&<Step as bytemuck::Zeroable>::zeroed()),
            gpu,
            photos: Vec::new(),
            frames: Vec::new(),
            tiles: 1,
            scene: None,
            pending: Vec::new(),
            camera_gradients: Vec::new(),
            last: None,
        }
    }

    fn scene(&self) -> Result<&Scene> {
        self.scene
            .as_ref()
            .ok_or_else(|| Error::argument("splats", "have not been uploaded to the device"))
    }

    /// Submits one step without waiting for it, as number `at` of those pending.
    fn enqueue(&mut self, input: &StepInput, at: usize) -> Result<()> {
        let scene = self
            .scene
            .as_mut()
            .ok_or_else(|| Error::argument("splats", "have not been uploaded to the device"))?;
        let photo = self.photos.get(input.view).ok_or_else(|| {
            Error::argument("view", format!("{} is not one of the photos", input.view))
        })?;
        let frame = &mut self.frames[photo.frame];
        if (input.camera.width, input.camera.height) != (frame.width, frame.height) {
            return Err(Error::argument("camera", "does not have its photo's size"));
        }
        if frame.ops.is_empty() {
            frame.ops = frame.step_ops(&self.gpu, &self.view, &self.step, scene);
        }
        let n = f64::from(scene.splats.splats.max(1));
        let bias = |beta: f32| 1.0 - f64::from(beta).powi(input.step.min(i32::MAX as u32) as i32);
        let count = photo.weight.count;
        let scale = if count > 0.0 { 1.0 / (3.0 * count) } else { 0.0 };
        let ssim = f64::from(input.ssim_weight);
        let view = View {
            sh_degree: input.sh_degree.min(scene.sh_degree),
            sh_stride: sh::coeffs(scene.sh_degree) as u32,
            raw: 1,
            dropout_threshold: dropout_threshold(input.dropout),
            dropout_seed: input.noise_seed,
            compensation: 1.0 / (1.0 - input.dropout),
            ..View::of_view(&input.camera, &ProjectOptions::default(), input.background)
        };
        let step = Step {
            means: input.rates.means,
            quats: input.rates.quats,
            scales: input.rates.scales,
            opacities: input.rates.opacities,
            sh0: input.rates.sh0,
            sh_rest: input.rates.sh_rest,
            bias_first: (1.0 / bias(ADAM.0)) as f32,
            bias_second: (1.0 / bias(ADAM.1)) as f32,
            opacity_pull: (f64::from(input.opacity_regularizer) / n) as f32,
            scale_pull: (f64::from(input.scale_regularizer) / (3.0 * n)) as f32,
            noise: input.noise,
            noise_seed: input.noise_seed,
            l1: ((1.0 - ssim) * scale) as f32,
            ssim: (ssim * scale) as f32,
            has_weights: u32::from(photo.weights.is_some()),
        };
        let queue = &self.gpu.queue;
        queue.write_buffer(&self.view, 0, bytemuck::bytes_of(&view));
        queue.write_buffer(&self.step, 0, bytemuck::bytes_of(&step));
        let step_at = std::mem::offset_of!(StatusHead, step) as u64;
        queue.write_buffer(&scene.bins.status, step_at, bytemuck::bytes_of(&input.step));
        let bytes = u64::from(frame.width) * u64::from(frame.height) * 4;
        let mut copies = vec![Op::Copy(photo.rgba.clone(), frame.loss.photo.clone(), 0, bytes)];
        if let Some(weights) = &photo.weights {
            copies.push(Op::Copy(weights.clone(), frame.loss.weights.clone(), 0, bytes));
        }
        let mut cameras = Vec::new();
        if input.camera_gradient {
            let bytes = scene.camera_bytes();
            let log = match &scene.pending_cameras {
                Some(log) => log,
                None => {
                    let log = self.gpu.readable(STEPS_AHEAD as u64 * bytes);
                    scene.pending_cameras.insert(log)
                }
            };
            let (from, to) = (scene.gradients.camera.clone(), log.clone());
            cameras.push(Op::Copy(from, to, at as u64 * bytes, bytes));
        }
        self.last = Some((input.view, input.ssim_weight));
        self.gpu.submit(&[&copies, &frame.ops, &cameras])
    }

    /// Takes in the camera sums of these steps, which have been done.
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
        let copy = Op::Copy(scene.bins.status.clone(), scene.status_copy.clone(), 0, bytes);
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
        let (head, _) = self.status()?;
        let pending = std::mem::take(&mut self.pending);
        if head.overflow == 0 {
            return self.read_cameras(&pending);
        }
        let first = pending.iter().position(|p| p.step == head.overflow).unwrap_or(0);
        // One at a time, so that the counts read are those of the step that needs the room.
        for (at, input) in pending.iter().enumerate().skip(first) {
            loop {
                let clear = std::mem::offset_of!(StatusHead, overflow) as u64;
                let status = &self.scene()?.bins.status;
                self.gpu.queue.write_buffer(status, clear, bytemuck::bytes_of(&0u32));
                self.enqueue(input, at)?;
                let (head, counts) = self.status()?;
                if head.overflow == 0 {
                    break;
                }
                self.grow(self.photos[input.view].frame, &counts)?;
            }
        }
        self.read_cameras(&pending)
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
                        "{} lie in one 16x16 tile, the device takes {limit}; lower max_splats or \
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
            scene.capacity = need.saturating_add(need / 4).min(limit);
            (scene.pairs, scene.slots) = pair_buffers(&gpu, scene.capacity, tiles)?;
        }
        if chunks.len() as u32 > scene.chunks {
            scene.chunks = chunks.len() as u32;
            scene.bins = SplatBins::new(&gpu, scene.splats.splats, scene.chunks)?;
            scene.status_copy = gpu.readable(SplatBins::status_bytes(scene.chunks));
        }
        self.frames[frame].chunks = chunks;
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
            let rgba: Vec<[u8; 4]> = target
                .pixels
                .chunks_exact(target.channels as usize)
                .map(|p| [p[0], p[1], p[2], p.get(3).copied().unwrap_or(255)])
                .collect();
            let weight = target.weight();
            let weights =
                target.weights.as_ref().map(|w| self.gpu.upload("weights", w)).transpose()?;
            self.tiles = self.tiles.max(tile_count(width, height));
            let rgba = self.gpu.upload("photo", &rgba)?;
            self.photos.push(Photo { frame, rgba, weights, weight });
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
        self.pending.clear();
        // What the last scene has grown to is likely to be needed again.
        let (capacity, chunks) = self.scene.take().map_or((0, 1), |s| (s.capacity, s.chunks));
        for frame in &mut self.frames {
            frame.ops.clear();
        }
        self.scene = Some(Scene::new(&self.gpu, &state, self.tiles, capacity, chunks)?);
        Ok(())
    }

    fn download(&mut self) -> Result<FitState> {
        self.settle()?;
        let scene = self.scene()?;
        let n = u64::from(scene.splats.splats);
        let sizes = [n * GEOMETRY as u64 * 4, n * scene.splats.color_floats * 4];
        let data = self.gpu.download(
            &[],
            &[
                (&scene.splats.geometry, sizes[0]),
                (&scene.splats.colors, sizes[1]),
                (&scene.first.geometry, sizes[0]),
                (&scene.first.colors, sizes[1]),
                (&scene.second.geometry, sizes[0]),
                (&scene.second.colors, sizes[1]),
                (&scene.stats, n * STATS as u64 * 4),
            ],
        )?;
        let stats: Vec<[f32; STATS]> = bytemuck::pod_collect_to_vec(&data[6]);
        Ok(FitState {
            splats: arrays_from_bytes(&data[0], &data[1], scene.sh_degree),
            first: arrays_from_bytes(&data[2], &data[3], scene.sh_degree),
            second: arrays_from_bytes(&data[4], &data[5], scene.sh_degree),
            stats: DensityStats {
                grad_sum: stats.iter().map(|s| s[0]).collect(),
                seen: stats.iter().map(|s| s[1]).collect(),
            },
        })
    }

    fn step(&mut self, input: &StepInput) -> Result<()> {
        self.enqueue(input, self.pending.len())?;
        self.pending.push(*input);
        if self.pending.len() >= STEPS_AHEAD { self.settle() } else { Ok(()) }
    }

    fn camera_gradients(&mut self) -> Result<Vec<CameraGradient>> {
        self.settle()?;
        Ok(std::mem::take(&mut self.camera_gradients))
    }

    fn loss(&mut self) -> Result<f32> {
        self.settle()?;
        let Some((view, ssim_weight)) = self.last else { return Ok(0.0) };
        let photo = &self.photos[view];
        let loss = &self.frames[photo.frame].loss;
        let data = self.gpu.download(&[], &[(&loss.sums, loss.sum_bytes())])?;
        let [ssim, l1] = LossBuffers::total(&data[0]);
        let Weight { sum, count } = photo.weight;
        if count == 0.0 {
            return Ok(0.0);
        }
        let (s, scale) = (f64::from(ssim_weight), 1.0 / (3.0 * count));
        Ok(((1.0 - s) * l1 * scale + s * (3.0 * sum - ssim) * scale) as f32)
    }
}
