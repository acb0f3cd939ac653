//! The CPU as a fitting device: project_backward and adam run fused, a block of splats at a time, so
//! that no gradient array of the parameters' size exists.

use rayon::prelude::*;

use super::adam::{BLOCK, BlockGradients, BlockStep};
use super::bin::{Bins, CHUNK, ChunkTiles};
use super::exposure::Exposed;
use super::loss::Loss;
use super::project::{Splat, View, project_splat};
use super::project_backward::{SplatBackward, VCamera, VSplat};
use super::rasterize::{Planes, rasterize_tiles};
use super::rasterize_backward::{
    COLOR_SUMS, PairSums, PictureGradients, gather, rasterize_backward_tiles,
};
use super::tile::TileSplat;
use crate::constants::TILE;
use crate::error::Result;
use crate::fit_device::{
    CameraGradient, ExposureGradient, FitDevice, FitState, StepInput, is_dropped,
};
use crate::stages::{Colors, ProjectOptions};
use crate::target::Target;

/// Fits on the CPU.
#[derive(Debug, Default)]
pub struct CpuFit {
    targets: Vec<Target>,
    state: FitState,
    loss_value: f32,
    camera_gradients: Vec<CameraGradient>,
    exposure_gradients: Vec<ExposureGradient>,
    // Buffers kept from step to step.
    chunks: Vec<ChunkTiles>,
    splats: Vec<TileSplat>,
    bins: Bins,
    image: Planes,
    exposed: Exposed,
    photo: [Vec<f32>; 3],
    loss: Loss,
    sums: Vec<PairSums<COLOR_SUMS>>,
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
        Ok(())
    }

    fn download(&mut self) -> Result<FitState> {
        Ok(self.state.clone())
    }

    fn edit(&mut self, change: &mut dyn FnMut(&mut FitState)) -> Result<()> {
        change(&mut self.state);
        self.state.validate()
    }

    fn step(&mut self, input: &StepInput) -> Result<()> {
        input.validate(self.targets.iter().map(|target| (target.width, target.height)))?;
        let target = &self.targets[input.view];
        let view = View::new(&input.camera, &ProjectOptions::default());
        let (width, height) = (target.width, target.height);

        // project and the first half of bin
        let params = self.state.splats.params(input.sh_degree);
        let dropout = Dropout::new(input);
        self.splats.resize(params.len(), TileSplat::default());
        self.chunks.resize(params.len().div_ceil(CHUNK), ChunkTiles::default());
        let stats = &mut self.state.stats;
        (self.splats.par_chunks_mut(CHUNK), &mut self.chunks, stats.seen.par_chunks_mut(CHUNK))
            .into_par_iter()
            .enumerate()
            .for_each(|(chunk, (splats, tiles, seen))| {
                tiles.clear();
                for (k, out) in splats.iter_mut().enumerate() {
                    let i = chunk * CHUNK + k;
                    if dropout.drops(i) {
                        tiles.push_culled();
                        continue;
                    }
                    let splat = Splat::load(&params, i).compensated(dropout.compensation);
                    match project_splat(&view, &splat, &params.colors, i) {
                        None => tiles.push_culled(),
                        Some(splat) => {
                            *out = TileSplat::new(&splat);
                            tiles.push(&splat, width, height);
                            seen[k] += 1.0;
                        }
                    }
                }
            });
        let tiles = width.div_ceil(TILE) * height.div_ceil(TILE);
        let splats = &self.splats;
        self.bins.fill(&self.chunks, tiles as usize, |i| splats[i].depth)?;

        self.image.resize(width, height);
        rasterize_tiles::<false>(&self.splats, &self.bins, input.background, &mut self.image);
        target.composite(input.background, &mut self.photo);
        if let Some(exposure) = &input.exposure {
            self.exposed.run(&self.image, exposure);
        }
        let [r, g, b, ..] = &self.image.planes;
        let colors = match input.exposure {
            None => [r, g, b],
            Some(_) => self.exposed.color.each_ref(),
        };
        let [photo_r, photo_g, photo_b] = &self.photo;
        self.loss_value = self.loss.run(
            colors.map(|plane| plane.as_slice()),
            [photo_r, photo_g, photo_b],
            target.weights.as_deref(),
            width as usize,
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
        rasterize_backward_tiles(
            &self.splats,
            &self.bins,
            PictureGradients {
                image: &self.image,
                v_color: &self.loss.v_color,
                v_alpha,
                v_depth: None,
            },
            &mut self.sums,
        );
        self.update(&view, input, [width as f32, height as f32]);
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

/// Which splats a step leaves out, and what it multiplies the others' opacities by.
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

    fn drops(&self, i: usize) -> bool {
        self.rate > 0.0 && is_dropped(self.seed, i as u32, self.rate)
    }
}

/// One task's scratch: a block of gradients and what the block's pairs summed up.
struct Scratch {
    v: BlockGradients,
    pairs: Vec<PairSums<COLOR_SUMS>>,
}

impl CpuFit {
    /// project_backward, adam and density statistics.
    fn update(&mut self, view: &View, input: &StepInput, size: [f32; 2]) {
        let FitState { splats: values, first, second, stats } = &mut self.state;
        let n = values.len();
        let stride = values.stride();
        let degree = input.sh_degree.min(values.sh_degree);
        let (bins, tile_splats, sums) = (&self.bins, &self.splats, &self.sums);
        let dropout = Dropout::new(input);
        let plan = BlockStep::new(&input.adam(), n, values.sh_degree);
        self.block_cameras.clear();
        self.block_cameras.resize(n.div_ceil(BLOCK), VCamera::default());

        (
            values.blocks_mut(BLOCK),
            first.blocks_mut(BLOCK),
            second.blocks_mut(BLOCK),
            stats.grad_sum.par_chunks_mut(BLOCK),
            &mut self.block_cameras,
        )
            .into_par_iter()
            .enumerate()
            .for_each_init(
                || Scratch { v: BlockGradients::new(stride), pairs: Vec::new() },
                |scratch, (block, (values, first, second, grad_sum, v_camera))| {
                    let first_id = block * BLOCK;
                    let n = values.means.len();
                    let backward = SplatBackward {
                        view,
                        colors: Colors::Sh { degree, stride, coeffs: values.sh },
                        raw: true,
                    };
                    bins.take_pairs(first_id..first_id + n, sums, &mut scratch.pairs);
                    for k in 0..n {
                        let i = first_id + k;
                        let splat = Splat::activate(
                            values.means[k],
                            values.quats[k],
                            values.scales[k],
                            values.opacities[k],
                        );
                        let v_sh = &mut scratch.v.sh[k * stride..(k + 1) * stride];
                        let mut v = VSplat::default();
                        if bins.slots[i + 1] > bins.slots[i] {
                            let pairs = &scratch.pairs[bins.pairs_of(first_id, i)];
                            let (v2d, _) = gather(&tile_splats[i], pairs);
                            let [x, y] = v2d.v_mean;
                            let (x, y) = (0.5 * size[0] * x, 0.5 * size[1] * y);
                            grad_sum[k] += (x * x + y * y).sqrt();
                            let splat = splat.compensated(dropout.compensation);
                            let v_camera = input.camera_gradient.then_some(&mut *v_camera);
                            v = backward.run(k, &splat, &v2d, v_sh, v_camera);
                        } else {
                            v_sh.fill([0.0; 3]);
                        }
                        plan.pull(&splat, &mut v);
                        scratch.v.set(k, &v);
                    }
                    plan.apply(values, [first, second], &scratch.v, first_id);
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
