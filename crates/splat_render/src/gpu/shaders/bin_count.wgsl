// bin_count: depth keys of splats that were projected before, and the number of tiles that each
// touches. Follows shared.wgsl, bin_tiles.wgsl and bin_segments.wgsl.

@group(0) @binding(0) var<uniform> view: View;
@group(0) @binding(1) var<uniform> chunk: Chunk;
@group(0) @binding(2) var<storage, read> splats2d: array<Splat2d>;
@group(0) @binding(3) var<storage, read> status: Status;
@group(0) @binding(4) var<storage, read> order: array<u32>;
// Keys in depth_keys, counts in tile_counts.
@group(0) @binding(5) var<storage, read_write> words: array<u32>;
@group(0) @binding(6) var<storage, read_write> segment_sums: array<u32>;

var<workgroup> sums: array<u32, 256>;

@compute @workgroup_size(256)
fn depth_keys(
    @builtin(workgroup_id) workgroup: vec3<u32>,
    @builtin(num_workgroups) groups: vec3<u32>,
    @builtin(local_invocation_index) local: u32,
) {
    let i = linear_index(workgroup, groups, local, 256u);
    if i >= chunk.splats {
        return;
    }
    words[i] = select(depth_key(splats2d[i].depth), CULLED_KEY, all(splats2d[i].radii == vec2(0.0)));
}

// words[rank] for the splat at that rank of the depth order, and the sum of each segment.
@compute @workgroup_size(256)
fn tile_counts(
    @builtin(workgroup_id) workgroup: vec3<u32>,
    @builtin(local_invocation_index) local: u32,
) {
    let segment = ranks(workgroup.x, 0u, 1u);
    var sum = 0u;
    for (var rank = segment.x + local; rank < segment.y; rank += 256u) {
        let f = footprint(splats2d[order[rank]]);
        let rows = chunk_rows(f);
        var count = 0u;
        for (var row = rows.x; row < rows.y; row++) {
            let span = chunk_columns(f, row);
            if span.x < span.y {
                count += span.y - span.x;
            }
        }
        words[rank] = count;
        sum = add(sum, count);
    }
    sums[local] = sum;
    workgroupBarrier();
    if local < 16u {
        for (var i = local + 16u; i < 256u; i += 16u) {
            sum = add(sum, sums[i]);
        }
        sums[local] = sum;
    }
    workgroupBarrier();
    if local == 0u {
        for (var i = 1u; i < 16u; i++) {
            sum = add(sum, sums[i]);
        }
        segment_sums[workgroup.x] = sum;
    }
}
