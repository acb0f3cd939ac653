// Sharing a tile's splats among its threads, on any device: each thread reads every splat from storage
// (staging them in workgroup memory was slower). tile_subgroup.wgsl is the alternative.

// Pairs that are read at once.
const AHEAD = 1u;

fn read_ahead(pair: u32, end: u32, thread: u32) -> Splat2d {
    return splats2d[splat_from_pair[pair]];
}

fn splat_of(ahead: Splat2d, k: u32) -> Splat2d {
    return ahead;
}

// Whether a thread has to walk on.
fn walks_on(live: bool) -> bool {
    return live;
}
