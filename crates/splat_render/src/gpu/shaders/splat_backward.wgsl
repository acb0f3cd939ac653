// Gradients of one 2D splat to gradients of the splat and the camera. Follows shared.wgsl and
// geometry.wgsl; the next file declares the bindings, and `keep_coefficient`, which receives the gradient
// of each stored coefficient. Formulas and names as in reference/project_backward.rs.

struct Backward {
    geometry: array<f32, GEOMETRY>,
    camera: array<f32, CAMERA>,
    // Gradient of the color before the clamp at zero, and the viewing direction. A coefficient's gradient
    // is its basis function at the direction times the color's.
    v_color: vec3<f32>,
    direction: vec3<f32>,
    // Whether there is a gradient at all.
    is_some: bool,
}

var<workgroup> camera_sums: array<array<f32, 64>, CAMERA>;

fn quat_gradient(quat: vec4<f32>, v: mat3x3<f32>) -> vec4<f32> {
    let w = quat.x;
    let x = quat.y;
    let y = quat.z;
    let z = quat.w;
    // v[c][r] is the gradient of R[r][c].
    return 2.0 * vec4(
        x * (v[1].z - v[2].y) + y * (v[2].x - v[0].z) + z * (v[0].y - v[1].x),
        -2.0 * x * (v[1].y + v[2].z) + y * (v[1].x + v[0].y) + z * (v[2].x + v[0].z)
            + w * (v[1].z - v[2].y),
        x * (v[1].x + v[0].y) - 2.0 * y * (v[0].x + v[2].z) + z * (v[2].y + v[1].z)
            + w * (v[2].x - v[0].z),
        x * (v[2].x + v[0].z) + y * (v[2].y + v[1].z) - 2.0 * z * (v[0].x + v[1].y)
            + w * (v[0].y - v[1].x),
    );
}

// a b^T
fn outer(a: vec3<f32>, b: vec3<f32>) -> mat3x3<f32> {
    return mat3x3(a * b.x, a * b.y, a * b.z);
}

fn keep_zeros(i: u32) {
    let rows = max(mode.sh_stride, 1u);
    for (var k = 0u; k < rows; k++) {
        keep_coefficient(i * rows + k, vec3(0.0));
    }
}

// Stores the gradient of one coefficient; returns its part of the direction's gradient.
fn coefficient_backward(row: u32, term: Term, v_color: vec3<f32>) -> vec3<f32> {
    keep_coefficient(row, term.value * v_color);
    return term.derivative * dot(v_color, coefficient(row));
}

// Gradients of all coefficients of a splat; returns the direction's.
fn sh_backward(i: u32, direction: vec3<f32>, v_color: vec3<f32>) -> vec3<f32> {
    let row = i * mode.sh_stride;
    var v_direction = coefficient_backward(row, Term(SH_C0, vec3(0.0)), v_color);
    if mode.sh_degree >= 1u {
        let terms = sh_degree_one(direction);
        v_direction += coefficient_backward(row + 1u, terms[0], v_color);
        v_direction += coefficient_backward(row + 2u, terms[1], v_color);
        v_direction += coefficient_backward(row + 3u, terms[2], v_color);
    }
    if mode.sh_degree >= 2u {
        let terms = sh_degree_two(direction);
        v_direction += coefficient_backward(row + 4u, terms[0], v_color);
        v_direction += coefficient_backward(row + 5u, terms[1], v_color);
        v_direction += coefficient_backward(row + 6u, terms[2], v_color);
        v_direction += coefficient_backward(row + 7u, terms[3], v_color);
        v_direction += coefficient_backward(row + 8u, terms[4], v_color);
    }
    if mode.sh_degree >= 3u {
        let terms = sh_degree_three(direction);
        v_direction += coefficient_backward(row + 9u, terms[0], v_color);
        v_direction += coefficient_backward(row + 10u, terms[1], v_color);
        v_direction += coefficient_backward(row + 11u, terms[2], v_color);
        v_direction += coefficient_backward(row + 12u, terms[3], v_color);
        v_direction += coefficient_backward(row + 13u, terms[4], v_color);
        v_direction += coefficient_backward(row + 14u, terms[5], v_color);
        v_direction += coefficient_backward(row + 15u, terms[6], v_color);
    }
    if mode.sh_degree >= 4u {
        let terms = sh_degree_four(direction);
        v_direction += coefficient_backward(row + 16u, terms[0], v_color);
        v_direction += coefficient_backward(row + 17u, terms[1], v_color);
        v_direction += coefficient_backward(row + 18u, terms[2], v_color);
        v_direction += coefficient_backward(row + 19u, terms[3], v_color);
        v_direction += coefficient_backward(row + 20u, terms[4], v_color);
        v_direction += coefficient_backward(row + 21u, terms[5], v_color);
        v_direction += coefficient_backward(row + 22u, terms[6], v_color);
        v_direction += coefficient_backward(row + 23u, terms[7], v_color);
        v_direction += coefficient_backward(row + 24u, terms[8], v_color);
    }
    // Coefficients of degrees that are not in use yet.
    let used = (mode.sh_degree + 1u) * (mode.sh_degree + 1u);
    for (var k = used; k < mode.sh_stride; k++) {
        keep_coefficient(row + k, vec3(0.0));
    }
    return v_direction;
}

// Gradients of a splat that is not culled; stores the coefficients'.
fn splat_backward(i: u32) -> Backward {
    var none: Backward;
    let g = load_geometry(i);
    if !g.visible {
        keep_zeros(i);
        return none;
    }
    var camera: array<f32, CAMERA>;
    let at = i * GRADIENT;
    let v_center = vec2(v_splats2d[at], v_splats2d[at + 1u]);
    let v_factor = vec3(v_splats2d[at + 2u], v_splats2d[at + 3u], v_splats2d[at + 4u]);
    let v_depth = v_splats2d[at + 5u];
    var v_color = vec3(v_splats2d[at + 6u], v_splats2d[at + 7u], v_splats2d[at + 8u]);
    let v_opacity = v_splats2d[at + 9u];
    let z = g.t.z;
    let xy = g.t.xy / z;
    let per_z = view.focal / z;
    var v_t = vec3(0.0);
    var v_rotation = mat3x3<f32>();
    var finite = true;

    // Color and, through the view direction, t and the rotation.
    var direction = vec4(0.0);
    if mode.sh_stride == 0u {
        keep_coefficient(i, v_color);
    } else {
        direction = view_direction(g.t);
        v_color = select(vec3(0.0), v_color, splats2d[i].color > vec3(0.0));
        let v_direction = sh_backward(i, direction.xyz, v_color);
        let v_along =
            (v_direction - direction.xyz * dot(direction.xyz, v_direction)) / direction.w;
        v_t += to_camera(v_along);
        v_rotation += outer(g.t, v_along);
    }

    // Factor F -> whitened 2D covariance -> M = J R A S, as in cpu/project_backward.rs.
    let p = splats2d[i].pq.x;
    let q = splats2d[i].pq.y;
    let r = splats2d[i].r;
    let v_uu = -0.5 * (p * v_factor.x + q * v_factor.y);
    let v_uv = -r * v_factor.y;
    let v_vv = -0.5 * r * v_factor.z;
    var compensation = 1.0;
    var v_log = 0.0;
    if mode.antialiased {
        let dets = root_dets(g);
        compensation = dets.x / dets.y;
        v_log = v_opacity * g.opacity * compensation;
    }
    let fb_u = (cross(g.scales * g.scales * g.b1, g.normal) + view.blur * g.b0) * (p * r * r);
    let fb_v = g.b1 * r;
    let fm_u = fb_u * g.scales;
    let fm_v = fb_v * g.scales;
    let v_fm_u = 2.0 * v_uu * fm_u + v_uv * fm_v;
    let v_fm_v = v_uv * fm_u + 2.0 * v_vv * fm_v;
    var v_scales = v_fm_u * fb_u + v_fm_v * fb_v;
    var v_m0 = p * v_fm_u;
    var v_m1 = q * v_fm_u + r * v_fm_v;
    if mode.antialiased {
        // With S = M M^T and C = S + blur I, ln compensation = (ln det S - ln det C) / 2 has the gradient
        // S^-1 M - C^-1 M, whose terms cancel for large splats; it is blur C^-1 S^-1 M. The rows of S^-1
        // M are m1 x n / n^2 and n x m0 / n^2 with n = m0 x m1, divided by the length twice, since its
        // square may underflow.
        let area = sharp_area(g);
        let length_area = length(area);
        let n = area / length_area / length_area;
        let w0 = cross(g.m1, n);
        let w1 = cross(n, g.m0);
        let e_u = (p * w0 + q * w1) * (v_log * view.blur);
        let e_v = r * w1 * (v_log * view.blur);
        v_scales += e_u * fb_u + e_v * fb_v;
        v_m0 += p * e_u;
        v_m1 += q * e_u + r * e_v;
    }
    let v_b0 = v_m0 * g.scales;
    let v_b1 = v_m1 * g.scales;

    // Axes -> quaternion, through its normalization.
    let v_unit = quat_gradient(g.quat, outer(g.a0, v_b0) + outer(g.a1, v_b1));
    let v_quat = (v_unit - dot(v_unit, g.quat) * g.quat) / g.quat_norm;

    // a = J R.
    let v_a0 = g.axes * v_b0;
    let v_a1 = g.axes * v_b1;
    let v_j00 = dot(v_a0, rotation_row(0u));
    let v_j02 = dot(v_a0, rotation_row(2u));
    let v_j11 = dot(v_a1, rotation_row(1u));
    let v_j12 = dot(v_a1, rotation_row(2u));
    v_rotation += transpose(mat3x3(
        v_a0 * per_z.x,
        v_a1 * per_z.y,
        -(v_a0 * (per_z.x * g.ratio.x)) - v_a1 * (per_z.y * g.ratio.y),
    ));

    // J, with clamped x/z and y/z held constant.
    var v_focal = vec2(v_j00 - v_j02 * g.ratio.x, v_j11 - v_j12 * g.ratio.y) / z;
    var v_principal = vec2(0.0);
    v_t.z += (per_z.x * (v_j02 * g.ratio.x - v_j00) + per_z.y * (v_j12 * g.ratio.y - v_j11)) / z;
    let v_ratio = -vec2(v_j02, v_j12) * per_z;
    if g.inside.x {
        v_t.x += v_ratio.x / z;
        v_t.z -= v_ratio.x * xy.x / z;
    } else {
        // The limit is an affine function of cx, over fx.
        v_focal.x -= v_ratio.x * g.ratio.x / view.focal.x;
        v_principal.x -= v_ratio.x / view.focal.x;
    }
    if g.inside.y {
        v_t.y += v_ratio.y / z;
        v_t.z -= v_ratio.y * xy.y / z;
    } else {
        v_focal.y -= v_ratio.y * g.ratio.y / view.focal.y;
        v_principal.y -= v_ratio.y / view.focal.y;
    }

    // Center and depth.
    v_focal += v_center * xy;
    v_principal += v_center;
    v_t += vec3(v_center * per_z, v_depth - dot(v_center * per_z, xy));

    // t = R mean + translation.
    let base = i * GEOMETRY;
    let mean = vec3(geometry[base], geometry[base + 1u], geometry[base + 2u]);
    let v_mean = to_world(v_t);
    v_rotation += outer(v_t, mean);

    var v_given_opacity = v_opacity * compensation * view.compensation;
    if mode.raw {
        v_scales *= g.scales;
        // o (1 - o), without the cancellation at saturated logits.
        let tail = exp_accurate(-abs(geometry[base + 10u]));
        v_given_opacity *= tail / ((1.0 + tail) * (1.0 + tail));
    }
    var row = array<f32, GEOMETRY>(
        v_mean.x, v_mean.y, v_mean.z,
        v_scales.x, v_scales.y, v_scales.z,
        v_quat.x, v_quat.y, v_quat.z, v_quat.w,
        v_given_opacity,
    );
    for (var r = 0u; r < 3u; r++) {
        for (var c = 0u; c < 3u; c++) {
            camera[4u * r + c] = v_rotation[c][r];
        }
        camera[4u * r + 3u] = v_t[r];
    }
    camera[12] = v_focal.x;
    camera[13] = v_focal.y;
    camera[14] = v_principal.x;
    camera[15] = v_principal.y;
    // Gradients outside f32's range give no direction; zero is harmless.
    for (var k = 0u; k < GEOMETRY; k++) {
        finite = finite && is_finite(row[k]);
    }
    for (var k = 0u; k < CAMERA; k++) {
        finite = finite && is_finite(camera[k]);
    }
    if !finite {
        keep_zeros(i);
        return none;
    }
    return Backward(row, camera, v_color, direction.xyz, true);
}

// Adds a workgroup's gradients of the camera in the order of its splats, one thread per entry.
fn sum_cameras(camera: array<f32, CAMERA>, group: u32, local: u32) {
    var own = camera;
    for (var k = 0u; k < CAMERA; k++) {
        camera_sums[k][local] = own[k];
    }
    workgroupBarrier();
    if local < CAMERA && group * 64u < window.count {
        var sum = 0.0;
        for (var k = 0u; k < 64u; k++) {
            sum += camera_sums[local][k];
        }
        v_camera[(window.first / 64u + group) * CAMERA + local] = sum;
    }
}
