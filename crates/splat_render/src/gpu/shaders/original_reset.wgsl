// The original density control's reset: no opacity above a limit, moments of opacities restarted.
// As fit_device/original.rs, bit for bit. Follows shared.wgsl.

@group(0) @binding(0) var<uniform> window: Window;
@group(0) @binding(1) var<storage, read_write> geometry: array<f32>;
@group(0) @binding(2) var<storage, read_write> first: array<f32>;
@group(0) @binding(3) var<storage, read_write> second: array<f32>;

@compute @workgroup_size(64)
fn original_reset(
    @builtin(workgroup_id) workgroup: vec3<u32>,
    @builtin(num_workgroups) groups: vec3<u32>,
    @builtin(local_invocation_index) local: u32,
) {
    let i = linear_index(workgroup, groups, local, 64u);
    if i >= window.count {
        return;
    }
    let at = i * GEOMETRY + 10u;
    if is_finite(geometry[at]) {
        geometry[at] = min(geometry[at], LOGIT_RESET);
    }
    first[at] = 0.0;
    second[at] = 0.0;
}
