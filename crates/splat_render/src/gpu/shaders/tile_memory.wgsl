// Each thread of a tile reads every splat from storage: for any device (see tile_subgroup.wgsl).

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
