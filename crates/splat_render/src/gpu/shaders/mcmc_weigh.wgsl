// MCMC's density control, first part: finds fog and dead splats and weighs the rest. Matches
// fit_device/mcmc.rs and fit_device/fog.rs bit for bit. Follows shared.wgsl and mcmc_run.wgsl.

@group(0) @binding(1) var<storage, read_write> geometry: array<f32>;
// SH coefficients, 3 floats each.
@group(0) @binding(2) var<storage, read> colors: array<f32>;
@group(0) @binding(3) var<storage, read> cameras: array<FogCamera>;
// Weight of a living splat, by the bin of its logit.
@group(0) @binding(4) var<storage, read> table: array<u32>;
// Weights, 0 of the dead. In `sample`, centers of the sampled splats.
@group(0) @binding(5) var<storage, read_write> words: array<u32>;

struct FogCamera {
    rows: array<vec4<f32>, 3>,
    focal: vec2<f32>,
    principal: vec2<f32>,
    size: vec2<f32>,
    nearest: f32,
    unused: f32,
}

// Centers of every `run.every` splats.
@compute @workgroup_size(64)
fn mcmc_sample(
    @builtin(workgroup_id) workgroup: vec3<u32>,
    @builtin(num_workgroups) groups: vec3<u32>,
    @builtin(local_invocation_index) local: u32,
) {
    let k = linear_index(workgroup, groups, local, 64u);
    let i = k * run.every;
    if i >= run.splats {
        return;
    }
    words[3u * k] = bitcast<u32>(geometry[i * GEOMETRY]);
    words[3u * k + 1u] = bitcast<u32>(geometry[i * GEOMETRY + 1u]);
    words[3u * k + 2u] = bitcast<u32>(geometry[i * GEOMETRY + 2u]);
}

fn times(a: f32, b: f32) -> f32 {
    return rounded(a * b, run.zero);
}

fn plus(a: f32, b: f32) -> f32 {
    return rounded(a + b, run.zero);
}

// As exp_accurate, with the same bits on every device.
fn exp_of_rounded(x: f32) -> f32 {
    let y = clamp(x, -87.0, 88.0);
    let k = floor(plus(times(y, 1.44269504), 0.5));
    let r = plus(plus(y, -times(k, 0.693359375)), times(k, 2.12194440e-4));
    var poly = 1.9875691500e-4;
    poly = plus(times(poly, r), 1.3981999507e-3);
    poly = plus(times(poly, r), 8.3334519073e-3);
    poly = plus(times(poly, r), 4.1665795894e-2);
    poly = plus(times(poly, r), 1.6666665459e-1);
    poly = plus(times(poly, r), 5.0000001201e-1);
    let sum = plus(plus(times(times(poly, r), r), r), 1.0);
    return times(sum, bitcast<f32>((i32(k) + 127) << 23u));
}

fn camera_row(camera: u32, row: u32, x: f32, y: f32, z: f32) -> f32 {
    let r = cameras[camera].rows[row];
    return plus(plus(plus(times(r.x, x), times(r.y, y)), times(r.z, z)), r.w);
}

fn shows(u: f32, depth: f32, focal: f32, principal: f32, size: f32, radius: f32) -> bool {
    let middle = plus(times(focal, u), times(principal, depth));
    let wide = times(focal, radius);
    return plus(middle, wide) >= 0.0 && plus(middle, -wide) <= times(size, depth);
}

fn is_fog(at: u32) -> bool {
    let x = geometry[at];
    let y = geometry[at + 1u];
    let z = geometry[at + 2u];
    let largest = max(max(geometry[at + 3u], geometry[at + 4u]), geometry[at + 5u]);
    let radius = times(3.0, exp_of_rounded(largest));
    var fog = false;
    for (var k = 0u; k < run.cameras && !fog; k++) {
        let depth = camera_row(k, 2u, x, y, z);
        if depth > 0.0 && depth < cameras[k].nearest {
            let u = camera_row(k, 0u, x, y, z);
            let v = camera_row(k, 1u, x, y, z);
            let focal = cameras[k].focal;
            let principal = cameras[k].principal;
            let size = cameras[k].size;
            fog = shows(u, depth, focal.x, principal.x, size.x, radius)
                && shows(v, depth, focal.y, principal.y, size.y, radius);
        }
    }
    return fog;
}

@compute @workgroup_size(64)
fn mcmc_weigh(
    @builtin(workgroup_id) workgroup: vec3<u32>,
    @builtin(num_workgroups) groups: vec3<u32>,
    @builtin(local_invocation_index) local: u32,
) {
    let i = linear_index(workgroup, groups, local, 64u);
    if i >= run.splats {
        return;
    }
    let at = i * GEOMETRY;
    var finite = true;
    for (var k = 0u; k < GEOMETRY; k++) {
        finite = finite && is_finite(geometry[at + k]);
    }
    // Splats that are not finite die anyway.
    if run.round == 0u && finite {
        if is_fog(at) {
            geometry[at + 10u] = LOGIT_FOG;
        }
        for (var k = 0u; k < run.color_floats; k++) {
            finite = finite && is_finite(colors[i * run.color_floats + k]);
        }
    }
    let logit = geometry[at + 10u];
    var weight = 0u;
    if finite && logit > LOGIT_DEAD {
        weight = table[logit_bin(logit)];
    }
    words[i] = weight;
}
