// adam_colors: one optimiser step of all colours, and what density control watches. Does nothing once a
// chunk's pairs did not fit, so that the step can be done again. Follows adam_update.wgsl.

@group(0) @binding(0) var<uniform> view: View;
@group(0) @binding(1) var<uniform> step: Step;
@group(0) @binding(2) var<uniform> window: Window;
@group(0) @binding(3) var<storage, read> status: Status;
@group(0) @binding(4) var<storage, read_write> colors: array<f32>;
// Rows of splats that are not culled; the others' are nothing.
@group(0) @binding(5) var<storage, read> v_colors: array<f32>;
@group(0) @binding(6) var<storage, read_write> first: array<f32>;
@group(0) @binding(7) var<storage, read_write> second: array<f32>;
@group(0) @binding(8) var<storage, read> splats2d: array<Splat2d>;
@group(0) @binding(9) var<storage, read> v_splats2d: array<f32>;
// STATS floats per splat: sum of gradient lengths, steps seen.
@group(0) @binding(10) var<storage, read_write> stats: array<f32>;

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
    let i = at / floats;
    let within = at % floats;
    let moves = i < window.count && window.first + i < step.moving;
    if !moves || within >= used || status.overflow != 0u {
        return;
    }
    let is_seen = splats2d[i].radii.x > 0.0;
    if within == 0u && is_seen {
        let size = vec2(f32(view.width), f32(view.height));
        let v_mean = vec2(v_splats2d[i * GRADIENT], v_splats2d[i * GRADIENT + 1u]);
        stats[i * STATS] += length(0.5 * size * v_mean);
        stats[i * STATS + 1u] += 1.0;
    }
    if step.frozen == 1u {
        return;
    }
    var g = 0.0;
    if is_seen {
        g = v_colors[at];
    }
    colors[at] = updated(colors[at], at, g, select(step.sh_rest, step.sh0, within < 3u));
}
