// project: splats and camera to 2D splats. Follows sh_color.wgsl; in fits also waiting_colors.wgsl.

// Of culled splats, the radii alone.
@group(0) @binding(4) var<storage, read_write> splats2d: array<Splat2d>;
@group(0) @binding(5) var<storage, read_write> keys: array<u32>;

struct Uncolored {
    // Radii (0, 0) if culled.
    splat: Splat2d,
    // From the camera.
    direction: vec3<f32>,
}

fn project_one(i: u32) -> Uncolored {
    var out: Splat2d;
    var direction = vec3(0.0);
    let g = load_geometry(i);
    // ALPHA_MIN also stops opacities that are zero, negative or underflown.
    if g.visible && g.opacity > ALPHA_MIN {
        let sxx = dot(g.m0, g.m0);
        let sxy = dot(g.m0, g.m1);
        let syy = dot(g.m1, g.m1);
        let cxx = sxx + view.blur;
        let cyy = syy + view.blur;
        let dets = root_dets(g);
        let root_det = dets.y;
        var opacity = g.opacity;
        if mode.antialiased {
            opacity *= dets.x / dets.y;
        }
        let root_cyy = sqrt(cyy);
        let p = root_cyy / root_det;
        let q = -(sxy / root_cyy) / root_det;
        let r = 1.0 / root_cyy;
        // Below 0 if the opacity fell below ALPHA_MIN.
        let reach = max(2.0 * log(opacity / ALPHA_MIN), 0.0);
        let radii = vec2(sqrt(reach * cxx), sqrt(reach * cyy));
        let center = view.focal * (g.t.xy / g.t.z) + view.principal;
        let size = vec2(f32(view.width), f32(view.height));
        let finite = is_finite(center.x) && is_finite(center.y) && is_finite(radii.x)
            && is_finite(radii.y) && is_finite(p) && is_finite(q) && is_finite(r)
            && is_finite(root_det) && is_finite(sxy);
        let in_picture = all(center + radii >= vec2(0.0)) && all(center - radii <= size);
        if finite && in_picture && all(radii > vec2(0.0)) {
            out.mean = center;
            out.pq = vec2(p, q);
            direction = view_direction(g.t).xyz;
            out.r = r;
            out.depth = g.t.z;
            out.opacity = opacity;
            out.radii = radii;
        }
    }
    return Uncolored(out, direction);
}

@compute @workgroup_size(64)
fn project(
    @builtin(workgroup_id) workgroup: vec3<u32>,
    @builtin(num_workgroups) groups: vec3<u32>,
    @builtin(local_invocation_index) local: u32,
) {
    look_up_mode(workgroup);
    let i = linear_index(workgroup, groups, local, 64u);
    var projected: Uncolored;
    if i < window.count {
        projected = project_one(i);
    }
    var out = projected.splat;
    let is_drawn = out.radii.x > 0.0;
    var color = color_of(i, local, is_drawn, projected.direction);
    // Tested before max(), which may turn NaN into 0.
    if is_drawn && is_finite3(color) {
        if mode.sh_stride != 0u {
            color = max(color, vec3(0.0));
        }
        out.color = color;
        splats2d[i] = out;
        keys[i] = depth_key(out.depth);
    } else if i < window.count {
        splats2d[i].radii = vec2(0.0);
        keys[i] = CULLED_KEY;
    }
}
