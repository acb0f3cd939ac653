// Shared by both directions of the project stage: one splat's geometry and its spherical harmonics.
// Declared before are `geometry`, GEOMETRY floats per splat: mean 3, scales 3, quaternion 4 (wxyz),
// opacity 1; and `colors`, 3 floats per coefficient, `sh_stride` coefficients per splat (1 for direct
// colors).

@group(0) @binding(0) var<uniform> view: View;
@group(0) @binding(1) var<uniform> window: Window;

// How colors and parameters are stored, as `look_up_mode` has it from the view.
struct Mode {
    sh_degree: u32,
    sh_stride: u32,
    raw: bool,
    antialiased: bool,
}

var<private> mode: Mode;

// Mesa's lavapipe recompiles a kernel at every dispatch, and leaks, if branches that depend only on
// uniforms may skip much of it. Adding the workgroup's id avoids that without changing a value.
fn look_up_mode(workgroup: vec3<u32>) {
    let most = SH_COEFFS_MAX + workgroup.x;
    mode.sh_degree = min(view.sh_degree, most);
    mode.sh_stride = min(view.sh_stride, most);
    mode.raw = min(view.raw, most) == 1u;
    mode.antialiased = min(view.antialiased, most) == 1u;
}

struct Geometry {
    visible: bool,
    // Camera-space center.
    t: vec3<f32>,
    // Columns: the splat's axes in the world.
    axes: mat3x3<f32>,
    quat: vec4<f32>, // wxyz, normalized
    quat_norm: f32,
    scales: vec3<f32>,
    opacity: f32,
    // x/z and y/z within the Jacobian's limits, and whether they were inside.
    ratio: vec2<f32>,
    inside: vec2<bool>,
    // Rows of J times the camera's rotation.
    a0: vec3<f32>,
    a1: vec3<f32>,
    // a0 and a1 along the splat's axes.
    b0: vec3<f32>,
    b1: vec3<f32>,
    // b0 and b1 times the scales, so that the 2D covariance is m m^T + blur.
    m0: vec3<f32>,
    m1: vec3<f32>,
    // b0 x b1.
    normal: vec3<f32>,
}

// Rows of the camera's rotation.
fn rotation_row(i: u32) -> vec3<f32> {
    return view.world_to_camera[i].xyz;
}

fn to_world(v: vec3<f32>) -> vec3<f32> {
    return rotation_row(0u) * v.x + rotation_row(1u) * v.y + rotation_row(2u) * v.z;
}

fn to_camera(v: vec3<f32>) -> vec3<f32> {
    return vec3(dot(rotation_row(0u), v), dot(rotation_row(1u), v), dot(rotation_row(2u), v));
}

fn coefficient(i: u32) -> vec3<f32> {
    return vec3(colors[3u * i], colors[3u * i + 1u], colors[3u * i + 2u]);
}

// `local` counts from the window's first splat.
fn load_geometry(local: u32) -> Geometry {
    var g: Geometry;
    g.visible = false;
    let at = local * GEOMETRY;
    var finite = true;
    for (var k = 0u; k < GEOMETRY; k++) {
        finite = finite && is_finite(geometry[at + k]);
    }
    if !finite {
        return g;
    }
    let index = window.first + local;
    if hash(index ^ hash(view.dropout_seed ^ 0x5bd1e995u)) < view.dropout_threshold {
        return g;
    }
    let mean = vec3(geometry[at], geometry[at + 1u], geometry[at + 2u]);
    let given = vec3(geometry[at + 3u], geometry[at + 4u], geometry[at + 5u]);
    let quat = vec4(geometry[at + 6u], geometry[at + 7u], geometry[at + 8u], geometry[at + 9u]);
    let opacity = geometry[at + 10u];

    g.t = to_camera(mean)
        + vec3(view.world_to_camera[0].w, view.world_to_camera[1].w, view.world_to_camera[2].w);
    if !is_finite3(g.t) || g.t.z < view.near || g.t.z > view.far {
        return g;
    }
    // Scaled by its largest entry, so that the square of a huge quaternion does not overflow.
    let largest = max(max(abs(quat.x), abs(quat.y)), max(abs(quat.z), abs(quat.w)));
    if largest < 1e-12 {
        return g;
    }
    let scaled = quat / largest;
    let scaled_norm = sqrt(dot(scaled, scaled));
    g.quat_norm = largest * scaled_norm;
    // The limit is defined for the squared norm; it cannot overflow here.
    if g.quat_norm < 1.0 && g.quat_norm * g.quat_norm < QUAT_NORM2_MIN {
        return g;
    }
    g.quat = scaled / scaled_norm;
    let w = g.quat.x;
    let x = g.quat.y;
    let y = g.quat.z;
    let z = g.quat.w;
    g.axes = mat3x3(
        vec3(1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y + w * z), 2.0 * (x * z - w * y)),
        vec3(2.0 * (x * y - w * z), 1.0 - 2.0 * (x * x + z * z), 2.0 * (y * z + w * x)),
        vec3(2.0 * (x * z + w * y), 2.0 * (y * z - w * x), 1.0 - 2.0 * (x * x + y * y)),
    );
    if mode.raw {
        // Beyond, the squares below would leave f32.
        if any(given > vec3(40.0)) {
            return g;
        }
        g.scales = vec3(exp_accurate(given.x), exp_accurate(given.y), exp_accurate(given.z));
        g.opacity = 1.0 / (1.0 + exp_accurate(-opacity));
    } else {
        if any(given < vec3(0.0)) || any(given > vec3(1e17)) {
            return g;
        }
        g.scales = given;
        g.opacity = opacity;
    }
    g.opacity *= view.compensation;
    let xy = g.t.xy / g.t.z;
    g.ratio = clamp(xy, view.jacobian_limits.xz, view.jacobian_limits.yw);
    g.inside = g.ratio == xy;
    let per_z = view.focal / g.t.z;
    g.a0 = (rotation_row(0u) - rotation_row(2u) * g.ratio.x) * per_z.x;
    g.a1 = (rotation_row(1u) - rotation_row(2u) * g.ratio.y) * per_z.y;
    g.b0 = g.a0 * g.axes;
    g.b1 = g.a1 * g.axes;
    g.m0 = g.b0 * g.scales;
    g.m1 = g.b1 * g.scales;
    // The cross product of J's rows is (x/z, y/z, 1) fx fy / z^2, which leaves no cancellation to
    // needles seen along any direction.
    g.normal = to_world(vec3(g.ratio, 1.0)) * g.axes * per_z.x * per_z.y;
    g.visible = true;
    return g;
}

// m0 x m1; its length is the root of the 2D covariance's determinant without blur.
fn sharp_area(g: Geometry) -> vec3<f32> {
    return g.normal
        * vec3(g.scales.y * g.scales.z, g.scales.x * g.scales.z, g.scales.x * g.scales.y);
}

// (root of the determinant without blur, root of the determinant). det = |m0 x m1|^2
// + blur (sxx + syy) + blur^2 (Cauchy-Binet: a sum of positive terms); the roots are taken without
// squaring large values.
fn root_dets(g: Geometry) -> vec2<f32> {
    let area = sharp_area(g);
    let rest = sqrt(view.blur * (dot(g.m0, g.m0) + dot(g.m1, g.m1)) + view.blur * view.blur);
    let largest = max(max(abs(area.x), abs(area.y)), max(abs(area.z), rest));
    return largest * vec2(length(area / largest), length(vec4(area, rest) / largest));
}

// R^T t is the vector from the camera's center to the mean, without the cancellation of
// subtracting two far-away points. Length in w.
fn view_direction(t: vec3<f32>) -> vec4<f32> {
    let largest = max(max(abs(t.x), abs(t.y)), abs(t.z));
    let length = largest * length(t / largest);
    return vec4(to_world(t / length), length);
}

// A basis function at a direction (x, y, z) and its derivatives by x, y and z taken as independent. Same
// order and signs as sh.rs. Evaluated a degree at a time: DX12's older compiler is worst at a switch in a
// loop, and a thread needs all of a degree anyway.
struct Term {
    value: f32,
    derivative: vec3<f32>,
}

fn sh_degree_one(d: vec3<f32>) -> array<Term, 3> {
    let x = d.x;
    let y = d.y;
    let z = d.z;
    return array<Term, 3>(
        Term(-SH_C1 * y, vec3(0.0, -SH_C1, 0.0)),
        Term(SH_C1 * z, vec3(0.0, 0.0, SH_C1)),
        Term(-SH_C1 * x, vec3(-SH_C1, 0.0, 0.0)),
    );
}

fn sh_degree_two(d: vec3<f32>) -> array<Term, 5> {
    let x = d.x;
    let y = d.y;
    let z = d.z;
    let xx = d.x * d.x;
    let yy = d.y * d.y;
    let zz = d.z * d.z;
    return array<Term, 5>(
        Term(SH_C2_0 * x * y, SH_C2_0 * vec3(y, x, 0.0)),
        Term(-SH_C2_0 * y * z, -SH_C2_0 * vec3(0.0, z, y)),
        Term(SH_C2_1 * (2.0 * zz - xx - yy), 2.0 * SH_C2_1 * vec3(-x, -y, 2.0 * z)),
        Term(-SH_C2_0 * x * z, -SH_C2_0 * vec3(z, 0.0, x)),
        Term(SH_C2_2 * (xx - yy), 2.0 * SH_C2_2 * vec3(x, -y, 0.0)),
    );
}

fn sh_degree_three(d: vec3<f32>) -> array<Term, 7> {
    let x = d.x;
    let y = d.y;
    let z = d.z;
    let xx = d.x * d.x;
    let yy = d.y * d.y;
    let zz = d.z * d.z;
    return array<Term, 7>(
        Term(
            -SH_C3_0 * y * (3.0 * xx - yy),
            -3.0 * SH_C3_0 * vec3(2.0 * x * y, xx - yy, 0.0),
        ),
        Term(SH_C3_1 * x * y * z, SH_C3_1 * vec3(y * z, x * z, x * y)),
        Term(
            -SH_C3_2 * y * (4.0 * zz - xx - yy),
            -SH_C3_2 * vec3(-2.0 * x * y, 4.0 * zz - xx - 3.0 * yy, 8.0 * y * z),
        ),
        Term(
            SH_C3_3 * z * (2.0 * zz - 3.0 * xx - 3.0 * yy),
            3.0 * SH_C3_3 * vec3(-2.0 * x * z, -2.0 * y * z, 2.0 * zz - xx - yy),
        ),
        Term(
            -SH_C3_2 * x * (4.0 * zz - xx - yy),
            -SH_C3_2 * vec3(4.0 * zz - 3.0 * xx - yy, -2.0 * x * y, 8.0 * x * z),
        ),
        Term(
            SH_C3_4 * z * (xx - yy),
            SH_C3_4 * vec3(2.0 * x * z, -2.0 * y * z, xx - yy),
        ),
        Term(
            -SH_C3_0 * x * (xx - 3.0 * yy),
            -3.0 * SH_C3_0 * vec3(xx - yy, -2.0 * x * y, 0.0),
        ),
    );
}

fn sh_degree_four(d: vec3<f32>) -> array<Term, 9> {
    let x = d.x;
    let y = d.y;
    let z = d.z;
    let xx = d.x * d.x;
    let yy = d.y * d.y;
    let zz = d.z * d.z;
    return array<Term, 9>(
        Term(
            SH_C4_0 * x * y * (xx - yy),
            SH_C4_0 * vec3(y * (3.0 * xx - yy), x * (xx - 3.0 * yy), 0.0),
        ),
        Term(
            -SH_C4_1 * y * z * (3.0 * xx - yy),
            -SH_C4_1 * vec3(6.0 * x * y * z, 3.0 * z * (xx - yy), y * (3.0 * xx - yy)),
        ),
        Term(
            SH_C4_2 * x * y * (7.0 * zz - 1.0),
            SH_C4_2 * vec3(y * (7.0 * zz - 1.0), x * (7.0 * zz - 1.0), 14.0 * x * y * z),
        ),
        Term(
            -SH_C4_3 * y * z * (7.0 * zz - 3.0),
            -SH_C4_3 * vec3(0.0, z * (7.0 * zz - 3.0), y * (21.0 * zz - 3.0)),
        ),
        Term(
            SH_C4_4 * (zz * (35.0 * zz - 30.0) + 3.0),
            SH_C4_4 * vec3(0.0, 0.0, z * (140.0 * zz - 60.0)),
        ),
        Term(
            -SH_C4_3 * x * z * (7.0 * zz - 3.0),
            -SH_C4_3 * vec3(z * (7.0 * zz - 3.0), 0.0, x * (21.0 * zz - 3.0)),
        ),
        Term(
            SH_C4_HALF * (xx - yy) * (7.0 * zz - 1.0),
            SH_C4_HALF * vec3(
                2.0 * x * (7.0 * zz - 1.0),
                -2.0 * y * (7.0 * zz - 1.0),
                14.0 * z * (xx - yy),
            ),
        ),
        Term(
            -SH_C4_1 * x * z * (xx - 3.0 * yy),
            -SH_C4_1 * vec3(3.0 * z * (xx - yy), -6.0 * x * y * z, x * (xx - 3.0 * yy)),
        ),
        Term(
            SH_C4_5 * (xx * (xx - 3.0 * yy) - yy * (3.0 * xx - yy)),
            4.0 * SH_C4_5 * vec3(x * (xx - 3.0 * yy), y * (yy - 3.0 * xx), 0.0),
        ),
    );
}
