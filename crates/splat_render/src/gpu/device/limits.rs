//! Required limits of an adapter, and the error message for too low ones.

use crate::error::{Error, Result};

/// Limits that the kernels need, all within WebGPU's defaults. A test compares them with the kernels.
pub fn needed_limits() -> wgpu::Limits {
    wgpu::Limits {
        max_storage_buffers_per_shader_stage: 8,
        max_uniform_buffers_per_shader_stage: 3,
        max_compute_workgroup_storage_size: 14_200,
        max_compute_invocations_per_workgroup: 256,
        max_compute_workgroup_size_x: 256,
        max_compute_workgroup_size_y: 1,
        max_compute_workgroup_size_z: 1,
        max_compute_workgroups_per_dimension: 4096,
        max_storage_buffer_binding_size: 16 << 20,
        max_buffer_size: 16 << 20,
        ..wgpu::Limits::downlevel_webgl2_defaults()
    }
}

pub(super) fn check_limits(name: &str, offered: &wgpu::Limits) -> Result<()> {
    let mut short = Vec::new();
    needed_limits().check_limits_with_fail_fn(offered, false, |limit, needed, has| {
        short.push(format!("{limit} is {has}, but igsr needs {needed}"));
    });
    if short.is_empty() {
        return Ok(());
    }
    Err(Error::Device(format!(
        "backend gpu: {name} cannot run the kernels: {}; update its driver or use backend cpu",
        short.join(", ")
    )))
}
