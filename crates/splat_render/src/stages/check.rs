//! What every implementation checks of what a stage is given, before it does anything.

use super::{
    AdamState, AdamStep, Exposure, Image, ImageGradients, ProjectOptions, Projected,
    ProjectedGradients, SplatGradients, check_lengths,
};
use num_traits::Float;

use crate::camera::{Camera, check_size};
use crate::error::{Error, Result};
use crate::splats::SplatParams;
use crate::target::{Target, TargetDepth};

pub fn project<T>(
    splats: &SplatParams<'_, T>,
    camera: &Camera,
    options: &ProjectOptions,
) -> Result<()> {
    splats.validate()?;
    camera.validate()?;
    options.validate()
}

pub fn rasterize_backward<T: Copy + Default>(
    projected: &Projected<T>,
    image: &Image<T>,
    v_image: &ImageGradients<T>,
) -> Result<()> {
    projected.validate()?;
    v_image.validate(projected, image)
}

pub fn project_backward<T: Copy + Default>(
    splats: &SplatParams<'_, T>,
    camera: &Camera,
    options: &ProjectOptions,
    projected: &Projected<T>,
    v_projected: &ProjectedGradients<T>,
) -> Result<()> {
    project(splats, camera, options)?;
    projected.validate()?;
    v_projected.validate(splats.len(), projected.len())
}

pub fn exposure<T: Float>(image: &Image<T>, exposure: &Exposure<T>) -> Result<()> {
    exposure.validate()?;
    check_size(image.width, image.height)?;
    let pixels = image.width as usize * image.height as usize;
    let lengths = [("image", image.color.len()), ("image", image.transmittance.len())];
    check_lengths(&lengths, pixels, "pixels where its size asks for")
}

pub fn exposure_backward<T: Float>(
    image: &Image<T>,
    by: &Exposure<T>,
    v_corrected: &[[T; 3]],
) -> Result<()> {
    exposure(image, by)?;
    let given = [("v_corrected", v_corrected.len())];
    check_lengths(&given, image.color.len(), "pixels where the picture has")
}

pub fn loss<T>(image: &Image<T>, target: &Target, ssim_weight: f32) -> Result<()> {
    target.validate(0)?;
    let (width, height) = (target.width, target.height);
    if (image.width, image.height) != (width, height) {
        return Err(Error::argument(
            "image",
            format!("is {} x {} where the photo is {width} x {height}", image.width, image.height),
        ));
    }
    let pixels = width as usize * height as usize;
    check_lengths(&[("image", image.color.len())], pixels, "pixels where the photo has")?;
    if !(0.0..=1.0).contains(&ssim_weight) {
        return Err(Error::argument(
            "ssim_weight",
            format!("must lie in 0..=1, got {ssim_weight}"),
        ));
    }
    Ok(())
}

pub fn depth_loss<T>(image: &Image<T>, target: &TargetDepth) -> Result<()> {
    let pixels = image.width as usize * image.height as usize;
    target.validate(pixels).map_err(|reason| Error::argument("target", reason))?;
    let lengths = [
        ("image", image.alpha.len()),
        ("image", image.depth.len()),
        ("image", image.transmittance.len()),
    ];
    check_lengths(&lengths, pixels, "pixels where its size asks for")
}

pub fn adam<T>(state: &AdamState<T>, gradients: &SplatGradients<T>, step: &AdamStep) -> Result<()> {
    step.validate()?;
    state.validate(gradients)
}
