// Density control, last part: splats along Morton's curve. As fit_device/cell_order.rs, bit for bit.
// Follows shared.wgsl.

struct Cells {
    low: vec3<f32>,
    splats: u32,
    scale: vec3<f32>,
    // 0: the lower halves of the codes, in the order of the splats. 1: the upper, in `order`.
    upper: u32,
}

@group(0) @binding(0) var<uniform> cells: Cells;
@group(0) @binding(1) var<storage, read> geometry: array<f32>;
@group(0) @binding(2) var<storage, read> order: array<u32>;
// Keys of the sort. In density_bounds, of each workgroup: bits of the low corner and of the high one.
@group(0) @binding(3) var<storage, read_write> words: array<u32>;

const THREADS = 64u;
const GROUPS = 64u;

var<workgroup> corners: array<f32, 384>; // THREADS * 6

fn bits_or(low: vec3<f32>, high: vec3<f32>, k: u32) -> f32 {
    var out = low.x;
    if k == 1u {
        out = low.y;
    }
    if k == 2u {
        out = low.z;
    }
    if k == 3u {
        out = high.x;
    }
    if k == 4u {
        out = high.y;
    }
    if k == 5u {
        out = high.z;
    }
    return out;
}

// The box of the finite centers, a part for each workgroup.
@compute @workgroup_size(THREADS)
fn density_bounds(
    @builtin(workgroup_id) workgroup: vec3<u32>,
    @builtin(local_invocation_index) local: u32,
) {
    var low = vec3(bitcast<f32>(0x7f7fffffu));
    var high = -low;
    for (var i = workgroup.x * THREADS + local; i < cells.splats; i += GROUPS * THREADS) {
        let at = i * GEOMETRY;
        let mean = vec3(geometry[at], geometry[at + 1u], geometry[at + 2u]);
        if is_finite3(mean) {
            low = min(low, mean);
            high = max(high, mean);
        }
    }
    for (var k = 0u; k < 6u; k++) {
        corners[local * 6u + k] = bits_or(low, high, k);
    }
    workgroupBarrier();
    if local < 6u {
        var corner = corners[local];
        for (var k = 1u; k < THREADS; k++) {
            let other = corners[k * 6u + local];
            corner = select(max(corner, other), min(corner, other), local < 3u);
        }
        words[workgroup.x * 6u + local] = bitcast<u32>(corner);
    }
}

fn cell(point: f32, low: f32, scale: f32) -> u32 {
    // `upper` is 0 or 1, so the second argument of rounded is 0.
    let place = rounded(point - low, cells.upper >> 1u) * scale;
    if !is_finite(place) {
        return 0u;
    }
    return u32(clamp(place, 0.0, f32(CELLS - 1u)));
}

// Ten bits, each at the third place after the one before.
fn spread(x: u32) -> u32 {
    var out = 0u;
    for (var bit = 0u; bit < 10u; bit++) {
        out |= ((x >> bit) & 1u) << (3u * bit);
    }
    return out;
}

@compute @workgroup_size(64)
fn density_codes(
    @builtin(workgroup_id) workgroup: vec3<u32>,
    @builtin(num_workgroups) groups: vec3<u32>,
    @builtin(local_invocation_index) local: u32,
) {
    let k = linear_index(workgroup, groups, local, 64u);
    if k >= cells.splats {
        return;
    }
    var i = k;
    if cells.upper == 1u {
        i = order[k];
    }
    let at = i * GEOMETRY;
    let shift = 10u * cells.upper;
    let x = cell(geometry[at], cells.low.x, cells.scale.x) >> shift;
    let y = cell(geometry[at + 1u], cells.low.y, cells.scale.y) >> shift;
    let z = cell(geometry[at + 2u], cells.low.z, cells.scale.z) >> shift;
    words[k] = spread(x) | (spread(y) << 1u) | (spread(z) << 2u);
}
