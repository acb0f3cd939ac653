// adam_colors: one optimizer step of all colors by gradients of their own; in fits colors wait
// (waiting_colors.wgsl). Follows adam_update.wgsl.

@group(0) @binding(0) var<uniform> view: View;
@group(0) @binding(1) var<uniform> step: Step;
@group(0) @binding(2) var<uniform> window: Window;
@group(0) @binding(3) var<storage, read_write> colors: array<f32>;
@group(0) @binding(4) var<storage, read> v_colors: array<f32>;
@group(0) @binding(5) var<storage, read_write> first: array<f32>;
@group(0) @binding(6) var<storage, read_write> second: array<f32>;

// One thread per float.
@compute @workgroup_size(256)
fn adam_colors(
    @builtin(workgroup_id) workgroup: vec3<u32>,
    @builtin(num_workgroups) groups: vec3<u32>,
    @builtin(local_invocation_index) local: u32,
) {
    let at = linear_index(workgroup, groups, local, 256u);
    let floats = 3u * view.sh_stride;
    let used = 3u * (view.sh_degree + 1u) * (view.sh_degree + 1u);
    let within = at % floats;
    if at / floats >= window.count || within >= used || step.frozen == 1u {
        return;
    }
    let rate = select(step.sh_rest, step.sh0, within < 3u);
    colors[at] = updated(colors[at], at, v_colors[at], rate);
}
