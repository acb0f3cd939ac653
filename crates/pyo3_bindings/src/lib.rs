//! The Python module `igsr._core`: numpy arrays in, numpy arrays out.
//!
//! Arrays are C-contiguous. They are float32, and float64 for the backend "reference". A wrong argument
//! raises a ValueError whose message begins with the argument's name; a missing or unknown one raises a
//! TypeError. `_core.pyi` describes every function.

mod arguments;
mod arrays;
mod backend;
mod benchmark;
mod camera;
mod depth_maps;
mod error;
mod example_files;
mod exr_files;
mod fit_settings;
mod fit_state;
mod fitter;
mod level_files;
mod photos;
mod splat_arrays;
mod splat_files;
mod stages;
mod viewer;

use pyo3::prelude::*;

#[pymodule]
mod _core {
    use pyo3::prelude::*;
    use splat_render::constants;

    #[pymodule_export]
    #[expect(non_upper_case_globals, reason = "Python's name for it")]
    const __version__: &str = env!("CARGO_PKG_VERSION");
    #[pymodule_init]
    fn init(module: &Bound<'_, PyModule>) -> PyResult<()> {
        // Its first use runs Python code, in which a signal would be a panic.
        module.py().import("numpy")?;
        numpy::PyArray1::<f32>::zeros(module.py(), 0, false);
        module.add("NEAR_PLANE", constants::NEAR)?;
        module.add("FAR_PLANE", constants::FAR)?;
        module.add("EPS2D", constants::BLUR)?;
        module.add("JACOBIAN_MARGIN", constants::JACOBIAN_MARGIN)?;
        module.add("ALPHA_MIN", constants::ALPHA_MIN)?;
        module.add("ALPHA_MAX", constants::ALPHA_MAX)?;
        module.add("TRANSMITTANCE_MIN", constants::TRANSMITTANCE_MIN)?;
        module.add("RIGID_TOLERANCE", constants::RIGID_TOLERANCE)?;
        module.add("TILE_SIZE", constants::TILE)?;
        module.add("SIDE_MAX", constants::SIDE_MAX)?;
        module.add("LEVELS_INDEX", splat_render::levels::INDEX)
    }
    #[pymodule_export]
    use crate::backend::{
        backend_info, gpu_report, inject_gpu_faults, lose_gpu, resolve_backend, time_gpu_start,
        working_dtype,
    };
    #[pymodule_export]
    use crate::benchmark::{band_pixels, peak_multiply_add, time_pipeline, time_rasterize};
    #[pymodule_export]
    use crate::depth_maps::depth_maps;
    #[pymodule_export]
    use crate::example_files::example_files;
    #[pymodule_export]
    use crate::exr_files::{read_exr_depth, write_exr};
    #[pymodule_export]
    use crate::fit_settings::reduction;
    #[pymodule_export]
    use crate::fitter::{Fitter, splats_from_points};
    #[pymodule_export]
    use crate::level_files::{read_level, write_levels};
    #[pymodule_export]
    use crate::splat_files::{
        camera_extent, morton_order, read_splats, splat_extent, write_splats,
    };
    #[pymodule_export]
    use crate::stages::{project, project_backward, rasterize, rasterize_backward};
    #[pymodule_export]
    use crate::viewer::run_viewer;
}
