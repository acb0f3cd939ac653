// project_backward: gradients of splats and camera. Follows splat_backward.wgsl.

@group(0) @binding(4) var<storage, read> splats2d: array<Splat2d>;
// GRADIENT floats per splat: mean 2, factor 3, depth, color 3, opacity.
@group(0) @binding(5) var<storage, read> v_splats2d: array<f32>;
@group(0) @binding(6) var<storage, read_write> v_geometry: array<f32>;
@group(0) @binding(7) var<storage, read_write> v_colors: array<f32>;
// CAMERA floats per workgroup: rows of the 3x4 viewmat, fx, fy, cx, cy.
@group(0) @binding(8) var<storage, read_write> v_camera: array<f32>;

fn keep_coefficient(row: u32, v: vec3<f32>) {
    v_colors[3u * row] = v.x;
    v_colors[3u * row + 1u] = v.y;
    v_colors[3u * row + 2u] = v.z;
}

@compute @workgroup_size(64)
fn project_backward(
    @builtin(workgroup_id) workgroup: vec3<u32>,
    @builtin(num_workgroups) groups: vec3<u32>,
    @builtin(local_invocation_index) local: u32,
) {
    look_up_mode(workgroup);
    let i = linear_index(workgroup, groups, local, 64u);
    var v: Backward;
    if i < window.count {
        if any(splats2d[i].radii != vec2(0.0)) {
            v = splat_backward(i);
        } else {
            keep_zeros(i);
        }
        for (var k = 0u; k < GEOMETRY; k++) {
            v_geometry[i * GEOMETRY + k] = v.geometry[k];
        }
    }
    sum_cameras(v.camera, workgroup.y * groups.x + workgroup.x, local);
}
