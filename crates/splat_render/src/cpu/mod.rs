//! The CPU backend: f32, SIMD picked at run time, rayon over tiles and splats.
//!
//! Results do not depend on the number of threads: every sum has a fixed order.

mod adam;
mod bin;
mod fit;
mod loss;
mod peak;
mod project;
mod project_backward;
mod rasterize;
mod rasterize_backward;
mod simd;
mod ssim_window;
mod tile;

use rayon::prelude::*;

use crate::camera::Camera;
use crate::error::Result;
use crate::stages::{
    Colors, Image, ImageGradients, ProjectOptions, Projected, ProjectedGradients, SplatGradients,
    SplatParams, Stages,
};
use bin::{Bins, CHUNK, touched_tiles};
use project::{Splat, Splat2d, View, project_splat};
use project_backward::{V2d, VCamera, splat_backward};
use rasterize::Planes;
use rasterize_backward::{
    ABSOLUTE_SUMS, DEPTH_SUMS, PairSums, PictureGradients, gather, rasterize_backward,
};
use tile::TileSplat;

pub use fit::CpuFit;
pub use peak::peak_multiply_add;
pub use simd::instruction_set;

/// The CPU implementation.
#[derive(Debug, Clone, Copy, Default)]
pub struct Cpu;

/// 2D splats, None where culled or not finite.
fn splats2d(projected: &Projected<f32>) -> Vec<Option<Splat2d>> {
    (0..projected.len())
        .map(|i| {
            let visible = projected.radii[i] != [0.0; 2];
            // What `project` never gives, a caller may have.
            let [mean, radii] = [projected.means2d[i], projected.radii[i]];
            let shape = mean.iter().chain(&radii).chain(&projected.factors[i]);
            let sound = shape.copied().all(f32::is_finite)
                && projected.depths[i] > 0.0
                && projected.opacities[i].is_finite();
            (visible && sound).then(|| Splat2d {
                mean: projected.means2d[i],
                factor: projected.factors[i],
                depth: projected.depths[i],
                color: projected.colors[i],
                opacity: projected.opacities[i],
                radii: projected.radii[i],
            })
        })
        .collect()
}

/// What the rasterize stages read.
struct Binned {
    splats: Vec<TileSplat>,
    bins: Bins,
}

fn bin(projected: &Projected<f32>) -> Result<Binned> {
    let splats = splats2d(projected);
    let chunks = touched_tiles(&splats, projected.width, projected.height);
    let tiles = projected.width.div_ceil(crate::constants::TILE)
        * projected.height.div_ceil(crate::constants::TILE);
    let mut bins = Bins::default();
    bins.fill(&chunks, tiles as usize, |i| projected.depths[i])?;
    let splats =
        splats.iter().map(|s| s.as_ref().map_or_else(TileSplat::default, TileSplat::new)).collect();
    Ok(Binned { splats, bins })
}

/// Gradients of all 2D splats, each with the absolute one of its centre where `N` has it.
fn v2d<const N: usize>(
    Binned { splats, bins }: &Binned,
    image: &Planes,
    v_color: &[Vec<f32>; 3],
    v_image: &ImageGradients<f32>,
) -> Vec<(V2d, [f32; 2])> {
    let (v_alpha, v_depth) = (Some(&v_image.v_alpha[..]), Some(&v_image.v_depth[..]));
    let picture = PictureGradients { image, v_color, v_alpha, v_depth };
    let mut sums: Vec<PairSums<N>> = Vec::new();
    rasterize_backward(splats, bins, picture, &mut sums);
    splats
        .par_chunks(CHUNK)
        .enumerate()
        .flat_map_iter(|(chunk, splats)| {
            let (first, mut pairs) = (chunk * CHUNK, Vec::new());
            bins.take_pairs(first..first + splats.len(), &sums, &mut pairs);
            let gather = |(k, splat)| gather(splat, &pairs[bins.pairs_of(first, first + k)]);
            splats.iter().enumerate().map(gather).collect::<Vec<_>>()
        })
        .collect()
}

impl Stages<f32> for Cpu {
    fn project(
        &self,
        splats: &SplatParams<'_, f32>,
        camera: &Camera,
        options: &ProjectOptions,
    ) -> Result<Projected<f32>> {
        splats.validate()?;
        camera.validate()?;
        let view = View::new(camera, options);
        let list: Vec<Option<Splat2d>> = (0..splats.len())
            .into_par_iter()
            .map(|i| project_splat(&view, &Splat::load(splats, i), &splats.colors, i))
            .collect();
        let mut out = Projected::culled(splats.len(), camera.width, camera.height);
        for (i, splat) in list.iter().enumerate() {
            let Some(splat) = splat else { continue };
            out.means2d[i] = splat.mean;
            out.factors[i] = splat.factor;
            out.depths[i] = splat.depth;
            out.colors[i] = splat.color;
            out.opacities[i] = splat.opacity;
            out.radii[i] = splat.radii;
        }
        Ok(out)
    }

    fn rasterize(&self, projected: &Projected<f32>, background: [f32; 3]) -> Result<Image<f32>> {
        projected.validate()?;
        let Binned { splats, bins } = bin(projected)?;
        let mut planes = Planes::default();
        planes.resize(projected.width, projected.height);
        rasterize::rasterize::<true>(&splats, &bins, background, &mut planes);
        let [r, g, b, depth, transmittance] = planes.planes;
        Ok(Image {
            width: projected.width,
            height: projected.height,
            color: r.iter().zip(&g).zip(&b).map(|((&r, &g), &b)| [r, g, b]).collect(),
            alpha: transmittance.iter().map(|t| 1.0 - t).collect(),
            depth,
            transmittance,
        })
    }

    fn rasterize_backward(
        &self,
        projected: &Projected<f32>,
        _background: [f32; 3],
        image: &Image<f32>,
        v_image: &ImageGradients<f32>,
        absolute: bool,
    ) -> Result<ProjectedGradients<f32>> {
        projected.validate()?;
        v_image.validate(projected, image)?;
        let Binned { splats, bins } = bin(projected)?;
        let channel = |rows: &[[f32; 3]], c: usize| rows.iter().map(|p| p[c]).collect::<Vec<_>>();
        let planes = Planes {
            width: image.width as usize,
            height: image.height as usize,
            planes: [
                channel(&image.color, 0),
                channel(&image.color, 1),
                channel(&image.color, 2),
                image.depth.clone(),
                image.transmittance.clone(),
            ],
        };
        let v_color: [Vec<f32>; 3] = std::array::from_fn(|c| channel(&v_image.v_color, c));
        let binned = Binned { splats, bins };
        let list = if absolute {
            v2d::<ABSOLUTE_SUMS>(&binned, &planes, &v_color, v_image)
        } else {
            v2d::<DEPTH_SUMS>(&binned, &planes, &v_color, v_image)
        };
        let mut v_background = [0.0f64; 3];
        for (t, v) in image.transmittance.iter().zip(&v_image.v_color) {
            for (sum, v) in v_background.iter_mut().zip(v) {
                *sum += f64::from(*t) * f64::from(*v);
            }
        }
        Ok(ProjectedGradients {
            v_means2d: list.iter().map(|(v, _)| v.v_mean).collect(),
            v_factors: list
                .iter()
                .zip(&projected.factors)
                .map(|((v, _), &factor)| v.v_factor(factor))
                .collect(),
            v_depths: list.iter().map(|(v, _)| v.v_depth).collect(),
            v_colors: list.iter().map(|(v, _)| v.v_color).collect(),
            v_opacities: list.iter().map(|(v, _)| v.v_opacity).collect(),
            v_background: v_background.map(|v| v as f32),
            v_means2d_absolute: absolute
                .then(|| list.iter().map(|&(_, v_absolute)| v_absolute).collect()),
        })
    }

    fn project_backward(
        &self,
        splats: &SplatParams<'_, f32>,
        camera: &Camera,
        options: &ProjectOptions,
        projected: &Projected<f32>,
        v_projected: &ProjectedGradients<f32>,
    ) -> Result<SplatGradients<f32>> {
        splats.validate()?;
        camera.validate()?;
        v_projected.validate(splats.len(), projected.len())?;
        let view = View::new(camera, options);
        let n = splats.len();
        let (stride, rows) = match splats.colors {
            Colors::Direct(colors) => (1, colors.len()),
            Colors::Sh { stride, coeffs, .. } => (stride, coeffs.len()),
        };
        let mut out = SplatGradients {
            v_means: vec![[0.0; 3]; n],
            v_quats: vec![[0.0; 4]; n],
            v_scales: vec![[0.0; 3]; n],
            v_opacities: vec![0.0; n],
            v_colors: vec![[0.0; 3]; rows],
            ..SplatGradients::default()
        };
        // Chunks of fixed size, so that the camera's sums do not depend on the threads.
        let cameras: Vec<VCamera> = out
            .v_means
            .par_chunks_mut(CHUNK)
            .zip(out.v_quats.par_chunks_mut(CHUNK))
            .zip(out.v_scales.par_chunks_mut(CHUNK))
            .zip(out.v_opacities.par_chunks_mut(CHUNK))
            .zip(out.v_colors.par_chunks_mut(CHUNK * stride))
            .enumerate()
            .map(|(chunk, ((((means, quats), scales), opacities), colors))| {
                let mut v_camera = VCamera::default();
                for k in 0..means.len() {
                    let i = chunk * CHUNK + k;
                    if projected.radii[i] == [0.0; 2] {
                        continue;
                    }
                    let v = V2d {
                        v_mean: v_projected.v_means2d[i],
                        v_whitened: V2d::whitened_from_factor(
                            projected.factors[i],
                            v_projected.v_factors[i],
                        ),
                        v_depth: v_projected.v_depths[i],
                        v_color: v_projected.v_colors[i],
                        v_opacity: v_projected.v_opacities[i],
                    };
                    let v = splat_backward(
                        &view,
                        &Splat::load(splats, i),
                        splats.raw,
                        &splats.colors,
                        i,
                        &v,
                        &mut colors[k * stride..(k + 1) * stride],
                        Some(&mut v_camera),
                    );
                    means[k] = v.v_mean;
                    quats[k] = v.v_quat;
                    scales[k] = v.v_scales;
                    opacities[k] = v.v_opacity;
                }
                v_camera
            })
            .collect();
        let mut v_camera = VCamera::default();
        for camera in &cameras {
            v_camera.add(camera);
        }
        out.v_viewmat = v_camera.v_viewmat;
        out.v_intrinsics = v_camera.v_intrinsics;
        Ok(out)
    }
}
