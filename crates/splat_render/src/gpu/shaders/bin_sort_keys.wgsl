// Input of the sort: the splats by depth, whose first pass leaves culled ones out, or the pairs of a
// chunk. Follows shared.wgsl.

struct SortPass {
    // Lowest bit of the digit.
    shift: u32,
    // The chunk whose pairs are sorted, or ALL_SPLATS.
    chunk: u32,
    // 1 in the first pass over the splats, whose values are their indices.
    is_first: u32,
    // The set of sums of bin_sort_wide.wgsl.
    sum_set: u32,
}

const ALL_SPLATS = 0xffffffffu;

@group(0) @binding(0) var<uniform> pass_: SortPass;
@group(0) @binding(1) var<storage, read_write> status: Status;

var<workgroup> key_count: u32;

// The number of keys. Same for all threads of a workgroup, which a compiler cannot prove otherwise.
fn same_for_all(local: u32) -> u32 {
    if local == 0u {
        if pass_.chunk != ALL_SPLATS {
            key_count = status.chunks[pass_.chunk].pairs;
        } else if pass_.is_first == 1u {
            key_count = status.splats;
        } else {
            key_count = status.visible;
        }
    }
    return workgroupUniformLoad(&key_count);
}

fn is_sorted(key: u32) -> bool {
    return pass_.is_first == 0u || key != CULLED_KEY;
}

fn value_of(i: u32, value: u32) -> u32 {
    return select(value, i, pass_.is_first == 1u);
}

// The number of keys that the first pass has not left out.
fn note_count(sorted: u32) {
    if pass_.is_first == 1u {
        status.visible = sorted;
    }
}
