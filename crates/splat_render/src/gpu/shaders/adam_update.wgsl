// Adam's step of one number whose moments lie in buffers. Follows adam_step.wgsl; the file that follows
// declares `step`, `first` and `second`.

fn updated(value: f32, at: u32, g: f32, rate: f32) -> f32 {
    let bias = vec2(step.bias_first, step.bias_second);
    let state = adam_step(vec3(value, first[at], second[at]), g, rate, bias);
    first[at] = state.y;
    second[at] = state.z;
    return state.x;
}
