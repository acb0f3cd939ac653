// The part of its list that a workgroup of the rasterize kernels walks. Follows their bindings.

struct TileList {
    // Whether there is work: a tile, and a part of its list, which may be empty in the first dispatch.
    exists: bool,
    tile: u32,
    // Index of the tile in `tile_begin`.
    index: u32,
    // Pairs.
    begin: u32,
    end: u32,
    // Whether the list continues in the next dispatch.
    goes_on: bool,
}

fn tile_list(workgroup: vec3<u32>, groups: vec3<u32>) -> TileList {
    var out: TileList;
    out.index = workgroup.y * groups.x + workgroup.x;
    out.tile = chunk.tile_begin + out.index;
    if out.tile >= chunk.tile_end {
        return out;
    }
    let list = tile_begin[out.index];
    let length = tile_begin[out.index + 1u] - list;
    out.exists = chunk.list_begin == 0u || chunk.list_begin < length;
    out.begin = list + chunk.list_begin;
    out.end = list + min(chunk.list_end, length);
    out.goes_on = length > chunk.list_end;
    return out;
}
