// Adam's step of one number: its new value, first and second moments. Follows shared.wgsl.

fn adam_step(state: vec3<f32>, g: f32, rate: f32, bias: vec2<f32>) -> vec3<f32> {
    let m = ADAM_BETA1 * state.y + (1.0 - ADAM_BETA1) * g;
    let v = ADAM_BETA2 * state.z + (1.0 - ADAM_BETA2) * g * g;
    let value = state.x - rate * (m * bias.x) / (sqrt(v * bias.y) + ADAM_EPSILON);
    return vec3(value, m, v);
}
