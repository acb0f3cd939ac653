// bin_scan: exclusive prefix sums of the tile counts, whose sums by segments bin_count has made. Follows
// shared.wgsl and bin_segments.wgsl.

@group(0) @binding(0) var<uniform> chunk: Chunk;
// An entry for each splat in the depth order, and one more that becomes the total.
@group(0) @binding(1) var<storage, read_write> offsets: array<u32>;
@group(0) @binding(2) var<storage, read> segment_sums: array<u32>;
@group(0) @binding(3) var<storage, read_write> status: Status;
// Workgroups of the dispatches that follow: of 64 splats in the depth order each, and of 64 splats of
// all each, none once a chunk's pairs did not fit. Then two indirect draws, for viewers: of a quad for
// each splat if the pairs do not fit, and of a triangle if they do.
@group(0) @binding(4) var<storage, read_write> dispatches: array<u32, 14>;

const THREADS = 64u;

var<workgroup> sums: array<u32, THREADS>;

// Workgroups for `splats` splats; they spill into y past the limit of x.
fn groups_of(splats: u32) -> vec3<u32> {
    let groups = max((splats + 63u) / 64u, 1u);
    let x = min(groups, chunk.groups_max);
    return vec3(x, (groups + x - 1u) / x, 1u);
}

@compute @workgroup_size(THREADS)
fn scan_apply(
    @builtin(workgroup_id) workgroup: vec3<u32>,
    @builtin(local_invocation_index) local: u32,
) {
    let range = ranks(workgroup.x, local, THREADS);
    var sum = 0u;
    for (var i = range.x; i < range.y; i++) {
        sum = add(sum, offsets[i]);
    }
    sums[local] = sum;
    workgroupBarrier();
    sum = 0u;
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
        dispatches[6] = 4u;
        dispatches[7] = select(status.visible, 0u, fits);
        dispatches[8] = 0u;
        dispatches[9] = 0u;
        dispatches[10] = 3u;
        dispatches[11] = select(0u, 1u, fits);
        dispatches[12] = 0u;
        dispatches[13] = 0u;
    }
}
