// Uniforms and flags of a run of the original density control. Follows shared.wgsl.

struct OriginalRun {
    splats: u32,
    color_floats: u32,
    // Splats that may be added, at most.
    room: u32,
    seed: u32,
    // Log scales above which splats are split, and removed.
    log_split: f32,
    log_huge: f32,
    // 1 if nothing is removed.
    keeps_all: u32,
    // Always 0, for rounded.
    zero: u32,
}

@group(0) @binding(0) var<uniform> run: OriginalRun;
@group(0) @binding(1) var<storage, read> geometry: array<f32>;

// Flags of a splat: finite and not faint; larger than cloned splats; grows.
const LIVES = 1u;
const LARGE = 2u;
const GROWS = 4u;
