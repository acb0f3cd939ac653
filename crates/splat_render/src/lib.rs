//! A differentiable renderer of Gaussian splats, and a fitter of splats to photos.
//!
//! Every stage has three implementations, under the same name and in files of the same name: in
//! [`reference`] (f64, plain, the standard for tests), [`cpu`] (f32, SIMD, threads) and [`gpu`] (WGSL
//! compute kernels through wgpu). They share the trait [`Stages`]:
//!
//! | stage | from | to |
//! |---|---|---|
//! | project | splats ([`SplatParams`]), [`Camera`] | 2D splats ([`Projected`]) |
//! | bin | 2D splats | lists of splats per tile, inside the two rasterize stages |
//! | rasterize | 2D splats, background | [`Image`]: color, alpha, depth |
//! | exposure | image, gain and offset ([`stages::Exposure`]) | corrected colors |
//! | loss | image, photo ([`target::Target`]) | L1 and D-SSIM, and the image's gradient |
//! | exposure_backward | gradient of the corrected colors | gradients of image, gain and offset |
//! | rasterize_backward | the image's gradient | gradients of the 2D splats |
//! | project_backward | gradients of the 2D splats | gradients of splats and camera |
//! | adam | gradients of the splats | splats after one optimizer step |
//!
//! [`fit`] runs them in a loop on a [`fit::FitDevice`], which keeps splats and photos on its device.
//! [`gpu_check`] opens a GPU that is known to compute correctly. [`io`] reads and writes files of splats
//! and pictures, and [`levels`] scenes in levels of detail.
//!
//! Frames: world coordinates are relative to an f64 origin that files store; cameras are OpenCV's (x
//! right, y down, z forward), with pixel centers at +0.5. Errors are [`Error`].

pub mod camera;
pub mod constants;
pub mod cpu;
pub mod error;
pub mod extent;
pub mod fit;
pub mod fit_device;
pub mod gpu;
pub mod gpu_check;
pub mod io;
pub mod levels;
mod morton;
pub mod reference;
pub mod sh;
pub mod splats;
pub mod stages;
pub mod target;

pub use camera::Camera;
pub use error::{Error, Result};
pub use stages::{
    Colors, Image, ImageGradients, ProjectOptions, Projected, ProjectedGradients, SplatGradients,
    SplatParams, Stages,
};
