// adam: one optimiser step of all parameters, the exploration noise, and what density control
// watches. Does nothing once a chunk's pairs did not fit, so that the step can be done again.
// Follows shared.wgsl.

@group(0) @binding(0) var<uniform> view: View;
@group(0) @binding(1) var<uniform> step: Step;
@group(0) @binding(2) var<uniform> window: Window;
@group(0) @binding(3) var<storage, read> status: Status;
// Geometry in adam_geometry, colours in adam_colors; so are the three that follow.
@group(0) @binding(4) var<storage, read_write> values: array<f32>;
@group(0) @binding(5) var<storage, read> gradient: array<f32>;
@group(0) @binding(6) var<storage, read_write> first: array<f32>;
@group(0) @binding(7) var<storage, read_write> second: array<f32>;
@group(0) @binding(8) var<storage, read> splats2d: array<Splat2d>;
@group(0) @binding(9) var<storage, read> v_splats2d: array<f32>;
// STATS floats per splat: sum of gradient lengths, steps seen.
@group(0) @binding(10) var<storage, read_write> stats: array<f32>;

fn update(at: u32, g: f32, rate: f32) {
    let m = ADAM_BETA1 * first[at] + (1.0 - ADAM_BETA1) * g;
    let v = ADAM_BETA2 * second[at] + (1.0 - ADAM_BETA2) * g * g;
    first[at] = m;
    second[at] = v;
    values[at] -= rate * (m * step.bias_first) / (sqrt(v * step.bias_second) + ADAM_EPSILON);
}

// In (0, 1].
fn unit(h: u32) -> f32 {
    return (f32(h >> 8u) + 1.0) * (1.0 / 16777216.0);
}

// As noise_normal in fit_device/random.rs.
fn noise_normal(index: u32) -> vec3<f32> {
    let base = hash(index ^ hash(step.noise_seed));
    let r0 = sqrt(-2.0 * log(unit(hash(base))));
    let r1 = sqrt(-2.0 * log(unit(hash(base + 2u))));
    let a0 = 6.2831855 * unit(hash(base + 1u));
    let a1 = 6.2831855 * unit(hash(base + 3u));
    return vec3(r0 * cos(a0), r0 * sin(a0), r1 * cos(a1));
}

// 3DGS-MCMC's exploration: nearly transparent splats take a random step shaped by their covariance.
fn explore(i: u32, at: u32) {
    let opacity = 1.0 / (1.0 + exp_accurate(-values[at + 10u]));
    let gate = 1.0 / (1.0 + exp_accurate(-100.0 * (0.005 - opacity)));
    let quat = vec4(values[at + 6u], values[at + 7u], values[at + 8u], values[at + 9u]);
    let norm2 = dot(quat, quat);
    if gate < 1e-7 || norm2 < QUAT_NORM2_MIN {
        return;
    }
    let unit_quat = quat / sqrt(norm2);
    let w = unit_quat.x;
    let x = unit_quat.y;
    let y = unit_quat.z;
    let z = unit_quat.w;
    let axes = mat3x3(
        vec3(1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y + w * z), 2.0 * (x * z - w * y)),
        vec3(2.0 * (x * y - w * z), 1.0 - 2.0 * (x * x + z * z), 2.0 * (y * z + w * x)),
        vec3(2.0 * (x * z + w * y), 2.0 * (y * z - w * x), 1.0 - 2.0 * (x * x + y * y)),
    );
    let scales = vec3(
        exp_accurate(values[at + 3u]),
        exp_accurate(values[at + 4u]),
        exp_accurate(values[at + 5u]),
    );
    let draw = noise_normal(window.first + i);
    let moved = axes * (scales * scales * (draw * axes)) * (gate * step.noise);
    let mean = vec3(values[at], values[at + 1u], values[at + 2u]) + moved;
    if is_finite3(mean) {
        values[at] = mean.x;
        values[at + 1u] = mean.y;
        values[at + 2u] = mean.z;
    }
}

@compute @workgroup_size(64)
fn adam_geometry(
    @builtin(workgroup_id) workgroup: vec3<u32>,
    @builtin(num_workgroups) groups: vec3<u32>,
    @builtin(local_invocation_index) local: u32,
) {
    let i = linear_index(workgroup, groups, local, 64u);
    if i >= window.count || status.overflow != 0u {
        return;
    }
    if any(splats2d[i].radii != vec2(0.0)) {
        let size = vec2(f32(view.width), f32(view.height));
        let v_mean = vec2(v_splats2d[i * GRADIENT], v_splats2d[i * GRADIENT + 1u]);
        stats[i * STATS] += length(0.5 * size * v_mean);
        stats[i * STATS + 1u] += 1.0;
    }
    if step.frozen == 1u {
        return;
    }
    let at = i * GEOMETRY;
    // opacity (1 - opacity) without the cancellation that is 0 for logits over 17.
    let odds = exp_accurate(-abs(values[at + 10u]));
    let pull = step.opacity_pull * odds / ((1.0 + odds) * (1.0 + odds));
    for (var k = 0u; k < 3u; k++) {
        update(at + k, gradient[at + k], step.means);
    }
    for (var k = 3u; k < 6u; k++) {
        let pull = step.scale_pull * exp_accurate(values[at + k]);
        update(at + k, gradient[at + k] + pull, step.scales);
    }
    for (var k = 6u; k < 10u; k++) {
        update(at + k, gradient[at + k], step.quats);
    }
    update(at + 10u, gradient[at + 10u] + pull, step.opacities);
    if step.noise > 0.0 {
        explore(i, at);
    }
}

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
    let idle = status.overflow != 0u || step.frozen == 1u;
    if at >= window.count * floats || within >= used || idle {
        return;
    }
    update(at, gradient[at], select(step.sh_rest, step.sh0, within < 3u));
}
