//! The CPU as a fitting device: project_backward and Adam run fused, splat by splat, so that no
//! gradient array of the parameters' size exists.

use glam::{Mat3, Quat, Vec3};
use rayon::prelude::*;

use super::adam::{Bias, adam};
use super::bin::{Bins, CHUNK, ChunkTiles};
use super::loss::Loss;
use super::project::{Splat, Splat2d, View, project_splat};
use super::project_backward::{V2d, splat_backward};
use super::rasterize::{Planes, TileSplat, rasterize};
use super::rasterize_backward::{PairSums, gather, rasterize_backward};
use crate::constants::{SH_COEFFS_MAX, TILE};
use crate::error::{Error, Result};
use crate::fit::{FitDevice, FitState, StepInput, Target, noise_normal};
use crate::sh;
use crate::stages::{Colors, ProjectOptions, SplatParams};

/// Fits on the CPU.
#[derive(Debug, Default)]
pub struct CpuFit {
    targets: Vec<Target>,
    state: FitState,
    loss_value: f32,
    // Buffers kept from step to step.
    chunks: Vec<ChunkTiles>,
    splats: Vec<TileSplat>,
    bins: Bins,
    image: Planes,
    photo: [Vec<f32>; 3],
    loss: Loss,
    sums: Vec<PairSums>,
}

impl FitDevice for CpuFit {
    fn set_targets(&mut self, targets: Vec<Target>) -> Result<()> {
        for (k, target) in targets.iter().enumerate() {
            target.validate(k)?;
        }
        self.targets = targets;
        Ok(())
    }

    fn upload(&mut self, state: &FitState) -> Result<()> {
        state.validate()?;
        self.state = state.clone();
        Ok(())
    }

    fn download(&mut self) -> Result<FitState> {
        Ok(self.state.clone())
    }

    fn step(&mut self, input: &StepInput<'_>) -> Result<()> {
        let target = self.targets.get(input.view).ok_or_else(|| {
            Error::argument("view", format!("{} is not one of the photos", input.view))
        })?;
        let view = View::new(input.camera, &ProjectOptions::default());
        let (width, height) = (target.width, target.height);

        // project and the first half of bin
        let params = self.state.splats.params(input.sh_degree);
        self.splats.resize(params.len(), TileSplat::default());
        self.chunks.resize(params.len().div_ceil(CHUNK), ChunkTiles::default());
        let stats = &mut self.state.stats;
        self.splats
            .par_chunks_mut(CHUNK)
            .zip(&mut self.chunks)
            .zip(stats.seen.par_chunks_mut(CHUNK))
            .zip(stats.radius.par_chunks_mut(CHUNK))
            .enumerate()
            .for_each(|(chunk, (((splats, tiles), seen), radius))| {
                tiles.clear();
                for (k, out) in splats.iter_mut().enumerate() {
                    let i = chunk * CHUNK + k;
                    let splat = Splat::load(&params, i);
                    match project_splat(&view, &splat, &params.colors, i) {
                        None => tiles.push_culled(),
                        Some(splat) => {
                            *out = TileSplat::new(&splat);
                            tiles.push(&splat, width, height);
                            seen[k] += 1.0;
                            radius[k] = radius[k].max(extent(&splat, width, height));
                        }
                    }
                }
            });
        let tiles = width.div_ceil(TILE) * height.div_ceil(TILE);
        let splats = &self.splats;
        self.bins.fill(&self.chunks, tiles as usize, |i| splats[i].depth);

        self.image.resize(width, height);
        rasterize(&self.splats, &self.bins, input.background, &mut self.image);
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
            &self.image,
            &self.loss.v_color,
            None,
            None,
            &mut self.sums,
        );
        self.update(&view, input, [width as f32, height as f32]);
        Ok(())
    }

    fn loss(&mut self) -> Result<f32> {
        Ok(self.loss_value)
    }
}

/// Larger radius as a part of the larger image side.
fn extent(splat: &Splat2d, width: u32, height: u32) -> f32 {
    splat.radii[0].max(splat.radii[1]) / width.max(height) as f32
}

impl CpuFit {
    /// project_backward, Adam, noise and density statistics.
    fn update(&mut self, view: &View, input: &StepInput<'_>, size: [f32; 2]) {
        let FitState { splats: values, first, second, stats } = &mut self.state;
        let n = values.len();
        let stride = values.stride();
        let degree = input.sh_degree.min(values.sh_degree);
        let bias = Bias::new(input.step);
        let (bins, tile_splats, sums) = (&self.bins, &self.splats, &self.sums);
        let opacity_pull = input.opacity_regularizer / n as f32;
        let scale_pull = input.scale_regularizer / (3 * n) as f32;
        let rates = &input.rates;

        macro_rules! chunks {
            ($arrays:expr) => {
                $arrays
                    .means
                    .par_chunks_mut(CHUNK)
                    .zip($arrays.quats.par_chunks_mut(CHUNK))
                    .zip($arrays.scales.par_chunks_mut(CHUNK))
                    .zip($arrays.opacities.par_chunks_mut(CHUNK))
                    .zip($arrays.sh.par_chunks_mut(CHUNK * stride))
            };
        }
        chunks!(values)
            .zip(chunks!(first))
            .zip(chunks!(second))
            .zip(stats.grad_sum.par_chunks_mut(CHUNK))
            .enumerate()
            .for_each(|(chunk, (((value, first), second), grad_sum))| {
                let ((((means, quats), scales), opacities), coeffs) = value;
                let ((((means1, quats1), scales1), opacities1), coeffs1) = first;
                let ((((means2, quats2), scales2), opacities2), coeffs2) = second;
                for k in 0..means.len() {
                    let i = chunk * CHUNK + k;
                    let params = SplatParams {
                        means,
                        quats,
                        scales,
                        opacities,
                        colors: Colors::Sh { degree, stride, coeffs },
                        raw: true,
                    };
                    let splat = Splat::load(&params, k);
                    let mut v = Default::default();
                    let mut v_sh = [[0.0f32; 3]; SH_COEFFS_MAX];
                    if bins.slots[i + 1] > bins.slots[i] {
                        let v2d: V2d = gather(i, &tile_splats[i], bins, sums);
                        let [x, y] = v2d.v_mean;
                        grad_sum[k] += (0.5 * size[0] * x).hypot(0.5 * size[1] * y);
                        v = splat_backward(
                            view,
                            &splat,
                            true,
                            &params.colors,
                            k,
                            &v2d,
                            &mut v_sh,
                            None,
                        );
                    }
                    v.v_opacity += opacity_pull * splat.opacity * (1.0 - splat.opacity);
                    for (v, scale) in v.v_scales.iter_mut().zip(splat.scales.to_array()) {
                        *v += scale_pull * scale;
                    }
                    adam(
                        &mut means[k],
                        &mut means1[k],
                        &mut means2[k],
                        v.v_mean,
                        rates.means,
                        bias,
                    );
                    adam(
                        &mut quats[k],
                        &mut quats1[k],
                        &mut quats2[k],
                        v.v_quat,
                        rates.quats,
                        bias,
                    );
                    adam(
                        &mut scales[k],
                        &mut scales1[k],
                        &mut scales2[k],
                        v.v_scales,
                        rates.scales,
                        bias,
                    );
                    adam(
                        std::array::from_mut(&mut opacities[k]),
                        std::array::from_mut(&mut opacities1[k]),
                        std::array::from_mut(&mut opacities2[k]),
                        [v.v_opacity],
                        rates.opacities,
                        bias,
                    );
                    for c in 0..sh::coeffs(degree) {
                        let rate = if c == 0 { rates.sh0 } else { rates.sh_rest };
                        let at = k * stride + c;
                        adam(
                            &mut coeffs[at],
                            &mut coeffs1[at],
                            &mut coeffs2[at],
                            v_sh[c],
                            rate,
                            bias,
                        );
                    }
                    if input.noise > 0.0 {
                        let moved =
                            explore(&means[k], &quats[k], &scales[k], opacities[k], input, i);
                        means[k] = moved;
                    }
                }
            });
    }
}

/// 3DGS-MCMC's exploration: nearly transparent splats take a random step shaped by their covariance.
#[inline(always)]
fn explore(
    mean: &[f32; 3],
    quat: &[f32; 4],
    log_scales: &[f32; 3],
    logit: f32,
    input: &StepInput<'_>,
    i: usize,
) -> [f32; 3] {
    let opacity = 1.0 / (1.0 + (-logit).exp());
    let gate = 1.0 / (1.0 + (-100.0 * (0.005 - opacity)).exp());
    // Beyond this the step is under 1e-7 of the splat's size times the rate.
    if gate < 1e-7 {
        return *mean;
    }
    let [w, x, y, z] = *quat;
    let axes = Mat3::from_quat(Quat::from_xyzw(x, y, z, w).normalize());
    let scales = Vec3::from(*log_scales).exp();
    let z = Vec3::from(noise_normal(input.noise_seed, i as u32));
    let moved = axes * (scales * scales * (axes.transpose() * z)) * (gate * input.noise);
    let out = Vec3::from(*mean) + moved;
    if out.is_finite() { out.to_array() } else { *mean }
}
