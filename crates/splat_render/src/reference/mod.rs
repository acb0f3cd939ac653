//! The oracle: f64, short, plain, no tiles, no tricks. Every other implementation is tested
//! against it, stage by stage.

mod kinks;
mod project;
mod project_backward;
mod rasterize;
mod rasterize_backward;

pub use kinks::decisions;
pub use rasterize::band_pixels;

use crate::camera::Camera;
use crate::error::Result;
use crate::stages::{
    Image, ImageGradients, ProjectOptions, Projected, ProjectedGradients, SplatGradients,
    SplatParams, Stages,
};

/// The f64 reference implementation.
#[derive(Debug, Clone, Copy, Default)]
pub struct Reference;

impl Stages<f64> for Reference {
    fn project(
        &self,
        splats: &SplatParams<'_, f64>,
        camera: &Camera,
        options: &ProjectOptions,
    ) -> Result<Projected<f64>> {
        splats.validate()?;
        camera.validate()?;
        Ok(project::project(splats, camera, options))
    }

    fn rasterize(&self, projected: &Projected<f64>, background: [f64; 3]) -> Result<Image<f64>> {
        projected.validate()?;
        Ok(rasterize::rasterize(projected, background))
    }

    fn rasterize_backward(
        &self,
        projected: &Projected<f64>,
        background: [f64; 3],
        image: &Image<f64>,
        v_image: &ImageGradients<f64>,
        absolute: bool,
    ) -> Result<ProjectedGradients<f64>> {
        projected.validate()?;
        v_image.validate(projected, image)?;
        Ok(rasterize_backward::rasterize_backward(projected, background, v_image, absolute))
    }

    fn project_backward(
        &self,
        splats: &SplatParams<'_, f64>,
        camera: &Camera,
        options: &ProjectOptions,
        projected: &Projected<f64>,
        v_projected: &ProjectedGradients<f64>,
    ) -> Result<SplatGradients<f64>> {
        splats.validate()?;
        camera.validate()?;
        v_projected.validate(splats.len(), projected.len())?;
        Ok(project_backward::project_backward(splats, camera, options, projected, v_projected))
    }
}
