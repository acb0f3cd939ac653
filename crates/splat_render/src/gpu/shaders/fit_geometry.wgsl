// fit_geometry: project_backward and adam of means, scales, quaternions and opacities in one, so that
// their gradients are never stored. Only splats that are not culled have any; theirs of colours go to
// adam_colors. Runs no workgroup once a chunk's pairs did not fit. Follows splat_backward.wgsl and
// adam_geometry.wgsl.

@group(0) @binding(4) var<storage, read> splats2d: array<Splat2d>;
// GRADIENT floats per splat: mean 2, factor 3, depth, colour 3, opacity.
@group(0) @binding(5) var<storage, read> v_splats2d: array<f32>;
// Rows of splats that are not culled.
@group(0) @binding(6) var<storage, read_write> v_colors: array<f32>;
// CAMERA floats per workgroup: rows of the 3x4 viewmat, fx, fy, cx, cy.
@group(0) @binding(7) var<storage, read_write> v_camera: array<f32>;
@group(0) @binding(8) var<storage, read_write> first: array<f32>;
@group(0) @binding(9) var<storage, read_write> second: array<f32>;
@group(0) @binding(10) var<uniform> step: Step;

@compute @workgroup_size(64)
fn fit_geometry(
    @builtin(workgroup_id) workgroup: vec3<u32>,
    @builtin(local_invocation_index) local: u32,
) {
    look_up_mode(workgroup);
    let i = indirect_index(workgroup, window.groups_max, local, 64u);
    var v: Backward;
    if i < window.count {
        if splats2d[i].radii.x > 0.0 {
            v = splat_backward(i);
        }
        if step.frozen == 0u && window.first + i < step.moving {
            adam_of_geometry(i, v.geometry);
        }
    }
    sum_cameras(v.camera, workgroup.y * window.groups_max + workgroup.x, local);
}
