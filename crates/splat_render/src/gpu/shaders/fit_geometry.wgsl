// fit_geometry: project_backward, adam of means, scales, quaternions and opacities, and density
// statistics in one kernel. It stores no gradient except the color's, which waits (waiting_colors.wgsl).
// Culled splats have no gradient. Runs no workgroup if a chunk's pairs did not fit. Follows
// splat_backward.wgsl and adam_geometry.wgsl.

@group(0) @binding(4) var<storage, read> splats2d: array<Splat2d>;
// GRADIENT floats per splat: mean 2, factor 3, depth, color 3, opacity.
@group(0) @binding(5) var<storage, read> v_splats2d: array<f32>;
// NOTES words per splat.
@group(0) @binding(6) var<storage, read_write> notes: array<u32>;
// CAMERA floats per workgroup: rows of the 3x4 viewmat, fx, fy, cx, cy.
@group(0) @binding(7) var<storage, read_write> v_camera: array<f32>;
@group(0) @binding(8) var<storage, read_write> first: array<f32>;
@group(0) @binding(9) var<storage, read_write> second: array<f32>;
@group(0) @binding(10) var<uniform> step: Step;

// Gradients of coefficients follow from the color's.
fn keep_coefficient(row: u32, v: vec3<f32>) {}

fn add_to_note(at: u32, value: f32) {
    notes[at] = bitcast<u32>(bitcast<f32>(notes[at]) + value);
}

// The step's gradient of a color, for when the splat is next seen.
fn keep_color(i: u32, v: Backward) {
    let note = i * NOTES;
    notes[note + NOTE_WAITS] |= 1u;
    let color = bitcast<vec3<u32>>(v.v_color);
    notes[note + NOTE_COLOR] = color.x;
    notes[note + NOTE_COLOR + 1u] = color.y;
    notes[note + NOTE_COLOR + 2u] = color.z;
    let direction = bitcast<vec3<u32>>(v.direction);
    notes[note + NOTE_DIRECTION] = direction.x;
    notes[note + NOTE_DIRECTION + 1u] = direction.y;
    notes[note + NOTE_DIRECTION + 2u] = direction.z;
}

@compute @workgroup_size(64)
fn fit_geometry(
    @builtin(workgroup_id) workgroup: vec3<u32>,
    @builtin(local_invocation_index) local: u32,
) {
    look_up_mode(workgroup);
    let i = indirect_index(workgroup, window.groups_max, local, 64u);
    var v: Backward;
    if i < window.count {
        let moves = window.first + i < step.moving;
        if splats2d[i].radii.x > 0.0 {
            v = splat_backward(i);
            if moves {
                let size = vec2(f32(view.width), f32(view.height));
                let v_mean = vec2(v_splats2d[i * GRADIENT], v_splats2d[i * GRADIENT + 1u]);
                add_to_note(i * NOTES + NOTE_PULL, length(0.5 * size * v_mean));
                add_to_note(i * NOTES + NOTE_SEEN, 1.0);
            }
        }
        if step.frozen == 0u && moves {
            adam_of_geometry(i, v.geometry);
            if v.is_some {
                keep_color(i, v);
            }
        }
    }
    sum_cameras(v.camera, workgroup.y * window.groups_max + workgroup.x, local);
}
