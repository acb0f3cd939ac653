//! The stages as WGSL kernels on any Vulkan, Metal or DX12 device, through wgpu.
//!
//! Nothing here needs subgroups, more than 16 KiB of workgroup memory, more than eight storage
//! buffers per kernel, or one workgroup waiting for another; sums are taken in a fixed order, so
//! that runs repeat bit for bit on a device. What does not fit one binding is done in parts:
//! splats in windows, tiles in chunks. Neither changes a bit of the result.

mod bin;
mod device;
mod fit;
mod layout;
mod loss;
mod project;
mod project_backward;
mod rasterize;
mod rasterize_backward;
mod shaders;

pub use device::Gpu;
pub use fit::GpuFit;

use crate::camera::Camera;
use crate::error::{Error, Result};
use crate::stages::{
    Image, ImageGradients, ProjectOptions, Projected, ProjectedGradients, SplatGradients,
    SplatParams, Stages,
};

/// Largest image side in pixels, as [`Camera::validate`] has it.
const SIDE_MAX: u32 = 16_384;

impl Stages<f32> for Gpu {
    fn project(
        &self,
        splats: &SplatParams<'_, f32>,
        camera: &Camera,
        options: &ProjectOptions,
    ) -> Result<Projected<f32>> {
        splats.validate()?;
        camera.validate()?;
        project::project(self, splats, camera, options)
    }

    fn rasterize(&self, projected: &Projected<f32>, background: [f32; 3]) -> Result<Image<f32>> {
        validate_projected(projected)?;
        rasterize::rasterize(self, projected, background)
    }

    fn rasterize_backward(
        &self,
        projected: &Projected<f32>,
        background: [f32; 3],
        image: &Image<f32>,
        v_image: &ImageGradients<f32>,
    ) -> Result<ProjectedGradients<f32>> {
        validate_projected(projected)?;
        let pixels = projected.width as usize * projected.height as usize;
        let lengths = [
            ("image", image.color.len()),
            ("image", image.depth.len()),
            ("image", image.transmittance.len()),
            ("v_color", v_image.v_color.len()),
            ("v_alpha", v_image.v_alpha.len()),
            ("v_depth", v_image.v_depth.len()),
        ];
        for (name, length) in lengths {
            if length != pixels {
                let reason = format!("has {length} pixels where the picture has {pixels}");
                return Err(Error::argument(name, reason));
            }
        }
        rasterize_backward::rasterize_backward(self, projected, background, image, v_image)
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
        validate_projected(projected)?;
        let n = splats.len();
        let lengths = [
            ("projected", projected.len()),
            ("v_means2d", v_projected.v_means2d.len()),
            ("v_covars2d", v_projected.v_covars2d.len()),
            ("v_depths", v_projected.v_depths.len()),
            ("v_colors", v_projected.v_colors.len()),
            ("v_opacities", v_projected.v_opacities.len()),
        ];
        for (name, length) in lengths {
            if length != n {
                let reason = format!("has {length} rows where means has {n}");
                return Err(Error::argument(name, reason));
            }
        }
        project_backward::project_backward(self, splats, camera, options, projected, v_projected)
    }
}

/// Checks what a caller may have put together by hand.
fn validate_projected(projected: &Projected<f32>) -> Result<()> {
    let (w, h) = (projected.width, projected.height);
    if w == 0 || h == 0 || w > SIDE_MAX || h > SIDE_MAX {
        return Err(Error::argument(
            "width, height",
            format!("must lie in 1..={SIDE_MAX}, got {w} x {h}"),
        ));
    }
    let n = projected.len();
    let lengths = [
        ("factors", projected.factors.len()),
        ("depths", projected.depths.len()),
        ("colors", projected.colors.len()),
        ("opacities", projected.opacities.len()),
        ("radii", projected.radii.len()),
    ];
    for (name, length) in lengths {
        if length != n {
            let reason = format!("has {length} rows where means2d has {n}");
            return Err(Error::argument(name, reason));
        }
    }
    Ok(())
}
