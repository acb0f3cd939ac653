//! Differentiable Gaussian splatting: one set of stages, three implementations.
//!
//! `project -> bin -> rasterize -> rasterize_backward -> project_backward` exist as
//! [`reference`] (f64, plain, the oracle), [`cpu`] (f32, SIMD, threads) and [`gpu`] (WGSL through
//! wgpu). A stage has the same name and file name in each. [`fit`] optimises splats to photos with
//! either of the last two.

pub mod camera;
pub mod constants;
pub mod cpu;
pub mod error;
pub mod fit;
pub mod fit_device;
pub mod gpu;
pub mod io;
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
