// One optimizer step of a splat's mean, scales, quaternion and opacity, and the exploration noise.
// Follows adam_update.wgsl.

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
    let opacity = 1.0 / (1.0 + exp_accurate(-geometry[at + 10u]));
    let gate = 1.0 / (1.0 + exp_accurate(-100.0 * (0.005 - opacity)));
    let quat = vec4(geometry[at + 6u], geometry[at + 7u], geometry[at + 8u], geometry[at + 9u]);
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
        exp_accurate(geometry[at + 3u]),
        exp_accurate(geometry[at + 4u]),
        exp_accurate(geometry[at + 5u]),
    );
    let draw = noise_normal(window.first + i);
    let moved = axes * (scales * scales * (draw * axes)) * (gate * step.noise);
    let mean = vec3(geometry[at], geometry[at + 1u], geometry[at + 2u]) + moved;
    if is_finite3(mean) {
        geometry[at] = mean.x;
        geometry[at + 1u] = mean.y;
        geometry[at + 2u] = mean.z;
    }
}

fn adam_of_geometry(i: u32, gradient: array<f32, GEOMETRY>) {
    var v = gradient;
    let at = i * GEOMETRY;
    // opacity (1 - opacity) without the cancellation that is 0 for logits over 17.
    let odds = exp_accurate(-abs(geometry[at + 10u]));
    let pull = step.opacity_pull * odds / ((1.0 + odds) * (1.0 + odds));
    for (var k = 0u; k < 3u; k++) {
        geometry[at + k] = updated(geometry[at + k], at + k, v[k], step.means);
    }
    for (var k = 3u; k < 6u; k++) {
        let value = geometry[at + k];
        let pull = step.scale_pull * exp_accurate(value);
        geometry[at + k] = updated(value, at + k, v[k] + pull, step.scales);
    }
    for (var k = 6u; k < 10u; k++) {
        geometry[at + k] = updated(geometry[at + k], at + k, v[k], step.quats);
    }
    geometry[at + 10u] = updated(geometry[at + 10u], at + 10u, v[10] + pull, step.opacities);
    if step.noise > 0.0 {
        explore(i, at);
    }
}
