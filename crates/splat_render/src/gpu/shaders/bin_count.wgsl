// bin_count: depth keys of the splats, and the number of tiles that each touches. Follows
// shared.wgsl and bin_tiles.wgsl.

@group(0) @binding(0) var<uniform> view: View;
@group(0) @binding(1) var<uniform> chunk: Chunk;
@group(0) @binding(2) var<storage, read> splats2d: array<Splat2d>;
@group(0) @binding(3) var<storage, read_write> keys: array<u32>;
@group(0) @binding(4) var<storage, read_write> order: array<u32>;
@group(0) @binding(5) var<storage, read_write> counts: array<u32>;

// Culled splats go last.
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
    let bits = bitcast<u32>(splats2d[i].depth);
    // Order of the bits as that of the floats, negative ones included.
    let ordered = bits ^ select(0x80000000u, 0xffffffffu, (bits >> 31u) == 1u);
    keys[i] = select(ordered, 0xffffffffu, all(splats2d[i].radii == vec2(0.0)));
    order[i] = i;
}

// counts[rank] for the splat at that rank of the depth order.
@compute @workgroup_size(256)
fn tile_counts(
    @builtin(workgroup_id) workgroup: vec3<u32>,
    @builtin(num_workgroups) groups: vec3<u32>,
    @builtin(local_invocation_index) local: u32,
) {
    let rank = linear_index(workgroup, groups, local, 256u);
    if rank >= chunk.splats {
        return;
    }
    let f = footprint(splats2d[order[rank]]);
    let rows = chunk_rows(f);
    var count = 0u;
    for (var row = rows.x; row < rows.y; row++) {
        let span = chunk_columns(f, row);
        if span.x < span.y {
            count += span.y - span.x;
        }
    }
    counts[rank] = count;
}
