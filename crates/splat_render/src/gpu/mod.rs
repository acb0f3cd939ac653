//! The stages as WGSL kernels on any Vulkan, Metal or DX12 device, through wgpu.
//!
//! Nothing here needs subgroups (only llvmpipe uses them: tile_subgroup.wgsl), more than 16 KiB of
//! workgroup memory, more than eight storage buffers per kernel, or one workgroup waiting for another;
//! sums are taken in a fixed order, so that runs repeat bit for bit on a device. What does not fit one
//! binding is done in parts: splats in windows, tiles in chunks. Neither changes a bit of the result.

mod bin;
mod desktop;
mod device;
mod fit;
mod layout;
mod loss;
mod project;
mod project_backward;
mod rasterize;
mod rasterize_backward;
mod resident;
mod resident_picture;
mod shaders;

pub use device::Gpu;
pub use fit::GpuFit;
pub use resident::ResidentSplats;
pub use resident_picture::ResidentPicture;
pub use shaders::shared_wgsl;

use crate::camera::Camera;
use crate::error::Result;
use crate::stages::{
    Image, ImageGradients, ProjectOptions, Projected, ProjectedGradients, SplatGradients,
    SplatParams, Stages,
};

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
        projected.validate()?;
        rasterize::rasterize(self, projected, background)
    }

    fn rasterize_backward(
        &self,
        projected: &Projected<f32>,
        background: [f32; 3],
        image: &Image<f32>,
        v_image: &ImageGradients<f32>,
        absolute: bool,
    ) -> Result<ProjectedGradients<f32>> {
        projected.validate()?;
        v_image.validate(projected, image)?;
        rasterize_backward::rasterize_backward(
            self, projected, background, image, v_image, absolute,
        )
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
        projected.validate()?;
        v_projected.validate(splats.len(), projected.len())?;
        project_backward::project_backward(self, splats, camera, options, projected, v_projected)
    }
}
