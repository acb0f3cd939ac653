//! Conversions between f32 and f64.

use splat_render::SplatGradients;
use splat_render::splats::SplatArrays;
use splat_render::stages::{
    AdamState, Exposure, Image, ImageGradients, Projected, ProjectedGradients,
};

fn convert<A: Copy, B, const K: usize>(rows: &[[A; K]], to: impl Fn(A) -> B + Copy) -> Vec<[B; K]> {
    rows.iter().map(|row| row.map(to)).collect()
}

fn convert1<A: Copy, B>(values: &[A], to: impl Fn(A) -> B) -> Vec<B> {
    values.iter().map(|&v| to(v)).collect()
}

pub fn widen<const K: usize>(rows: &[[f32; K]]) -> Vec<[f64; K]> {
    convert(rows, f64::from)
}

pub fn widen1(values: &[f32]) -> Vec<f64> {
    convert1(values, f64::from)
}

/// The nearest finite f32.
pub fn narrowed(value: f64) -> f32 {
    (value as f32).clamp(f32::MIN, f32::MAX)
}

pub fn narrow<const K: usize>(rows: &[[f64; K]]) -> Vec<[f32; K]> {
    convert(rows, narrowed)
}

pub fn narrow1(values: &[f64]) -> Vec<f32> {
    convert1(values, narrowed)
}

pub fn convert_projected<A: Copy, B>(p: &Projected<A>, to: impl Fn(A) -> B + Copy) -> Projected<B> {
    Projected {
        width: p.width,
        height: p.height,
        means2d: convert(&p.means2d, to),
        factors: convert(&p.factors, to),
        depths: convert1(&p.depths, to),
        colors: convert(&p.colors, to),
        opacities: convert1(&p.opacities, to),
        radii: convert(&p.radii, to),
    }
}

pub fn widen_projected(p: &Projected<f32>) -> Projected<f64> {
    convert_projected(p, f64::from)
}

pub fn convert_image<A: Copy, B>(i: &Image<A>, to: impl Fn(A) -> B + Copy) -> Image<B> {
    Image {
        width: i.width,
        height: i.height,
        color: convert(&i.color, to),
        alpha: convert1(&i.alpha, to),
        depth: convert1(&i.depth, to),
        transmittance: convert1(&i.transmittance, to),
    }
}

pub fn widen_image(i: &Image<f32>) -> Image<f64> {
    convert_image(i, f64::from)
}

pub fn widen_exposure(e: &Exposure<f32>) -> Exposure<f64> {
    Exposure {
        gain: e.gain.map(f64::from),
        offset: e.offset.map(f64::from),
        background: e.background.map(|color| color.map(f64::from)),
    }
}

pub fn widen_image_gradients(g: &ImageGradients<f32>) -> ImageGradients<f64> {
    ImageGradients {
        v_color: widen(&g.v_color),
        v_alpha: widen1(&g.v_alpha),
        v_depth: widen1(&g.v_depth),
    }
}

pub fn convert_projected_gradients<A: Copy, B>(
    g: &ProjectedGradients<A>,
    to: impl Fn(A) -> B + Copy,
) -> ProjectedGradients<B> {
    ProjectedGradients {
        v_means2d: convert(&g.v_means2d, to),
        v_factors: convert(&g.v_factors, to),
        v_depths: convert1(&g.v_depths, to),
        v_colors: convert(&g.v_colors, to),
        v_opacities: convert1(&g.v_opacities, to),
        v_background: g.v_background.map(to),
        v_means2d_absolute: g.v_means2d_absolute.as_ref().map(|v| convert(v, to)),
    }
}

pub fn widen_projected_gradients(g: &ProjectedGradients<f32>) -> ProjectedGradients<f64> {
    convert_projected_gradients(g, f64::from)
}

pub fn convert_splat_gradients<A: Copy, B>(
    g: &SplatGradients<A>,
    to: impl Fn(A) -> B + Copy,
) -> SplatGradients<B> {
    SplatGradients {
        v_means: convert(&g.v_means, to),
        v_quats: convert(&g.v_quats, to),
        v_scales: convert(&g.v_scales, to),
        v_opacities: convert1(&g.v_opacities, to),
        v_colors: convert(&g.v_colors, to),
        v_viewmat: g.v_viewmat,
        v_intrinsics: g.v_intrinsics,
    }
}

pub fn widen_splat_gradients(g: &SplatGradients<f32>) -> SplatGradients<f64> {
    convert_splat_gradients(g, f64::from)
}

pub fn convert_arrays<A: Copy, B>(
    arrays: &SplatArrays<A>,
    to: impl Fn(A) -> B + Copy,
) -> SplatArrays<B> {
    SplatArrays {
        means: convert(&arrays.means, to),
        quats: convert(&arrays.quats, to),
        scales: convert(&arrays.scales, to),
        opacities: convert1(&arrays.opacities, to),
        sh: convert(&arrays.sh, to),
        sh_degree: arrays.sh_degree,
    }
}

pub fn convert_adam_state<A: Copy, B>(
    state: &AdamState<A>,
    to: impl Fn(A) -> B + Copy,
) -> AdamState<B> {
    AdamState {
        splats: convert_arrays(&state.splats, to),
        first: convert_arrays(&state.first, to),
        second: convert_arrays(&state.second, to),
    }
}

pub fn widen_adam_state(state: &AdamState<f32>) -> AdamState<f64> {
    convert_adam_state(state, f64::from)
}
