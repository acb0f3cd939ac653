// The original density control, first part: which splats grow and which are removed. As
// fit_device/original.rs, bit for bit. Follows shared.wgsl and original_run.wgsl.

@group(0) @binding(2) var<storage, read> colors: array<f32>;
// NOTES words per splat.
@group(0) @binding(3) var<storage, read> notes: array<f32>;
// Sort keys of the splats that want to grow, hardest pulled first; later 0 for splats that stay.
@group(0) @binding(4) var<storage, read_write> keys: array<u32>;
@group(0) @binding(5) var<storage, read> order: array<u32>;
@group(0) @binding(6) var<storage, read> status: Status;
@group(0) @binding(7) var<storage, read_write> flags: array<u32>;
// 0 for splats that stay and grow.
@group(0) @binding(8) var<storage, read_write> growing: array<u32>;

fn largest_scale(at: u32) -> f32 {
    return max(max(geometry[at + 3u], geometry[at + 4u]), geometry[at + 5u]);
}

fn pull(grad_sum: f32, seen: f32) -> u32 {
    if !is_finite(grad_sum) || !is_finite(seen) {
        return 0u;
    }
    let sum = u32(clamp(grad_sum, 0.0, PULL_SUM_MAX) * PULL_UNITS);
    return sum / u32(clamp(seen, 1.0, PULL_UNITS));
}

@compute @workgroup_size(64)
fn original_pull(
    @builtin(workgroup_id) workgroup: vec3<u32>,
    @builtin(num_workgroups) groups: vec3<u32>,
    @builtin(local_invocation_index) local: u32,
) {
    let i = linear_index(workgroup, groups, local, 64u);
    if i >= run.splats {
        return;
    }
    let at = i * GEOMETRY;
    var finite = true;
    for (var k = 0u; k < GEOMETRY; k++) {
        finite = finite && is_finite(geometry[at + k]);
    }
    for (var k = 0u; k < run.color_floats; k++) {
        finite = finite && is_finite(colors[i * run.color_floats + k]);
    }
    var bits = 0u;
    var key = CULLED_KEY;
    if finite {
        bits = select(0u, LIVES, geometry[at + 10u] > LOGIT_DEAD)
            | select(0u, LARGE, largest_scale(at) > run.log_split);
        let pulled = pull(notes[i * NOTES + NOTE_PULL], notes[i * NOTES + NOTE_SEEN]);
        key = select(CULLED_KEY, ~pulled, pulled > PULL_GROW);
    }
    flags[i] = bits;
    keys[i] = key;
}

// The first splats that want to grow, as far as room permits.
@compute @workgroup_size(64)
fn original_grow(
    @builtin(workgroup_id) workgroup: vec3<u32>,
    @builtin(num_workgroups) groups: vec3<u32>,
    @builtin(local_invocation_index) local: u32,
) {
    let rank = linear_index(workgroup, groups, local, 64u);
    if rank < min(status.visible, run.room) {
        flags[order[rank]] |= GROWS;
    }
}

@compute @workgroup_size(64)
fn original_keep(
    @builtin(workgroup_id) workgroup: vec3<u32>,
    @builtin(num_workgroups) groups: vec3<u32>,
    @builtin(local_invocation_index) local: u32,
) {
    let i = linear_index(workgroup, groups, local, 64u);
    if i >= run.splats {
        return;
    }
    let bits = flags[i];
    var largest = largest_scale(i * GEOMETRY);
    if (bits & (GROWS | LARGE)) == (GROWS | LARGE) {
        largest -= LOG_SPLIT_SHRINK;
    }
    // Both halves of a split and both clones have the same fate.
    let stays = run.keeps_all == 1u || ((bits & LIVES) != 0u && largest <= run.log_huge);
    keys[i] = select(1u, 0u, stays);
    growing[i] = select(1u, 0u, stays && (bits & GROWS) != 0u);
}
