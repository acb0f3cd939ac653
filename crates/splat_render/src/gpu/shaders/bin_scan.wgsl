// bin_scan: exclusive prefix sums of the tile counts, in two passes over a fixed number of
// contiguous segments, so that no workgroup waits for another. Follows shared.wgsl.

@group(0) @binding(0) var<uniform> chunk: Chunk;
// An entry for each splat in the depth order, and one more that becomes the total.
@group(0) @binding(1) var<storage, read_write> offsets: array<u32>;
@group(0) @binding(2) var<storage, read_write> segment_sums: array<u32>;
@group(0) @binding(3) var<storage, read_write> status: Status;
// Workgroups of the dispatches that follow: of 64 splats in the depth order each, and of 64 splats of
// all each, none once a chunk's pairs did not fit.
@group(0) @binding(4) var<storage, read_write> dispatches: array<u32, 6>;

override SEGMENTS: u32 = 64u;
const THREADS = 64u;

var<workgroup> sums: array<u32, THREADS>;

// Saturates: 1 M splats on 1 M tiles would not fit 32 bits.
fn add(a: u32, b: u32) -> u32 {
    return select(a + b, 0xffffffffu, a + b < a);
}

// The part of the segment that a thread owns.
fn own_range(segment: u32, local: u32) -> vec2<u32> {
    let per_thread = (status.visible + SEGMENTS * THREADS - 1u) / (SEGMENTS * THREADS);
    let begin = min((segment * THREADS + local) * per_thread, status.visible);
    return vec2(begin, min(begin + per_thread, status.visible));
}

// Workgroups for `splats` splats; they spill into y past the limit of x.
fn groups_of(splats: u32) -> vec3<u32> {
    let groups = max((splats + 63u) / 64u, 1u);
    let x = min(groups, chunk.groups_max);
    return vec3(x, (groups + x - 1u) / x, 1u);
}

fn own_sum(range: vec2<u32>) -> u32 {
    var sum = 0u;
    for (var i = range.x; i < range.y; i++) {
        sum = add(sum, offsets[i]);
    }
    return sum;
}

@compute @workgroup_size(THREADS)
fn scan_sums(
    @builtin(workgroup_id) workgroup: vec3<u32>,
    @builtin(local_invocation_index) local: u32,
) {
    sums[local] = own_sum(own_range(workgroup.x, local));
    workgroupBarrier();
    if local == 0u {
        var sum = 0u;
        for (var i = 0u; i < THREADS; i++) {
            sum = add(sum, sums[i]);
        }
        segment_sums[workgroup.x] = sum;
    }
}

@compute @workgroup_size(THREADS)
fn scan_apply(
    @builtin(workgroup_id) workgroup: vec3<u32>,
    @builtin(local_invocation_index) local: u32,
) {
    let range = own_range(workgroup.x, local);
    sums[local] = own_sum(range);
    workgroupBarrier();
    var sum = 0u;
    for (var i = 0u; i < workgroup.x; i++) {
        sum = add(sum, segment_sums[i]);
    }
    for (var i = 0u; i < local; i++) {
        sum = add(sum, sums[i]);
    }
    for (var i = range.x; i < range.y; i++) {
        let count = offsets[i];
        offsets[i] = sum;
        sum = add(sum, count);
    }
    if workgroup.x == SEGMENTS - 1u && local == THREADS - 1u {
        offsets[status.visible] = sum;
        let fits = sum <= chunk.capacity;
        status.chunks[chunk.index].total = sum;
        status.chunks[chunk.index].pairs = select(0u, sum, fits);
        if !fits && status.overflow == 0u {
            status.overflow = status.step;
        }
        let seen = groups_of(status.visible);
        let all = select(vec3(0u), groups_of(chunk.splats), status.overflow == 0u);
        dispatches[0] = seen.x;
        dispatches[1] = seen.y;
        dispatches[2] = seen.z;
        dispatches[3] = all.x;
        dispatches[4] = all.y;
        dispatches[5] = all.z;
    }
}
