// Adam's step of one number. Follows shared.wgsl; the file that follows declares `step`, `first` and
// `second`.

fn updated(value: f32, at: u32, g: f32, rate: f32) -> f32 {
    let m = ADAM_BETA1 * first[at] + (1.0 - ADAM_BETA1) * g;
    let v = ADAM_BETA2 * second[at] + (1.0 - ADAM_BETA2) * g * g;
    first[at] = m;
    second[at] = v;
    return value - rate * (m * step.bias_first) / (sqrt(v * step.bias_second) + ADAM_EPSILON);
}
