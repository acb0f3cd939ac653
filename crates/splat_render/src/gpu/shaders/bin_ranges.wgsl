// bin_ranges: the start of each tile's pairs in the sorted list, and the splat of each pair. Follows
// shared.wgsl.

@group(0) @binding(0) var<uniform> chunk: Chunk;
@group(0) @binding(1) var<storage, read> status: Status;
@group(0) @binding(2) var<storage, read> keys: array<u32>;
@group(0) @binding(3) var<storage, read> slot_from_pair: array<u32>;
@group(0) @binding(4) var<storage, read> splat_from_slot: array<u32>;
@group(0) @binding(5) var<storage, read_write> splat_from_pair: array<u32>;
// Tiles of the chunk + 2; the last is the number of pairs, including those after all tiles.
@group(0) @binding(6) var<storage, read_write> tile_begin: array<u32>;

@compute @workgroup_size(64)
fn ranges(
    @builtin(workgroup_id) workgroup: vec3<u32>,
    @builtin(num_workgroups) groups: vec3<u32>,
    @builtin(local_invocation_index) local: u32,
) {
    let pairs = status.chunks[chunk.index].pairs;
    let tiles = chunk.tile_end - chunk.tile_begin;
    for (var i = workgroup.x * 64u + local; i <= pairs; i += groups.x * 64u) {
        var previous = 0u;
        if i > 0u {
            previous = keys[i - 1u] + 1u;
        }
        if i == pairs {
            tile_begin[tiles + 1u] = pairs;
        }
        var last = tiles;
        if i < pairs {
            last = keys[i];
            splat_from_pair[i] = splat_from_slot[slot_from_pair[i]];
        }
        for (var tile = previous; tile <= last; tile++) {
            tile_begin[tile] = i;
        }
    }
}
