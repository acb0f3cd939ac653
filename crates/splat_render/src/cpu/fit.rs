//! The CPU as a fitting device: project_backward and Adam run fused, splat by splat, so that no
//! gradient array of the parameters' size exists.

use glam::{Mat3, Quat, Vec3};
use rayon::prelude::*;

use super::adam::{Adam, Bias};
use super::bin::{Bins, CHUNK, ChunkTiles};
use super::loss::Loss;
use super::project::{Splat, View, project_splat};
use super::project_backward::{VCamera, VSplat, splat_backward};
use super::rasterize::{Planes, rasterize};
use super::rasterize_backward::{
    COLOR_SUMS, PairSums, PictureGradients, gather, rasterize_backward,
};
use super::simd::dispatch;
use super::tile::TileSplat;
use crate::constants::TILE;
use crate::error::{Error, Result};
use crate::fit::{
    CameraGradient, FitDevice, FitState, Rates, StepInput, Target, is_dropped, noise_normal,
};
use crate::sh;
use crate::stages::{Colors, ProjectOptions, SplatParams};

/// Fits on the CPU.
#[derive(Debug, Default)]
pub struct CpuFit {
    targets: Vec<Target>,
    state: FitState,
    loss_value: f32,
    camera_gradients: Vec<CameraGradient>,
    // Buffers kept from step to step.
    chunks: Vec<ChunkTiles>,
    splats: Vec<TileSplat>,
    bins: Bins,
    image: Planes,
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
        let target = self.targets.get(input.view).ok_or_else(|| {
            Error::argument("view", format!("{} is not one of the photos", input.view))
        })?;
        let view = View::new(&input.camera, &ProjectOptions::default());
        let (width, height) = (target.width, target.height);

        // project and the first half of bin
        let params = self.state.splats.params(input.sh_degree);
        let dropout = Dropout::new(input);
        self.splats.resize(params.len(), TileSplat::default());
        self.chunks.resize(params.len().div_ceil(CHUNK), ChunkTiles::default());
        let stats = &mut self.state.stats;
        self.splats
            .par_chunks_mut(CHUNK)
            .zip(&mut self.chunks)
            .zip(stats.seen.par_chunks_mut(CHUNK))
            .enumerate()
            .for_each(|(chunk, ((splats, tiles), seen))| {
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
        rasterize::<false>(&self.splats, &self.bins, input.background, &mut self.image);
        target.composite(input.background, &mut self.photo);
        let [r, g, b, ..] = &self.image.planes;
        let [photo_r, photo_g, photo_b] = &self.photo;
        self.loss_value = self.loss.run(
            [r, g, b],
            [photo_r, photo_g, photo_b],
            target.weights.as_deref(),
            width as usize,
            input.ssim_weight,
        );
        rasterize_backward(
            &self.splats,
            &self.bins,
            PictureGradients {
                image: &self.image,
                v_color: &self.loss.v_color,
                v_alpha: None,
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

/// Splats whose gradients are gathered before Adam runs over them: they stay in the cache.
const BLOCK: usize = 64;

/// One task's block of gradients, laid out as the parameters are.
struct Block {
    means: Vec<[f32; 3]>,
    quats: Vec<[f32; 4]>,
    scales: Vec<[f32; 3]>,
    opacities: Vec<f32>,
    sh: Vec<[f32; 3]>,
    /// What the block's pairs summed up.
    pairs: Vec<PairSums<COLOR_SUMS>>,
}

impl Block {
    fn new(stride: usize) -> Self {
        Self {
            means: vec![[0.0; 3]; BLOCK],
            quats: vec![[0.0; 4]; BLOCK],
            scales: vec![[0.0; 3]; BLOCK],
            opacities: vec![0.0; BLOCK],
            sh: vec![[0.0; 3]; BLOCK * stride],
            pairs: Vec::new(),
        }
    }
}

/// The same rates for every splat of a block, laid out as the parameters are.
struct BlockRates {
    means: Vec<f32>,
    quats: Vec<f32>,
    scales: Vec<f32>,
    opacities: Vec<f32>,
    sh: Vec<f32>,
}

impl BlockRates {
    fn new(rates: &Rates, stride: usize, active: usize) -> Self {
        let row: Vec<f32> = (0..3 * stride)
            .map(|k| match k / 3 {
                0 => rates.sh0,
                c if c < active => rates.sh_rest,
                _ => 0.0,
            })
            .collect();
        Self {
            means: vec![rates.means; 3 * BLOCK],
            quats: vec![rates.quats; 4 * BLOCK],
            scales: vec![rates.scales; 3 * BLOCK],
            opacities: vec![rates.opacities; BLOCK],
            sh: row.repeat(BLOCK),
        }
    }
}

impl CpuFit {
    /// project_backward, Adam, noise and density statistics.
    fn update(&mut self, view: &View, input: &StepInput, size: [f32; 2]) {
        let FitState { splats: values, first, second, stats } = &mut self.state;
        let n = values.len();
        let stride = values.stride();
        let degree = input.sh_degree.min(values.sh_degree);
        let bias = Bias::new(input.step);
        let (bins, tile_splats, sums) = (&self.bins, &self.splats, &self.sums);
        let dropout = Dropout::new(input);
        let opacity_pull = input.opacity_regularizer / n as f32;
        let scale_pull = input.scale_regularizer / (3 * n) as f32;
        let rates = BlockRates::new(&input.rates, stride, sh::coeffs(degree));
        let frozen = input.rates == Rates::ZERO;
        self.block_cameras.clear();
        self.block_cameras.resize(n.div_ceil(BLOCK), VCamera::default());

        macro_rules! blocks {
            ($arrays:expr) => {
                $arrays
                    .means
                    .par_chunks_mut(BLOCK)
                    .zip($arrays.quats.par_chunks_mut(BLOCK))
                    .zip($arrays.scales.par_chunks_mut(BLOCK))
                    .zip($arrays.opacities.par_chunks_mut(BLOCK))
                    .zip($arrays.sh.par_chunks_mut(BLOCK * stride))
            };
        }
        blocks!(values)
            .zip(blocks!(first))
            .zip(blocks!(second))
            .zip(stats.grad_sum.par_chunks_mut(BLOCK))
            .zip(&mut self.block_cameras)
            .enumerate()
            .for_each_init(
                || Block::new(stride),
                |v_block, (block, ((((value, first), second), grad_sum), v_camera))| {
                    let ((((means, quats), scales), opacities), coeffs) = value;
                    let ((((means1, quats1), scales1), opacities1), coeffs1) = first;
                    let ((((means2, quats2), scales2), opacities2), coeffs2) = second;
                    let params = SplatParams {
                        means,
                        quats,
                        scales,
                        opacities,
                        colors: Colors::Sh { degree, stride, coeffs },
                        raw: true,
                    };
                    let first = block * BLOCK;
                    bins.take_pairs(first..first + params.len(), sums, &mut v_block.pairs);
                    for k in 0..params.len() {
                        let i = first + k;
                        let splat = Splat::load(&params, k);
                        let v_sh = &mut v_block.sh[k * stride..(k + 1) * stride];
                        let mut v = VSplat::default();
                        if bins.slots[i + 1] > bins.slots[i] {
                            let pairs = &v_block.pairs[bins.pairs_of(first, i)];
                            let (v2d, _) = gather(&tile_splats[i], pairs);
                            let [x, y] = v2d.v_mean;
                            let (x, y) = (0.5 * size[0] * x, 0.5 * size[1] * y);
                            grad_sum[k] += (x * x + y * y).sqrt();
                            v = splat_backward(
                                view,
                                &splat.compensated(dropout.compensation),
                                true,
                                &params.colors,
                                k,
                                &v2d,
                                v_sh,
                                input.camera_gradient.then_some(&mut *v_camera),
                            );
                        } else {
                            v_sh.fill([0.0; 3]);
                        }
                        v.v_opacity += opacity_pull * splat.opacity_slope;
                        for (v, scale) in v.v_scales.iter_mut().zip(splat.scales.to_array()) {
                            *v += scale_pull * scale;
                        }
                        v_block.means[k] = v.v_mean;
                        v_block.quats[k] = v.v_quat;
                        v_block.scales[k] = v.v_scales;
                        v_block.opacities[k] = v.v_opacity;
                    }
                    if frozen {
                        return;
                    }
                    macro_rules! adam {
                        ($values:expr, $first:expr, $second:expr, $name:ident) => {
                            dispatch(Adam {
                                values: bytemuck::cast_slice_mut($values),
                                first: bytemuck::cast_slice_mut($first),
                                second: bytemuck::cast_slice_mut($second),
                                gradient: bytemuck::cast_slice(&v_block.$name),
                                rates: &rates.$name,
                                bias,
                            })
                        };
                    }
                    adam!(means, means1, means2, means);
                    adam!(quats, quats1, quats2, quats);
                    adam!(scales, scales1, scales2, scales);
                    adam!(opacities, opacities1, opacities2, opacities);
                    adam!(coeffs, coeffs1, coeffs2, sh);
                    if input.noise > 0.0 {
                        for k in 0..means.len() {
                            let i = block * BLOCK + k;
                            means[k] =
                                explore(means[k], quats[k], scales[k], opacities[k], input, i);
                        }
                    }
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

/// 3DGS-MCMC's exploration: nearly transparent splats take a random step shaped by their covariance.
#[inline(always)]
fn explore(
    mean: [f32; 3],
    quat: [f32; 4],
    log_scales: [f32; 3],
    logit: f32,
    input: &StepInput,
    i: usize,
) -> [f32; 3] {
    let opacity = 1.0 / (1.0 + (-logit).exp());
    let gate = 1.0 / (1.0 + (-100.0 * (0.005 - opacity)).exp());
    // Beyond this the step is under 1e-7 of the splat's size times the rate.
    if gate < 1e-7 {
        return mean;
    }
    let [w, x, y, z] = quat;
    let axes = Mat3::from_quat(Quat::from_xyzw(x, y, z, w).normalize());
    let scales = Vec3::from(log_scales).exp();
    let z = Vec3::from(noise_normal(input.noise_seed, i as u32));
    let moved = axes * (scales * scales * (axes.transpose() * z)) * (gate * input.noise);
    let out = Vec3::from(mean) + moved;
    if out.is_finite() { out.to_array() } else { mean }
}
