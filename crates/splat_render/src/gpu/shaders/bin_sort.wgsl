// bin_sort: one pass of a stable radix sort by four bits, for software adapters. Every workgroup owns a contiguous
// segment: histogram per segment, one scan over all, scatter in order. No workgroup waits for
// another, and the result depends on nothing but the keys. Follows shared.wgsl and bin_sort_keys.wgsl.

@group(0) @binding(2) var<storage, read> keys_in: array<u32>;
@group(0) @binding(3) var<storage, read> values_in: array<u32>;
// [digit][segment]
@group(0) @binding(4) var<storage, read_write> histogram: array<u32>;
@group(0) @binding(5) var<storage, read_write> keys_out: array<u32>;
@group(0) @binding(6) var<storage, read_write> values_out: array<u32>;

override SEGMENTS: u32 = 64u;
const THREADS = 128u;
const KEYS_PER_THREAD = 8u;
const BLOCK = 1024u; // THREADS * KEYS_PER_THREAD
const DIGITS = 16u;

// [digit][thread]
var<workgroup> counts: array<u32, 2048>;
var<workgroup> group_sums: array<u32, THREADS>;
var<workgroup> bases: array<u32, DIGITS>;

// Whole blocks, so that only the last segment has a ragged end.
fn segment_range(count: u32, segment: u32) -> vec2<u32> {
    let blocks = (count + BLOCK - 1u) / BLOCK;
    let size = (blocks + SEGMENTS - 1u) / SEGMENTS * BLOCK;
    return vec2(min(segment * size, count), min((segment + 1u) * size, count));
}

fn digit(key: u32) -> u32 {
    return (key >> pass_.shift) & (DIGITS - 1u);
}

fn clear_counts(local: u32) {
    for (var d = 0u; d < DIGITS; d++) {
        counts[d * THREADS + local] = 0u;
    }
}

@compute @workgroup_size(THREADS)
fn sort_histogram(
    @builtin(workgroup_id) workgroup: vec3<u32>,
    @builtin(local_invocation_index) local: u32,
) {
    let range = segment_range(same_for_all(local), workgroup.x);
    clear_counts(local);
    for (var i = range.x + local; i < range.y; i += THREADS) {
        let key = keys_in[i];
        if is_sorted(key) {
            counts[digit(key) * THREADS + local] += 1u;
        }
    }
    workgroupBarrier();
    if local < DIGITS {
        var sum = 0u;
        for (var i = 0u; i < THREADS; i++) {
            sum += counts[local * THREADS + i];
        }
        histogram[local * SEGMENTS + workgroup.x] = sum;
    }
}

// One workgroup: the histogram becomes its exclusive prefix sums.
@compute @workgroup_size(THREADS)
fn sort_scan(@builtin(local_invocation_index) local: u32) {
    let per_thread = (DIGITS * SEGMENTS + THREADS - 1u) / THREADS;
    let begin = min(local * per_thread, DIGITS * SEGMENTS);
    let end = min(begin + per_thread, DIGITS * SEGMENTS);
    var sum = 0u;
    for (var i = begin; i < end; i++) {
        sum += histogram[i];
    }
    group_sums[local] = sum;
    workgroupBarrier();
    var prefix = 0u;
    for (var i = 0u; i < local; i++) {
        prefix += group_sums[i];
    }
    for (var i = begin; i < end; i++) {
        let count = histogram[i];
        histogram[i] = prefix;
        prefix += count;
    }
    if local == THREADS - 1u {
        note_count(prefix);
    }
}

@compute @workgroup_size(THREADS)
fn sort_scatter(
    @builtin(workgroup_id) workgroup: vec3<u32>,
    @builtin(local_invocation_index) local: u32,
) {
    let range = segment_range(same_for_all(local), workgroup.x);
    if local < DIGITS {
        bases[local] = histogram[local * SEGMENTS + workgroup.x];
    }
    // Each thread owns a run of the block, so that runs in thread order are in key order.
    for (var block = range.x; block < range.y; block += BLOCK) {
        let begin = min(block + local * KEYS_PER_THREAD, range.y);
        let end = min(begin + KEYS_PER_THREAD, range.y);
        clear_counts(local);
        for (var i = begin; i < end; i++) {
            let key = keys_in[i];
            if is_sorted(key) {
                counts[digit(key) * THREADS + local] += 1u;
            }
        }
        workgroupBarrier();
        // Exclusive prefix over the threads, digit by digit: eight threads per digit, sixteen
        // entries each, then the sums of the eight.
        var sum = 0u;
        for (var i = local * 16u; i < local * 16u + 16u; i++) {
            let count = counts[i];
            counts[i] = sum;
            sum += count;
        }
        group_sums[local] = sum;
        workgroupBarrier();
        var total = 0u;
        if local < DIGITS {
            for (var i = local * 8u; i < local * 8u + 8u; i++) {
                let count = group_sums[i];
                group_sums[i] = total;
                total += count;
            }
        }
        workgroupBarrier();
        for (var i = begin; i < end; i++) {
            let key = keys_in[i];
            if is_sorted(key) {
                let d = digit(key);
                let own = d * THREADS + local;
                let at = bases[d] + group_sums[own / 16u] + counts[own];
                counts[own] += 1u;
                keys_out[at] = key;
                values_out[at] = value_of(i, values_in[i]);
            }
        }
        workgroupBarrier();
        if local < DIGITS {
            bases[local] += total;
        }
        // The next round reads `bases` only after further barriers, but clears `counts` at once.
    }
}
