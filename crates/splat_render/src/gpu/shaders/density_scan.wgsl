// Density control: sums of whole numbers, and which of them are zero. Follows shared.wgsl.

struct Scan {
    splats: u32,
    // Whose totals these are: 0 or 1.
    round: u32,
}

@group(0) @binding(0) var<uniform> scan: Scan;
// A number of each splat, then their inclusive sums.
@group(0) @binding(1) var<storage, read_write> words: array<u32>;
// Of each segment: sum, number of zeros.
@group(0) @binding(2) var<storage, read_write> segment_sums: array<vec2<u32>, SEGMENTS>;
// Splats whose number is zero, rising.
@group(0) @binding(3) var<storage, read_write> zeros: array<u32>;
// Sum, number of zeros, of each round.
@group(0) @binding(4) var<storage, read_write> totals: array<vec2<u32>, 2>;

const SEGMENTS = 256u;
const THREADS = 64u;

var<workgroup> sums: array<vec2<u32>, THREADS>;

// The part of the segment that a thread owns.
fn own_range(segment: u32, local: u32) -> vec2<u32> {
    let per_thread = (scan.splats + SEGMENTS * THREADS - 1u) / (SEGMENTS * THREADS);
    let begin = min((segment * THREADS + local) * per_thread, scan.splats);
    return vec2(begin, min(begin + per_thread, scan.splats));
}

fn own_sum(range: vec2<u32>) -> vec2<u32> {
    var sum = vec2(0u);
    for (var i = range.x; i < range.y; i++) {
        sum += vec2(words[i], u32(words[i] == 0u));
    }
    return sum;
}

@compute @workgroup_size(THREADS)
fn density_sums(
    @builtin(workgroup_id) workgroup: vec3<u32>,
    @builtin(local_invocation_index) local: u32,
) {
    sums[local] = own_sum(own_range(workgroup.x, local));
    workgroupBarrier();
    if local == 0u {
        var sum = vec2(0u);
        for (var k = 0u; k < THREADS; k++) {
            sum += sums[k];
        }
        segment_sums[workgroup.x] = sum;
    }
}

@compute @workgroup_size(THREADS)
fn density_prefix(
    @builtin(workgroup_id) workgroup: vec3<u32>,
    @builtin(local_invocation_index) local: u32,
) {
    let range = own_range(workgroup.x, local);
    sums[local] = own_sum(range);
    workgroupBarrier();
    var sum = vec2(0u);
    for (var k = 0u; k < workgroup.x; k++) {
        sum += segment_sums[k];
    }
    for (var k = 0u; k < local; k++) {
        sum += sums[k];
    }
    for (var i = range.x; i < range.y; i++) {
        let word = words[i];
        if word == 0u {
            zeros[sum.y] = i;
            sum.y += 1u;
        }
        sum.x += word;
        words[i] = sum.x;
    }
    if workgroup.x == SEGMENTS - 1u && local == THREADS - 1u {
        totals[scan.round] = sum;
    }
}
