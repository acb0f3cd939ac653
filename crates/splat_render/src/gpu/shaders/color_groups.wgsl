// Waiting colors on GPUs: the 64 threads of a workgroup update the rows of its 64 splats together, float by
// float, so that they read and write consecutive words. Same bits as color_rows.wgsl if a compiler fuses
// adam_step alike. Follows waiting_colors.wgsl; sh_color.wgsl follows.

const SPLATS = 64u;
// Most coefficients of one degree, and floats of them.
const WIDEST = 9u;
const STRIDE = 3u * WIDEST;

// Number of degrees to update, 0 if no splat is drawn.
var<workgroup> degrees: u32;
// Floats of one degree's coefficients, up to date.
var<workgroup> degree_rows: array<f32, SPLATS * STRIDE>;
// Their basis functions in the direction that the gradient was seen from.
var<workgroup> degree_basis: array<f32, SPLATS * WIDEST>;
var<workgroup> gradients: array<vec3<f32>, SPLATS>;
// 0 for splats that are not drawn; else 1, 2 if steps wait, 4 if the first has a gradient, and 8 times its
// number.
var<workgroup> states: array<u32, SPLATS>;

fn keep_basis(local: u32, k: u32, value: f32) {
    degree_basis[local * WIDEST + k] = value;
}

// Updates the `count` coefficients of a degree, from `from_k` on, of all splats. Rows of splats that are not
// drawn stay unwritten, and their colors are not used.
fn update_degree(i: u32, local: u32, from_k: u32, count: u32) {
    workgroupBarrier();
    let floats = 3u * count;
    for (var word = local; word < SPLATS * floats; word += SPLATS) {
        let splat = word / floats;
        let c = word % floats;
        let state = states[splat];
        if state != 0u {
            let at = 3u * ((i - local + splat) * mode.sh_stride + from_k) + c;
            var value = colors[at];
            if (state & 2u) != 0u {
                let has_gradient = (state & 4u) != 0u;
                var moved = vec3(value, first[at], second[at]);
                // Without a gradient, moments that are zero stay it, and move nothing.
                if has_gradient || ((bitcast<u32>(moved.y) | bitcast<u32>(moved.z)) != 0u) {
                    let v = gradients[splat];
                    let channel = c % 3u;
                    var g = 0.0;
                    if has_gradient {
                        g = degree_basis[splat * WIDEST + c / 3u]
                            * select(select(v.z, v.y, channel == 1u), v.x, channel == 0u);
                    }
                    for (var s = state >> 3u; s < waiting.count; s++) {
                        let step = waiting.steps[s];
                        let rate = select(step.y, step.x, from_k == 0u);
                        moved = adam_step(moved, g, rate, step.zw);
                        g = 0.0;
                    }
                    value = moved.x;
                    colors[at] = value;
                    first[at] = moved.y;
                    second[at] = moved.z;
                }
            }
            degree_rows[splat * STRIDE + c] = value;
        }
    }
    workgroupBarrier();
}

// The coefficient at WIDEST * splat + k, with k counted within the degree.
fn sh_coefficient(at: u32) -> vec3<f32> {
    return vec3(degree_rows[3u * at], degree_rows[3u * at + 1u], degree_rows[3u * at + 2u]);
}

// The color before the cut at zero of a splat that is drawn. All threads of a workgroup call it.
fn color_of(i: u32, local: u32, is_drawn: bool, direction: vec3<f32>) -> vec3<f32> {
    var direct = vec3(0.0);
    if is_drawn && mode.sh_stride == 0u {
        direct = coefficient(i);
    }
    var waits: Waiting;
    states[local] = 0u;
    if is_drawn && mode.sh_stride > 0u {
        waits = waiting_of(i);
        states[local] = 1u | select(0u, 2u, waits.moves) | select(0u, 4u, waits.has_gradient)
            | (waits.next << 3u);
        gradients[local] = waits.v_color;
    }
    if local == 0u {
        degrees = 0u;
    }
    workgroupBarrier();
    if states[local] != 0u {
        degrees = 1u + mode.sh_degree;
    }
    // The same for all threads, as a barrier in update_degree needs.
    let count = workgroupUniformLoad(&degrees);
    if count == 0u {
        return direct;
    }
    let old = waits.direction;
    let row = local * WIDEST;
    keep_basis(local, 0u, SH_C0);
    update_degree(i, local, 0u, 1u);
    var color = SH_C0 * sh_coefficient(row);
    if count > 1u {
        let terms = sh_degree_one(old);
        keep_basis(local, 0u, terms[0].value);
        keep_basis(local, 1u, terms[1].value);
        keep_basis(local, 2u, terms[2].value);
        update_degree(i, local, 1u, 3u);
        color = add_degree_one(color, direction, row);
    }
    if count > 2u {
        let terms = sh_degree_two(old);
        keep_basis(local, 0u, terms[0].value);
        keep_basis(local, 1u, terms[1].value);
        keep_basis(local, 2u, terms[2].value);
        keep_basis(local, 3u, terms[3].value);
        keep_basis(local, 4u, terms[4].value);
        update_degree(i, local, 4u, 5u);
        color = add_degree_two(color, direction, row);
    }
    if count > 3u {
        let terms = sh_degree_three(old);
        keep_basis(local, 0u, terms[0].value);
        keep_basis(local, 1u, terms[1].value);
        keep_basis(local, 2u, terms[2].value);
        keep_basis(local, 3u, terms[3].value);
        keep_basis(local, 4u, terms[4].value);
        keep_basis(local, 5u, terms[5].value);
        keep_basis(local, 6u, terms[6].value);
        update_degree(i, local, 9u, 7u);
        color = add_degree_three(color, direction, row);
    }
    if count > 4u {
        let terms = sh_degree_four(old);
        keep_basis(local, 0u, terms[0].value);
        keep_basis(local, 1u, terms[1].value);
        keep_basis(local, 2u, terms[2].value);
        keep_basis(local, 3u, terms[3].value);
        keep_basis(local, 4u, terms[4].value);
        keep_basis(local, 5u, terms[5].value);
        keep_basis(local, 6u, terms[6].value);
        keep_basis(local, 7u, terms[7].value);
        keep_basis(local, 8u, terms[8].value);
        update_degree(i, local, 16u, 9u);
        color = add_degree_four(color, direction, row);
    }
    if waits.moves {
        notes[i * NOTES + NOTE_WAITS] = waiting.count << 1u;
    }
    return color + 0.5;
}

// Brings all colors up to date; the steps that they waited for are then forgotten.
@compute @workgroup_size(64)
fn catch_up_all(
    @builtin(workgroup_id) workgroup: vec3<u32>,
    @builtin(num_workgroups) groups: vec3<u32>,
    @builtin(local_invocation_index) local: u32,
) {
    look_up_mode(workgroup);
    let i = linear_index(workgroup, groups, local, 64u);
    let is_one = i < window.count;
    let color = color_of(i, local, is_one, vec3(0.0));
    if is_one {
        notes[i * NOTES + NOTE_WAITS] = 0u;
    }
}
