// bin_emit: one (tile, slot) pair for each tile that a splat touches, in depth order. A splat's
// slots are contiguous, so that its gradients can be summed there in a fixed order. Follows
// shared.wgsl and bin_tiles.wgsl.

@group(0) @binding(0) var<uniform> view: View;
@group(0) @binding(1) var<uniform> chunk: Chunk;
@group(0) @binding(2) var<storage, read> splats2d: array<Splat2d>;
@group(0) @binding(3) var<storage, read> status: Status;
@group(0) @binding(4) var<storage, read> order: array<u32>;
@group(0) @binding(5) var<storage, read> offsets: array<u32>;
// Tile ids relative to the chunk.
@group(0) @binding(6) var<storage, read_write> keys: array<u32>;
@group(0) @binding(7) var<storage, read_write> slots: array<u32>;
@group(0) @binding(8) var<storage, read_write> splat_from_slot: array<u32>;

@compute @workgroup_size(64)
fn emit(
    @builtin(workgroup_id) workgroup: vec3<u32>,
    @builtin(local_invocation_index) local: u32,
) {
    let rank = indirect_index(workgroup, chunk.groups_max, local, 64u);
    if rank >= status.visible || status.chunks[chunk.index].pairs == 0u {
        return;
    }
    var slot = offsets[rank];
    let end = offsets[rank + 1u];
    if slot == end {
        return;
    }
    let i = order[rank];
    let f = footprint(splats2d[i]);
    let rows = chunk_rows(f);
    for (var row = rows.x; row < rows.y; row++) {
        let span = chunk_columns(f, row);
        let row_begin = row * view.tiles_x - chunk.tile_begin;
        for (var column = span.x; column < span.y; column++) {
            // Two kernels may round the same expression differently; pairs that would overrun lie in the
            // margin and contribute nothing.
            if slot < end {
                keys[slot] = row_begin + column;
                slots[slot] = slot;
                splat_from_slot[slot] = i;
                slot++;
            }
        }
    }
    for (; slot < end; slot++) {
        // Behind all tiles: no tile reads it.
        keys[slot] = chunk.tile_end - chunk.tile_begin;
        slots[slot] = slot;
        splat_from_slot[slot] = i;
    }
}
