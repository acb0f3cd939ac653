// adam_geometry: a separate optimizer step of means, scales, quaternions and opacities; fits use
// fit_geometry. Follows adam_geometry.wgsl.

@group(0) @binding(0) var<uniform> step: Step;
@group(0) @binding(1) var<uniform> window: Window;
@group(0) @binding(2) var<storage, read_write> geometry: array<f32>;
@group(0) @binding(3) var<storage, read> gradient: array<f32>;
@group(0) @binding(4) var<storage, read_write> first: array<f32>;
@group(0) @binding(5) var<storage, read_write> second: array<f32>;

@compute @workgroup_size(64)
fn adam_geometry(
    @builtin(workgroup_id) workgroup: vec3<u32>,
    @builtin(num_workgroups) groups: vec3<u32>,
    @builtin(local_invocation_index) local: u32,
) {
    let i = linear_index(workgroup, groups, local, 64u);
    if i >= window.count || step.frozen == 1u {
        return;
    }
    var v: array<f32, GEOMETRY>;
    for (var k = 0u; k < GEOMETRY; k++) {
        v[k] = gradient[i * GEOMETRY + k];
    }
    adam_of_geometry(i, v);
}
