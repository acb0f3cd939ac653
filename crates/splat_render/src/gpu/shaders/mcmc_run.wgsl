// Uniforms of a run of MCMC's density control. Follows shared.wgsl.

struct Run {
    // Splats before the run; the next field is the number to add.
    splats: u32,
    fresh: u32,
    seed: u32,
    // 0: dead splats move. 1: the number grows.
    round: u32,
    cameras: u32,
    // Stride of the sample.
    every: u32,
    color_floats: u32,
    // Always 0, for rounded.
    zero: u32,
}

@group(0) @binding(0) var<uniform> run: Run;

// The bin of a logit in tables.
fn logit_bin(logit: f32) -> u32 {
    return u32(clamp((logit - LOGIT_FIRST) * BINS_PER_LOGIT, 0.0, f32(BINS - 1u)));
}
