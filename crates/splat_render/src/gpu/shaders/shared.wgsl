// Structs and functions that several stages share. The constants that precede this text are
// written from constants.rs and sh.rs; layout.rs holds the Rust twins of the structs.

// A camera, the picture's background and how colors and parameters are stored.
struct View {
    // Rows of the world-to-camera matrix.
    world_to_camera: array<vec4<f32>, 3>,
    // Limits of x/z and y/z in the Jacobian: x low, x high, y low, y high.
    jacobian_limits: vec4<f32>,
    focal: vec2<f32>,
    principal: vec2<f32>,
    background: vec3<f32>,
    near: f32,
    far: f32,
    blur: f32,
    width: u32,
    height: u32,
    tiles_x: u32,
    sh_degree: u32,
    // Stored coefficients per splat, 0 for direct colors.
    sh_stride: u32,
    // 1 if scales are logarithms and opacities logits.
    raw: u32,
    // 1 if opacities are lowered to compensate for the area that the blur adds.
    antialiased: u32,
    // Splats with a hash below the threshold are dropped (0 for none); the remaining opacities are
    // multiplied by the compensation. Matches is_dropped in fit_device/random.rs.
    dropout_threshold: u32,
    dropout_seed: u32,
    compensation: f32,
}

// The splats of one dispatch; per-splat bindings begin at `first`.
struct Window {
    first: u32,
    count: u32,
    // Workgroups in a row of the dispatch, at most.
    groups_max: u32,
}

// The tiles of one dispatch (ids in row-major order) and the index of their counts.
struct Chunk {
    tile_begin: u32,
    tile_end: u32,
    // Pairs the buffers can hold.
    capacity: u32,
    splats: u32,
    // The chunk's entry in `Status.chunks`.
    index: u32,
    // 1 for the first and the last chunk of a picture.
    is_first: u32,
    is_last: u32,
    // The part of every tile's list that a dispatch of the rasterize kernels walks.
    list_begin: u32,
    list_end: u32,
    // Workgroups in a row of a dispatch, at most.
    groups_max: u32,
}

// Counts that only the device knows.
struct ChunkCount {
    // Pairs in the buffers: the total, or 0 if it does not fit.
    pairs: u32,
    // Pairs the chunk has, saturating.
    total: u32,
}

struct Status {
    splats: u32,
    // Number of the step at hand, from 1.
    step: u32,
    // The first step at which a chunk's pairs did not fit; stops every later update. 0 for none.
    overflow: u32,
    // Splats in the depth order: the visible ones, or all.
    visible: u32,
    chunks: array<ChunkCount>,
}

// Settings of one step of a fit.
struct Step {
    // Adam's rates, then its bias corrections.
    means: f32,
    quats: f32,
    scales: f32,
    opacities: f32,
    sh0: f32,
    sh_rest: f32,
    bias_first: f32,
    bias_second: f32,
    // Gradients of the regularizers by one opacity and one scale.
    opacity_pull: f32,
    scale_pull: f32,
    noise: f32,
    noise_seed: u32,
    // Weights of one unit of |x - y| and of SSIM in the loss.
    l1: f32,
    ssim: f32,
    has_weights: u32,
    // 1 if no parameter and no moment moves.
    frozen: u32,
    // Number of splats, from the first, that are moved; the rest are only drawn.
    moving: u32,
}

struct Splat2d {
    mean: vec2<f32>,
    // p and q of the conic's factor.
    pq: vec2<f32>,
    color: vec3<f32>,
    r: f32,
    depth: f32,
    opacity: f32,
    // (0, 0) if culled.
    radii: vec2<f32>,
}

// Key of culled splats, which the sort leaves out.
const CULLED_KEY = 0xffffffffu;

// Keys sort as depths do, negative ones included.
fn depth_key(depth: f32) -> u32 {
    let bits = bitcast<u32>(depth);
    return bits ^ select(0x80000000u, 0xffffffffu, (bits >> 31u) == 1u);
}

// WGSL lets a compiler assume that no float is NaN or infinite; tests on bits are safe.
fn is_finite(x: f32) -> bool {
    return (bitcast<u32>(x) & 0x7f800000u) != 0x7f800000u;
}

fn is_finite3(x: vec3<f32>) -> bool {
    return is_finite(x.x) && is_finite(x.y) && is_finite(x.z);
}

// exp to about 1e-7 relative: drivers may be off by 3 + 2|x| units in the last place, and the
// bound on pictures is tighter than that. Range reduction by ln 2 in two parts, degree-6 polynomial.
fn exp_accurate(x: f32) -> f32 {
    let y = clamp(x, -87.0, 88.0);
    let k = floor(y * 1.44269504 + 0.5);
    let r = (y - k * 0.693359375) + k * 2.12194440e-4;
    var poly = 1.9875691500e-4;
    poly = poly * r + 1.3981999507e-3;
    poly = poly * r + 8.3334519073e-3;
    poly = poly * r + 4.1665795894e-2;
    poly = poly * r + 1.6666665459e-1;
    poly = poly * r + 5.0000001201e-1;
    return ((poly * r * r + r) + 1.0) * bitcast<f32>((i32(k) + 127) << 23u);
}

// exp_accurate of four values in [-80, 0].
fn exp_accurate4(x: vec4<f32>) -> vec4<f32> {
    let k = floor(x * 1.44269504 + 0.5);
    let r = (x - k * 0.693359375) + k * 2.12194440e-4;
    var poly = vec4(1.9875691500e-4);
    poly = poly * r + 1.3981999507e-3;
    poly = poly * r + 8.3334519073e-3;
    poly = poly * r + 4.1665795894e-2;
    poly = poly * r + 1.6666665459e-1;
    poly = poly * r + 5.0000001201e-1;
    return ((poly * r * r + r) + 1.0) * bitcast<vec4<f32>>((vec4<i32>(k) + 127) << vec4(23u));
}

// Rounds the result of one operation before the next uses it, for results that must match bit for bit.
// WGSL lets a compiler fuse a product with a sum (NVIDIA's does) and reorder sums (Mesa's does). `zero`
// comes from a uniform and is always 0, which no compiler can know.
fn rounded(x: f32, zero: u32) -> f32 {
    return bitcast<f32>(bitcast<u32>(x) ^ zero);
}

// The index of an invocation in a dispatch whose workgroups may spill into y.
fn linear_index(workgroup: vec3<u32>, groups: vec3<u32>, local: u32, size: u32) -> u32 {
    return (workgroup.y * groups.x + workgroup.x) * size + local;
}

// The same if the number of workgroups is known only on the device (DX12 does not expose it): rows of a
// dispatch have `groups_max` workgroups if there is more than one row.
fn indirect_index(workgroup: vec3<u32>, groups_max: u32, local: u32, size: u32) -> u32 {
    return (workgroup.y * groups_max + workgroup.x) * size + local;
}

// PCG's output function on one word.
fn hash(x: u32) -> u32 {
    let state = x * 747796405u + 2891336453u;
    let word = ((state >> ((state >> 28u) + 4u)) ^ state) * 277803737u;
    return (word >> 22u) ^ word;
}
