// Sums over the threads of a tile where they are one subgroup: thread b keeps those of a batch's
// splat b and writes them.

const BATCH = AHEAD;

var<private> kept: array<f32, SUMS>;

fn keep_sums(b: u32, sums: array<f32, SUMS>, thread: u32) {
    var own = sums;
    for (var entry = 0u; entry < SUMS; entry++) {
        let sum = subgroupAdd(own[entry]);
        if thread == b {
            kept[entry] = sum;
        }
    }
}

// Writes the sums of a batch to its slots; whether any thread is live.
fn write_sums(batch: u32, count: u32, live: bool, thread: u32) -> bool {
    if thread < count {
        let slot = slot_from_pair[batch + thread] * SUMS;
        for (var entry = 0u; entry < SUMS; entry++) {
            slots[slot + entry] = kept[entry];
        }
    }
    return subgroupAny(live);
}
