//! Fitting on the CPU: project_backward and adam run fused on blocks, which saves gradient arrays.

use rayon::prelude::*;

use super::adam::{BlockGradients, BlockStep};
use super::bin::{Bins, CHUNK, ChunkTiles};
use super::block::{BLOCK, Ids};
use super::depth_loss::DepthLoss;
use super::explore::ExploreBlock;
use super::exposure::Exposed;
use super::loss::Loss;
use super::project::{ProjectBlock, View};
use super::project_backward::{Backward, BackwardBlock, VCamera};
use super::rasterize::{Planes, rasterize_tiles};
use super::rasterize_backward::{
    COLOR_SUMS, DEPTH_SUMS, PairSums, PictureGradients, gather, rasterize_backward_tiles,
};
use super::simd::prefetch;
use super::tile::TileSplat;
use super::waiting_colors::{ColorBlock, ColorPlan, WaitingColor};
use crate::camera::Camera;
use crate::constants::TILE;
use crate::error::Result;
use crate::fit_device::{
    CameraGradient, ExposureGradient, FitDevice, FitState, StepInput, WaitingSteps, is_dropped,
};
use crate::splats::{SplatArrays, SplatParams};
use crate::stages::{Colors, ProjectOptions};
use crate::target::Target;

/// Fits on the CPU.
#[derive(Debug, Default)]
pub struct CpuFit {
    targets: Vec<Target>,
    state: FitState,
    /// Steps that colors have not taken yet, and the state of each splat's colors.
    steps: WaitingSteps,
    waiting: Vec<WaitingColor>,
    loss_value: f32,
    camera_gradients: Vec<CameraGradient>,
    exposure_gradients: Vec<ExposureGradient>,
    // Buffers kept from step to step.
    chunks: Vec<ChunkTiles>,
    splats: Vec<TileSplat>,
    bins: Bins,
    image: Planes,
    exposed: Exposed,
    loss: Loss,
    depth_loss: DepthLoss,
    sums: Vec<PairSums<COLOR_SUMS>>,
    /// As `sums`, of steps whose photo has a depth.
    depth_sums: Vec<PairSums<DEPTH_SUMS>>,
    /// The camera's gradient by block of splats, so that its sum does not depend on the threads.
    block_cameras: Vec<VCamera>,
}

impl FitDevice for CpuFit {
    fn set_targets(&mut self, targets: Vec<Target>) -> Result<()> {
        for (k, target) in targets.iter().enumerate() {
            target.validate(k)?;
        }
        self.targets = targets;
        Ok(())
    }

    fn upload(&mut self, state: FitState) -> Result<()> {
        state.validate()?;
        self.state = state;
        self.forget();
        Ok(())
    }

    fn download(&mut self) -> Result<FitState> {
        self.catch_up();
        Ok(self.state.clone())
    }

    fn edit(&mut self, change: &mut dyn FnMut(&mut FitState)) -> Result<()> {
        self.catch_up();
        change(&mut self.state);
        self.forget();
        self.state.validate()
    }

    fn step(&mut self, input: &StepInput) -> Result<()> {
        input.validate(self.targets.iter().map(|target| (target.width, target.height)))?;
        let view = View::new(&input.camera, &ProjectOptions::default());
        let adam = input.adam();
        if self.steps.must_end_before(&adam) {
            self.catch_up();
        }
        self.project(&view, input)?;
        let target = &self.targets[input.view];
        let (width, height) = (target.width, target.height);
        self.image.resize(width, height);
        let depth = target.depth.as_ref().filter(|_| input.depth_weight > 0.0);
        let (splats, bins) = (&self.splats, &self.bins);
        match depth {
            None => rasterize_tiles::<false>(splats, bins, input.background, &mut self.image),
            Some(_) => rasterize_tiles::<true>(splats, bins, input.background, &mut self.image),
        }
        if let Some(exposure) = &input.exposure {
            self.exposed.run(&self.image, exposure);
        }
        let [r, g, b, ..] = &self.image.planes;
        let colors = match input.exposure {
            None => [r, g, b],
            Some(_) => self.exposed.color.each_ref(),
        };
        self.loss_value = self.loss.run(
            colors.map(|plane| plane.as_slice()),
            target,
            input.background,
            input.ssim_weight,
        );
        let mut v_alpha = None;
        if let Some(exposure) = &input.exposure {
            let v_color = &mut self.loss.v_color;
            let [v_gain, v_offset] = self.exposed.backward(&self.image, exposure, v_color);
            let gradient = ExposureGradient { view: input.view, v_gain, v_offset };
            self.exposure_gradients.push(gradient);
            v_alpha = exposure.background.map(|_| self.exposed.v_alpha.as_slice());
        }
        let mut picture = PictureGradients {
            image: &self.image,
            v_color: &self.loss.v_color,
            v_alpha,
            v_depth: None,
        };
        let size = [width as f32, height as f32];
        if let Some(depth) = depth {
            let [.., accumulated, transmittance] = &self.image.planes;
            let weight = input.depth_weight;
            self.loss_value += self.depth_loss.run(accumulated, transmittance, depth, weight);
            if let Some(v_alpha) = v_alpha {
                self.depth_loss.v_alpha.iter_mut().zip(v_alpha).for_each(|(sum, v)| *sum += v);
            }
            picture.v_alpha = Some(&self.depth_loss.v_alpha);
            picture.v_depth = Some(&self.depth_loss.v_depth);
            rasterize_backward_tiles(&self.splats, &self.bins, picture, &mut self.depth_sums);
            let sums = std::mem::take(&mut self.depth_sums);
            self.update(&view, input, size, &sums);
            self.depth_sums = sums;
        } else {
            rasterize_backward_tiles(&self.splats, &self.bins, picture, &mut self.sums);
            let sums = std::mem::take(&mut self.sums);
            self.update(&view, input, size, &sums);
            self.sums = sums;
        }
        self.steps.add(&adam);
        Ok(())
    }

    fn camera_gradients(&mut self) -> Result<Vec<CameraGradient>> {
        Ok(std::mem::take(&mut self.camera_gradients))
    }

    fn exposure_gradients(&mut self) -> Result<Vec<ExposureGradient>> {
        Ok(std::mem::take(&mut self.exposure_gradients))
    }

    fn loss(&mut self) -> Result<f32> {
        Ok(self.loss_value)
    }
}

/// Selects the splats that a step drops, and scales the opacities of the rest.
struct Dropout {
    seed: u32,
    rate: f32,
    compensation: f32,
}

impl Dropout {
    fn new(input: &StepInput) -> Self {
        Self {
            seed: input.noise_seed,
            rate: input.dropout,
            compensation: 1.0 / (1.0 - input.dropout),
        }
    }

    /// Which of `n` splats from `first` on are not left out.
    fn kept(&self, first: usize, n: usize) -> Ids {
        if self.rate == 0.0 {
            return Ids::all(n);
        }
        let mut ids = Ids::NONE;
        for k in 0..n {
            ids.push_if(k, !is_dropped(self.seed, (first + k) as u32, self.rate));
        }
        ids
    }
}

/// One task's scratch: a block's gradients on their way from its pairs to its parameters.
struct Scratch {
    backward: Box<BackwardBlock>,
    v: BlockGradients,
    explore: Box<ExploreBlock>,
}

impl CpuFit {
    /// Limits the steps that colors of unseen splats wait, by default to
    /// [`COLOR_WAIT`](crate::fit::COLOR_WAIT). The bits do not change.
    pub fn with_color_wait(self, steps: usize) -> Self {
        Self { steps: WaitingSteps::at_most(steps), ..self }
    }

    /// project and bin, with colors of visible splats brought up to date.
    fn project(&mut self, view: &View, input: &StepInput) -> Result<()> {
        let Camera { width, height, .. } = input.camera;
        let dropout = Dropout::new(input);
        let moving = self.state.moving();
        let FitState { splats: values, first, second, stats, .. } = &mut self.state;
        let (n, stride, stored) = (values.len(), values.stride(), values.sh_degree);
        let degree = input.sh_degree.min(stored);
        let SplatArrays { means, quats, scales, opacities, sh, .. } = values;
        let shapes =
            SplatParams { means, quats, scales, opacities, colors: Colors::Direct(&[]), raw: true };
        self.splats.resize(n, TileSplat::default());
        self.waiting.resize(n, WaitingColor::default());
        self.chunks.resize(n.div_ceil(CHUNK), ChunkTiles::default());
        let plan = ColorPlan::new(self.steps.get(), stored, degree);
        (
            self.splats.par_chunks_mut(CHUNK),
            &mut self.chunks,
            stats.seen.par_chunks_mut(CHUNK),
            self.waiting.par_chunks_mut(CHUNK),
            sh.par_chunks_mut(CHUNK * stride),
            first.sh.par_chunks_mut(CHUNK * stride),
            second.sh.par_chunks_mut(CHUNK * stride),
        )
            .into_par_iter()
            .enumerate()
            .for_each_init(
                || (ProjectBlock::new(), ColorBlock::new(&plan)),
                |(block, colors),
                 (chunk, (splats, tiles, seen, waiting, sh, first_sh, second_sh))| {
                    tiles.clear();
                    for (number, splats) in splats.chunks_mut(BLOCK).enumerate() {
                        let start = number * BLOCK;
                        let first = chunk * CHUNK + start;
                        let ids = dropout.kept(first, splats.len());
                        let shown = block.shapes(view, &shapes, first, ids, dropout.compensation);
                        let rows = start * stride..(start + splats.len()) * stride;
                        let waiting = &mut waiting[start..start + splats.len()];
                        let arrays = [&mut *sh, first_sh, second_sh].map(|a| &mut a[rows.clone()]);
                        colors.run(
                            &plan,
                            shown.below(moving.saturating_sub(first)),
                            waiting,
                            arrays,
                        );
                        let coeffs = &sh[rows];
                        block.colors(view, Colors::Sh { degree, stride, coeffs }, 0);
                        let mut next = 0;
                        for (k, splat) in block.visible() {
                            (next..k).for_each(|_| tiles.push_culled());
                            splats[k] = TileSplat::new(&splat);
                            tiles.push(&splat, width, height);
                            seen[start + k] += 1.0;
                            next = k + 1;
                        }
                        (next..splats.len()).for_each(|_| tiles.push_culled());
                    }
                },
            );
        let tiles = width.div_ceil(TILE) * height.div_ceil(TILE);
        let splats = &self.splats;
        self.bins.fill(&self.chunks, tiles as usize, |i| splats[i].depth)
    }

    /// Brings all colors up to date.
    fn catch_up(&mut self) {
        if self.steps.get().is_empty() {
            return;
        }
        let moving = self.state.moving();
        let FitState { splats, first, second, .. } = &mut self.state;
        let stride = splats.stride();
        let plan = ColorPlan::new(self.steps.get(), splats.sh_degree, self.steps.degree());
        (
            self.waiting[..moving].par_chunks_mut(BLOCK),
            splats.sh.par_chunks_mut(BLOCK * stride),
            first.sh.par_chunks_mut(BLOCK * stride),
            second.sh.par_chunks_mut(BLOCK * stride),
        )
            .into_par_iter()
            .for_each_init(
                || ColorBlock::new(&plan),
                |block, (waiting, sh, first, second)| {
                    block.run(&plan, Ids::all(waiting.len()), waiting, [sh, first, second]);
                },
            );
        self.forget();
    }

    /// Restarts the wait; all colors are up to date.
    fn forget(&mut self) {
        self.steps.clear();
        self.waiting.clear();
    }

    /// project_backward, adam and density statistics.
    fn update<const N: usize>(
        &mut self,
        view: &View,
        input: &StepInput,
        size: [f32; 2],
        sums: &[PairSums<N>],
    ) {
        let moving = self.state.moving();
        let FitState { splats: values, first, second, stats, .. } = &mut self.state;
        let n = values.len();
        let stride = values.stride();
        let degree = input.sh_degree.min(values.sh_degree);
        let (bins, tile_splats) = (&self.bins, &self.splats);
        let dropout = Dropout::new(input);
        let adam = input.adam();
        let plan = BlockStep::new(&adam, moving, values.sh_degree);
        let waits = !adam.is_frozen();
        self.block_cameras.clear();
        self.block_cameras.resize(n.div_ceil(BLOCK), VCamera::default());

        (
            values.blocks_mut(BLOCK),
            first.blocks_mut(BLOCK),
            second.blocks_mut(BLOCK),
            stats.grad_sum.par_chunks_mut(BLOCK),
            self.waiting.par_chunks_mut(BLOCK),
            &mut self.block_cameras,
        )
            .into_par_iter()
            .enumerate()
            .for_each_init(
                || Scratch {
                    backward: BackwardBlock::new(),
                    v: BlockGradients::new(0),
                    explore: ExploreBlock::new(),
                },
                |scratch, (block, (values, first, second, grad_sum, waiting, v_camera))| {
                    let first_id = block * BLOCK;
                    let n = values.means.len();
                    let moving = moving.saturating_sub(first_id).min(n);
                    // Of splats that stay as they are, only the camera's gradient is of use.
                    if moving == 0 && !input.camera_gradient {
                        return;
                    }
                    let Scratch { backward, v, explore } = scratch;
                    for position in bins.positions_of(first_id..first_id + n) {
                        prefetch(&sums[position]);
                    }
                    backward.clear();
                    for k in 0..n {
                        let i = first_id + k;
                        let mut positions = bins.positions_of(i..i + 1).peekable();
                        if positions.peek().is_some() {
                            let (v2d, _) = gather(&tile_splats[i], sums, positions);
                            let [x, y] = v2d.v_mean;
                            let (x, y) = (0.5 * size[0] * x, 0.5 * size[1] * y);
                            grad_sum[k] += (x * x + y * y).sqrt();
                            backward.push(k, &v2d);
                        }
                    }
                    let stage = Backward {
                        view,
                        splats: values.params(degree, stride),
                        compensation: dropout.compensation,
                        camera: input.camera_gradient,
                    };
                    *v_camera = backward.run(&stage, 0, v.zeroed(n));
                    if moving == 0 {
                        return;
                    }
                    for (k, gradient) in backward.color_gradients() {
                        if waits && k < moving {
                            waiting[k].add(gradient);
                        }
                    }
                    let [mut values, first, second] =
                        [values, first, second].map(|arrays| arrays.first(moving));
                    plan.pull(&values, v);
                    plan.apply(&mut values, &mut [first, second], v);
                    plan.explore(&mut values, explore, first_id);
                },
            );
        if input.camera_gradient {
            let mut sum = VCamera::default();
            self.block_cameras.iter().for_each(|block| sum.add(block));
            let VCamera { v_viewmat, v_intrinsics } = sum;
            self.camera_gradients.push(CameraGradient {
                view: input.view,
                v_viewmat,
                v_intrinsics,
            });
        }
    }
}
