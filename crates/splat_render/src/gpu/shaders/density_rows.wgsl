// Density control: rows of one array put in order, one thread per float. Follows shared.wgsl.

struct Rows {
    splats: u32,
    floats: u32,
    // 0: rows in order. 1: colors, gathered by `rows`. 2: moments, gathered or zero.
    kind: u32,
    unused: u32,
}

@group(0) @binding(0) var<uniform> array_: Rows;
@group(0) @binding(1) var<storage, read> order: array<u32>;
@group(0) @binding(2) var<storage, read> rows: array<u32>;
@group(0) @binding(3) var<storage, read> old: array<f32>;
@group(0) @binding(4) var<storage, read_write> new_: array<f32>;

@compute @workgroup_size(256)
fn density_rows(
    @builtin(workgroup_id) workgroup: vec3<u32>,
    @builtin(num_workgroups) groups: vec3<u32>,
    @builtin(local_invocation_index) local: u32,
) {
    let at = linear_index(workgroup, groups, local, 256u);
    let k = at / array_.floats;
    if k >= array_.splats {
        return;
    }
    let i = order[k];
    let row = rows[i];
    var from_row = i;
    if array_.kind != 0u {
        from_row = row >> 1u;
    }
    var value = 0.0;
    if array_.kind != 2u || (row & 1u) == 0u {
        value = old[from_row * array_.floats + at % array_.floats];
    }
    new_[at] = value;
}
