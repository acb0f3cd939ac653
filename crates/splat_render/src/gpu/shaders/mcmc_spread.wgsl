// MCMC's density control, second part: dead splats, and added ones at the end, become copies of splats
// drawn by weight, and all copies share opacity and size. Colors and moments move only in the final sort;
// `rows` keeps their sources. Matches fit_device/mcmc.rs bit for bit. Follows shared.wgsl and
// mcmc_run.wgsl.

@group(0) @binding(1) var<storage, read_write> geometry: array<f32>;
@group(0) @binding(2) var<storage, read> weight_sums: array<u32>;
@group(0) @binding(3) var<storage, read> dead: array<u32>;
// Sum of weights, number of dead, of each round.
@group(0) @binding(4) var<storage, read> totals: array<vec2<u32>, 2>;
@group(0) @binding(5) var<storage, read_write> copies: array<atomic<u32>>;
@group(0) @binding(6) var<storage, read_write> sources: array<u32>;
// Twice the row of a splat's colors, plus 1 if its moments become zero.
@group(0) @binding(7) var<storage, read_write> rows: array<u32>;
// Changes of logit and log scales, by the bin of the logit and the number of shares from 2 on.
@group(0) @binding(8) var<storage, read> shares: array<vec2<f32>>;

// Number of splats that become copies; 0 if there is nothing to copy.
fn target_count() -> u32 {
    if totals[run.round].x == 0u {
        return 0u;
    }
    if run.round == 0u {
        return totals[0].y;
    }
    return run.fresh;
}

// The upper half of the product.
fn multiply_high(a: u32, b: u32) -> u32 {
    let a_low = a & 0xffffu;
    let a_high = a >> 16u;
    let b_low = b & 0xffffu;
    let b_high = b >> 16u;
    let low = a_low * b_low;
    let first = a_high * b_low + (low >> 16u);
    let second = a_low * b_high + (first & 0xffffu);
    return a_high * b_high + (first >> 16u) + (second >> 16u);
}

@compute @workgroup_size(64)
fn mcmc_start(
    @builtin(workgroup_id) workgroup: vec3<u32>,
    @builtin(num_workgroups) groups: vec3<u32>,
    @builtin(local_invocation_index) local: u32,
) {
    let i = linear_index(workgroup, groups, local, 64u);
    if i < run.splats + run.fresh {
        atomicStore(&copies[i], 0u);
        rows[i] = 2u * i;
    }
}

@compute @workgroup_size(64)
fn mcmc_draw(
    @builtin(workgroup_id) workgroup: vec3<u32>,
    @builtin(num_workgroups) groups: vec3<u32>,
    @builtin(local_invocation_index) local: u32,
) {
    let k = linear_index(workgroup, groups, local, 64u);
    if k >= target_count() {
        return;
    }
    let at = multiply_high(hash(k ^ hash(run.seed ^ run.round)), totals[run.round].x);
    // The first whose sum is above.
    var begin = 0u;
    var end = run.splats;
    for (var halving = 0u; halving < 32u && begin < end; halving++) {
        let middle = (begin + end) / 2u;
        if weight_sums[middle] <= at {
            begin = middle + 1u;
        } else {
            end = middle;
        }
    }
    sources[k] = begin;
    atomicAdd(&copies[begin], 1u);
}

@compute @workgroup_size(64)
fn mcmc_share(
    @builtin(workgroup_id) workgroup: vec3<u32>,
    @builtin(num_workgroups) groups: vec3<u32>,
    @builtin(local_invocation_index) local: u32,
) {
    let i = linear_index(workgroup, groups, local, 64u);
    if i >= run.splats {
        return;
    }
    let count = atomicLoad(&copies[i]);
    if count == 0u {
        return;
    }
    atomicStore(&copies[i], 0u);
    let at = i * GEOMETRY;
    let logit = geometry[at + 10u];
    let row = logit_bin(logit) * (SHARES_MAX - 1u) + min(count + 1u, SHARES_MAX) - 2u;
    let added = shares[row];
    geometry[at + 10u] = max(logit + added.x, LOGIT_DEAD);
    geometry[at + 3u] += added.y;
    geometry[at + 4u] += added.y;
    geometry[at + 5u] += added.y;
    rows[i] |= 1u;
}

@compute @workgroup_size(64)
fn mcmc_copy(
    @builtin(workgroup_id) workgroup: vec3<u32>,
    @builtin(num_workgroups) groups: vec3<u32>,
    @builtin(local_invocation_index) local: u32,
) {
    let k = linear_index(workgroup, groups, local, 64u);
    if k >= target_count() {
        return;
    }
    let source = sources[k];
    var to = run.splats + k;
    if run.round == 0u {
        to = dead[k];
    }
    for (var c = 0u; c < GEOMETRY; c++) {
        geometry[to * GEOMETRY + c] = geometry[source * GEOMETRY + c];
    }
    rows[to] = rows[source] | 1u;
}
