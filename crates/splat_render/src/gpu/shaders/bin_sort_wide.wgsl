// bin_sort: one pass of a stable radix sort by eight bits, in two dispatches over contiguous segments.
// The first counts digits; the second adds up the counts of earlier segments and scatters 256 keys at a
// time: a thread's place within its digit is the number of lower bits in the digit's mask. No workgroup
// waits for another, and the result depends only on the keys. Follows shared.wgsl and bin_sort_keys.wgsl.

@group(0) @binding(2) var<storage, read> keys_in: array<u32>;
@group(0) @binding(3) var<storage, read> values_in: array<u32>;
// Rows of a count for each digit: one for each segment, then three sets of sums, of 8 and of 64 segments. A
// pass adds to one set and clears the rest. A sort has two passes or more; the first uses set 0, the last
// set 2, so that no two passes in a row share a set.
@group(0) @binding(4) var<storage, read_write> histogram: array<atomic<u32>>;
@group(0) @binding(5) var<storage, read_write> keys_out: array<u32>;
@group(0) @binding(6) var<storage, read_write> values_out: array<u32>;

override SEGMENTS: u32 = 64u;
const THREADS = 256u; // one for each digit
const WORDS = 8u; // THREADS / 32
const EIGHTS = 32u; // of 256 segments; SUM_ROWS has four of 64, too

// [digit][word]: which threads have the digit.
var<workgroup> masks: array<atomic<u32>, 2048>;
var<workgroup> counts: array<atomic<u32>, THREADS>;
var<workgroup> bases: array<u32, THREADS>;

// Whole blocks, so that only the last segment has a ragged end.
fn segment_range(count: u32, segment: u32) -> vec2<u32> {
    let blocks = (count + THREADS - 1u) / THREADS;
    let size = (blocks + SEGMENTS - 1u) / SEGMENTS * THREADS;
    return vec2(min(segment * size, count), min((segment + 1u) * size, count));
}

fn row(at: u32, digit: u32) -> u32 {
    return atomicLoad(&histogram[at * THREADS + digit]);
}

fn digit(key: u32) -> u32 {
    return (key >> pass_.shift) & 255u;
}

@compute @workgroup_size(THREADS)
fn sort_count(
    @builtin(workgroup_id) workgroup: vec3<u32>,
    @builtin(local_invocation_index) local: u32,
) {
    let range = segment_range(same_for_all(local), workgroup.x);
    let sums = SEGMENTS + pass_.sum_set * SUM_ROWS;
    let other = SEGMENTS + workgroup.x;
    if workgroup.x < 3u * SUM_ROWS && (other < sums || other >= sums + SUM_ROWS) {
        atomicStore(&histogram[other * THREADS + local], 0u);
    }
    // Segments without keys are the last, and no segment reads them.
    if range.x >= range.y {
        return;
    }
    atomicStore(&counts[local], 0u);
    workgroupBarrier();
    for (var i = range.x + local; i < range.y; i += THREADS) {
        let key = keys_in[i];
        if is_sorted(key) {
            atomicAdd(&counts[digit(key)], 1u);
        }
    }
    workgroupBarrier();
    let count = atomicLoad(&counts[local]);
    atomicStore(&histogram[workgroup.x * THREADS + local], count);
    if count > 0u {
        atomicAdd(&histogram[(sums + workgroup.x / 8u) * THREADS + local], count);
        atomicAdd(&histogram[(sums + EIGHTS + workgroup.x / 64u) * THREADS + local], count);
    }
}

@compute @workgroup_size(THREADS)
fn sort_place(
    @builtin(workgroup_id) workgroup: vec3<u32>,
    @builtin(local_invocation_index) local: u32,
) {
    let range = segment_range(same_for_all(local), workgroup.x);
    // The first notes the number of keys, be it 0.
    if workgroup.x > 0u && range.x >= range.y {
        return;
    }
    var before = 0u;
    var total = 0u;
    let eights = SEGMENTS + pass_.sum_set * SUM_ROWS;
    for (var many = 0u; many < SUM_ROWS - EIGHTS; many++) {
        let count = row(eights + EIGHTS + many, local);
        before += select(0u, count, many < workgroup.x / 64u);
        total += count;
    }
    for (var eight = workgroup.x / 64u * 8u; eight < workgroup.x / 8u; eight++) {
        before += row(eights + eight, local);
    }
    for (var segment = workgroup.x / 8u * 8u; segment < workgroup.x; segment++) {
        before += row(segment, local);
    }
    bases[local] = total;
    for (var word = 0u; word < WORDS; word++) {
        atomicStore(&masks[word * THREADS + local], 0u);
    }
    workgroupBarrier();
    // Inclusive prefix over the digits.
    var sum = total;
    for (var offset = 1u; offset < THREADS; offset *= 2u) {
        if local >= offset {
            sum += bases[local - offset];
        }
        workgroupBarrier();
        bases[local] = sum;
        workgroupBarrier();
    }
    if workgroup.x == 0u && local == THREADS - 1u {
        note_count(sum);
    }
    bases[local] = sum - total + before;
    workgroupBarrier();
    let word = local / 32u;
    let bit = 1u << (local % 32u);
    for (var block = range.x; block < range.y; block += THREADS) {
        let i = block + local;
        var key = 0u;
        var takes_part = false;
        if i < range.y {
            key = keys_in[i];
            takes_part = is_sorted(key);
        }
        let d = digit(key);
        if takes_part {
            atomicOr(&masks[d * WORDS + word], bit);
        }
        workgroupBarrier();
        var place = 0u;
        var all = 0u;
        if takes_part {
            for (var k = 0u; k < WORDS; k++) {
                let mask = atomicLoad(&masks[d * WORDS + k]);
                let earlier = select(select(0u, bit - 1u, k == word), 0xffffffffu, k < word);
                place += countOneBits(mask & earlier);
                all += countOneBits(mask);
            }
            let at = bases[d] + place;
            keys_out[at] = key;
            values_out[at] = value_of(i, values_in[i]);
        }
        workgroupBarrier();
        if takes_part {
            atomicStore(&masks[d * WORDS + word], 0u);
            if place + 1u == all {
                bases[d] += all;
            }
        }
        workgroupBarrier();
    }
}
