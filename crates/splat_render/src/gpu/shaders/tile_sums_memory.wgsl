// Sums over the threads of a tile through workgroup memory, a batch of splats between two barriers.

// 60 sums occupy 32 threads almost twice.
const BATCH = 6u;
// One more than the threads, so that a column's entries lie in different memory banks.
const STRIDE = THREADS + 1u;

// [splat of the batch][entry][thread]
var<workgroup> partials: array<f32, BATCH * SUMS * STRIDE>;
var<workgroup> any_live: u32;

// Takes a thread's sum for entry `entry` of a batch's splat `b`.
fn keep_sum(b: u32, entry: u32, sum: f32, thread: u32) {
    partials[(b * SUMS + entry) * STRIDE + thread] = sum;
}

// Writes the sums of a batch to its slots; whether any thread is live.
fn write_sums(batch: u32, count: u32, live: bool, thread: u32) -> bool {
    if thread == 0u {
        any_live = 0u;
    }
    workgroupBarrier();
    if live {
        any_live = 1u;
    }
    let goes_on = workgroupUniformLoad(&any_live);
    for (var entry = thread; entry < count * SUMS; entry += THREADS) {
        var sum = 0.0;
        for (var k = 0u; k < THREADS; k++) {
            sum += partials[entry * STRIDE + k];
        }
        slots[slot_from_pair[batch + entry / SUMS] * SUMS + entry % SUMS] = sum;
    }
    workgroupBarrier();
    return goes_on == 1u;
}
