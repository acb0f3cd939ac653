// Waiting colors on software adapters: a thread updates a splat's row. Follows waiting_colors.wgsl;
// color_of.wgsl follows.

// Basis functions of the degree in use.
fn sh_basis(d: vec3<f32>) -> array<f32, SH_COEFFS_MAX> {
    var basis: array<f32, SH_COEFFS_MAX>;
    basis[0] = SH_C0;
    if mode.sh_degree >= 1u {
        let terms = sh_degree_one(d);
        basis[1] = terms[0].value;
        basis[2] = terms[1].value;
        basis[3] = terms[2].value;
    }
    if mode.sh_degree >= 2u {
        let terms = sh_degree_two(d);
        basis[4] = terms[0].value;
        basis[5] = terms[1].value;
        basis[6] = terms[2].value;
        basis[7] = terms[3].value;
        basis[8] = terms[4].value;
    }
    if mode.sh_degree >= 3u {
        let terms = sh_degree_three(d);
        basis[9] = terms[0].value;
        basis[10] = terms[1].value;
        basis[11] = terms[2].value;
        basis[12] = terms[3].value;
        basis[13] = terms[4].value;
        basis[14] = terms[5].value;
        basis[15] = terms[6].value;
    }
    if mode.sh_degree >= 4u {
        let terms = sh_degree_four(d);
        basis[16] = terms[0].value;
        basis[17] = terms[1].value;
        basis[18] = terms[2].value;
        basis[19] = terms[3].value;
        basis[20] = terms[4].value;
        basis[21] = terms[5].value;
        basis[22] = terms[6].value;
        basis[23] = terms[7].value;
        basis[24] = terms[8].value;
    }
    return basis;
}

fn catch_up(i: u32) {
    let waits = waiting_of(i);
    if !waits.moves {
        return;
    }
    var basis: array<f32, SH_COEFFS_MAX>;
    if waits.has_gradient {
        basis = sh_basis(waits.direction);
    }
    let used = (mode.sh_degree + 1u) * (mode.sh_degree + 1u);
    for (var k = 0u; k < used; k++) {
        let at = 3u * (i * mode.sh_stride + k);
        var red = vec3(colors[at], first[at], second[at]);
        var green = vec3(colors[at + 1u], first[at + 1u], second[at + 1u]);
        var blue = vec3(colors[at + 2u], first[at + 2u], second[at + 2u]);
        let moments = bitcast<vec2<u32>>(red.yz) | bitcast<vec2<u32>>(green.yz)
            | bitcast<vec2<u32>>(blue.yz);
        // Without a gradient, moments that are zero stay it, and move nothing.
        if waits.has_gradient || any(moments != vec2(0u)) {
            var g = basis[k] * waits.v_color;
            for (var s = waits.next; s < waiting.count; s++) {
                let step = waiting.steps[s];
                let rate = select(step.y, step.x, k == 0u);
                red = adam_step(red, g.x, rate, step.zw);
                green = adam_step(green, g.y, rate, step.zw);
                blue = adam_step(blue, g.z, rate, step.zw);
                g = vec3(0.0);
            }
            colors[at] = red.x;
            colors[at + 1u] = green.x;
            colors[at + 2u] = blue.x;
            first[at] = red.y;
            first[at + 1u] = green.y;
            first[at + 2u] = blue.y;
            second[at] = red.z;
            second[at + 1u] = green.z;
            second[at + 2u] = blue.z;
        }
    }
    notes[i * NOTES + NOTE_WAITS] = waiting.count << 1u;
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
    if i < window.count {
        catch_up(i);
        notes[i * NOTES + NOTE_WAITS] = 0u;
    }
}
