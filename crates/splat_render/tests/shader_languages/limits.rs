//! The shaders' requirements, from naga's IR: within WebGPU's default limits, which every conformant
//! adapter has.

use naga::proc::Layouter;
use naga::{AddressSpace, Binding, ImageClass, TypeInner};

use splat_render::gpu::needed_limits;

use super::{Compiled, compiled};

struct Use {
    storage_buffers: u32,
    uniform_buffers: u32,
    textures: u32,
    samplers: u32,
    workgroup_bytes: u32,
    largest_uniform: u32,
    largest_storage: u32,
    highest_group: u32,
    highest_binding: u32,
}

/// Of one entry point; globals that it does not touch do not count.
fn used(shader: &Compiled) -> Use {
    let mut layouter = Layouter::default();
    layouter.update(shader.module.to_ctx()).expect("layout");
    let mut out = Use {
        storage_buffers: 0,
        uniform_buffers: 0,
        textures: 0,
        samplers: 0,
        workgroup_bytes: 0,
        largest_uniform: 0,
        largest_storage: 0,
        highest_group: 0,
        highest_binding: 0,
    };
    let index = shader
        .module
        .entry_points
        .iter()
        .position(|e| e.name == shader.entry && e.stage == shader.stage)
        .expect("the entry point");
    let info = shader.info.get_entry_point(index);
    for (handle, variable) in shader.module.global_variables.iter() {
        if info[handle].is_empty() {
            continue;
        }
        if let Some(binding) = &variable.binding {
            out.highest_group = out.highest_group.max(binding.group);
            out.highest_binding = out.highest_binding.max(binding.binding);
        }
        let bytes = layouter[variable.ty].size;
        match variable.space {
            AddressSpace::Storage { .. } => {
                out.storage_buffers += 1;
                out.largest_storage = out.largest_storage.max(bytes);
            }
            AddressSpace::Uniform => {
                out.uniform_buffers += 1;
                out.largest_uniform = out.largest_uniform.max(bytes);
            }
            // As naga lays it out, each variable on a boundary of 16 bytes.
            AddressSpace::WorkGroup => out.workgroup_bytes += bytes.next_multiple_of(16),
            _ => match &shader.module.types[variable.ty].inner {
                TypeInner::Image { class, .. } => {
                    assert!(matches!(class, ImageClass::Sampled { .. }), "{}", shader.name);
                    out.textures += 1;
                }
                TypeInner::Sampler { .. } => out.samplers += 1,
                _ => {}
            },
        }
    }
    out
}

#[test]
fn shaders_ask_for_no_more_than_the_default_limits() {
    let limits = wgpu::Limits::default();
    // The documented limits, in case wgpu raises its defaults.
    assert!(limits.max_storage_buffers_per_shader_stage <= 8);
    assert!(limits.max_compute_workgroup_storage_size <= 16 << 10);
    assert!(limits.max_compute_invocations_per_workgroup <= 256);
    assert!(limits.max_storage_buffer_binding_size <= 128 << 20);
    assert!(needed_limits().check_limits(&limits));
    // The kernels' needs equal the limits for refusal; the viewer requests its textures itself.
    let limits = needed_limits();
    let textures = wgpu::Limits::default();
    for shader in compiled() {
        let name = &shader.name;
        let uses = used(&shader);
        let at_most = |what: &str, value: u32, limit: u32| {
            assert!(value <= limit, "{name}: {value} {what}, the limit is {limit}");
        };
        let bindings = u32::try_from(limits.max_storage_buffer_binding_size).expect("a u32");
        let uniform = u32::try_from(limits.max_uniform_buffer_binding_size).expect("a u32");
        at_most(
            "storage buffers",
            uses.storage_buffers,
            limits.max_storage_buffers_per_shader_stage,
        );
        at_most(
            "uniform buffers",
            uses.uniform_buffers,
            limits.max_uniform_buffers_per_shader_stage,
        );
        at_most("textures", uses.textures, textures.max_sampled_textures_per_shader_stage);
        at_most("samplers", uses.samplers, textures.max_samplers_per_shader_stage);
        at_most(
            "bytes of workgroup",
            uses.workgroup_bytes,
            limits.max_compute_workgroup_storage_size,
        );
        at_most("bytes of a uniform", uses.largest_uniform, uniform);
        at_most("bytes of fixed storage", uses.largest_storage, bindings);
        at_most("as a group", uses.highest_group + 1, limits.max_bind_groups);
        at_most("as a binding", uses.highest_binding + 1, limits.max_bindings_per_bind_group);

        let entry = shader.module.entry_points.iter().find(|e| e.name == shader.entry);
        let entry = entry.expect("the entry point");
        let [x, y, z] = entry.workgroup_size;
        at_most("invocations", x * y * z, limits.max_compute_invocations_per_workgroup);
        at_most("wide", x, limits.max_compute_workgroup_size_x);
        at_most("high", y, limits.max_compute_workgroup_size_y);
        at_most("deep", z, limits.max_compute_workgroup_size_z);
        let varyings = entry.function.result.iter().map(|result| {
            match &shader.module.types[result.ty].inner {
                TypeInner::Struct { members, .. } => members
                    .iter()
                    .filter(|m| matches!(m.binding, Some(Binding::Location { .. })))
                    .count() as u32,
                _ => 1,
            }
        });
        at_most("varyings", varyings.sum(), textures.max_inter_stage_shader_variables);
    }
}
