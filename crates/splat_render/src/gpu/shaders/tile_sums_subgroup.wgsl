// Sums over a tile that is one subgroup: thread b writes the sums of a batch's splat b.

const BATCH = AHEAD;

var<private> kept: array<f32, SUMS>;

// Takes a thread's sum for entry `entry` of a batch's splat `b`.
fn keep_sum(b: u32, entry: u32, sum: f32, thread: u32) {
    let all = subgroupAdd(sum);
    if thread == b {
        kept[entry] = all;
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
