//! The shaders' requirements, from naga's IR: within WebGPU's default limits, which every conformant
//! adapter has.

use std::collections::BTreeMap;

use naga::proc::Layouter;
use naga::{AddressSpace, Binding, ImageClass, TypeInner};
use splat_render::gpu::needed_limits;

use super::{Compiled, compiled};

/// Resources of one entry point, numbers by name; unused globals do not count.
fn used(shader: &Compiled) -> BTreeMap<&'static str, u32> {
    let mut layouter = Layouter::default();
    layouter.update(shader.module.to_ctx()).expect("layout");
    let mut uses = BTreeMap::new();
    let mut entries = shader.module.entry_points.iter().enumerate();
    let (index, entry) = entries
        .find(|(_, e)| e.name == shader.entry && e.stage == shader.stage)
        .expect("the entry point");
    let info = shader.info.get_entry_point(index);
    let mut raise = |what, by: u32, most: u32| {
        let value = uses.entry(what).or_insert(0);
        *value = (*value + by).max(most);
    };
    for (handle, variable) in shader.module.global_variables.iter() {
        if info[handle].is_empty() {
            continue;
        }
        if let Some(binding) = &variable.binding {
            raise("groups", 0, binding.group + 1);
            raise("bindings", 0, binding.binding + 1);
        }
        let bytes = layouter[variable.ty].size;
        match variable.space {
            AddressSpace::Storage { .. } => {
                raise("storage buffers", 1, 0);
                raise("bytes of fixed storage", 0, bytes);
            }
            AddressSpace::Uniform => {
                raise("uniform buffers", 1, 0);
                raise("bytes of a uniform", 0, bytes);
            }
            // As naga lays it out, each variable on a boundary of 16 bytes.
            AddressSpace::WorkGroup => raise("bytes of workgroup", bytes.next_multiple_of(16), 0),
            _ => match &shader.module.types[variable.ty].inner {
                TypeInner::Image { class, .. } => {
                    assert!(matches!(class, ImageClass::Sampled { .. }), "{}", shader.name);
                    raise("textures", 1, 0);
                }
                TypeInner::Sampler { .. } => raise("samplers", 1, 0),
                _ => {}
            },
        }
    }
    let [x, y, z] = entry.workgroup_size;
    raise("invocations", x * y * z, 0);
    for (side, value) in [("wide", x), ("high", y), ("deep", z)] {
        raise(side, value, 0);
    }
    if let Some(result) = &entry.function.result {
        let varyings = match &shader.module.types[result.ty].inner {
            TypeInner::Struct { members, .. } => members
                .iter()
                .filter(|m| matches!(m.binding, Some(Binding::Location { .. })))
                .count() as u32,
            _ => 1,
        };
        raise("varyings", varyings, 0);
    }
    uses
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
    let (limits, viewer) = (needed_limits(), limits);
    let bytes = |limit: u64| u32::try_from(limit).expect("a u32");
    let most = BTreeMap::from([
        ("storage buffers", limits.max_storage_buffers_per_shader_stage),
        ("uniform buffers", limits.max_uniform_buffers_per_shader_stage),
        ("textures", viewer.max_sampled_textures_per_shader_stage),
        ("samplers", viewer.max_samplers_per_shader_stage),
        ("bytes of workgroup", limits.max_compute_workgroup_storage_size),
        ("bytes of a uniform", bytes(limits.max_uniform_buffer_binding_size)),
        ("bytes of fixed storage", bytes(limits.max_storage_buffer_binding_size)),
        ("groups", limits.max_bind_groups),
        ("bindings", limits.max_bindings_per_bind_group),
        ("invocations", limits.max_compute_invocations_per_workgroup),
        ("wide", limits.max_compute_workgroup_size_x),
        ("high", limits.max_compute_workgroup_size_y),
        ("deep", limits.max_compute_workgroup_size_z),
        ("varyings", viewer.max_inter_stage_shader_variables),
    ]);
    for shader in compiled() {
        for (what, value) in used(&shader) {
            let limit = most[what];
            assert!(value <= limit, "{}: {value} {what}, the limit is {limit}", shader.name);
        }
    }
}
