// loss: L1 and D-SSIM of the picture against a photo, with the picture's gradient. Two passes of a
// separable filter: to the slopes of SSIM by the filtered maps, then back. A thread has one pixel of a
// tile; a tile and its margin are read once, then filtered along rows and columns. The first pass writes
// derivatives of the weighted SSIM sum by the filtered x, xx and xy: nine planes, by channel first. Follows
// loss_pixels.wgsl.

const THREADS = TILE * TILE;
// Taps on each side of the window's center.
const HALF = 5;
// Side of a tile with the window's margin.
const SIDE = 26u;
const STAGED = SIDE * SIDE;
// Pixels filtered along rows.
const ROW_FILTERED = SIDE * TILE;

// Picture and photo.
var<workgroup> staged: array<vec2<f32>, STAGED>;
// x, y, x^2 + y^2 and x y.
var<workgroup> filtered: array<vec4<f32>, ROW_FILTERED>;
// Three planes of slopes.
var<workgroup> staged_slopes: array<f32, 3u * STAGED>;
var<workgroup> filtered_slopes: array<f32, 3u * ROW_FILTERED>;
var<workgroup> partial_sums: array<f32, THREADS>;

// The pixel of a staged one, or UINT_MAX outside of the picture, which counts as zero.
fn staged_pixel(workgroup: vec3<u32>, k: u32) -> u32 {
    let at = vec2<i32>(workgroup.xy * TILE + vec2(k % SIDE, k / SIDE)) - HALF;
    if any(at < vec2(0)) || at.x >= i32(view.width) || at.y >= i32(view.height) {
        return 0xffffffffu;
    }
    return u32(at.y) * view.width + u32(at.x);
}

fn pick(color: vec3<f32>, channel: u32) -> f32 {
    return select(select(color.z, color.y, channel == 1u), color.x, channel == 0u);
}

fn maps(at: u32) -> vec4<f32> {
    let v = staged[at];
    return vec4(v, dot(v, v), v.x * v.y);
}

// Along the row that begins at staged pixel `at`.
fn row_of_maps(at: u32) -> vec4<f32> {
    return SSIM_TAP_0 * (maps(at) + maps(at + 10u)) + SSIM_TAP_1 * (maps(at + 1u) + maps(at + 9u))
        + SSIM_TAP_2 * (maps(at + 2u) + maps(at + 8u)) + SSIM_TAP_3 * (maps(at + 3u) + maps(at + 7u))
        + SSIM_TAP_4 * (maps(at + 4u) + maps(at + 6u)) + SSIM_TAP_5 * maps(at + 5u);
}

// Down the column that begins at `at`.
fn column_of_maps(at: u32) -> vec4<f32> {
    return SSIM_TAP_0 * (filtered[at] + filtered[at + 10u * TILE])
        + SSIM_TAP_1 * (filtered[at + TILE] + filtered[at + 9u * TILE])
        + SSIM_TAP_2 * (filtered[at + 2u * TILE] + filtered[at + 8u * TILE])
        + SSIM_TAP_3 * (filtered[at + 3u * TILE] + filtered[at + 7u * TILE])
        + SSIM_TAP_4 * (filtered[at + 4u * TILE] + filtered[at + 6u * TILE])
        + SSIM_TAP_5 * filtered[at + 5u * TILE];
}

fn row_of_slopes(at: u32) -> f32 {
    return SSIM_TAP_0 * (staged_slopes[at] + staged_slopes[at + 10u])
        + SSIM_TAP_1 * (staged_slopes[at + 1u] + staged_slopes[at + 9u])
        + SSIM_TAP_2 * (staged_slopes[at + 2u] + staged_slopes[at + 8u])
        + SSIM_TAP_3 * (staged_slopes[at + 3u] + staged_slopes[at + 7u])
        + SSIM_TAP_4 * (staged_slopes[at + 4u] + staged_slopes[at + 6u])
        + SSIM_TAP_5 * staged_slopes[at + 5u];
}

fn column_of_slopes(at: u32) -> f32 {
    return SSIM_TAP_0 * (filtered_slopes[at] + filtered_slopes[at + 10u * TILE])
        + SSIM_TAP_1 * (filtered_slopes[at + TILE] + filtered_slopes[at + 9u * TILE])
        + SSIM_TAP_2 * (filtered_slopes[at + 2u * TILE] + filtered_slopes[at + 8u * TILE])
        + SSIM_TAP_3 * (filtered_slopes[at + 3u * TILE] + filtered_slopes[at + 7u * TILE])
        + SSIM_TAP_4 * (filtered_slopes[at + 4u * TILE] + filtered_slopes[at + 6u * TILE])
        + SSIM_TAP_5 * filtered_slopes[at + 5u * TILE];
}

// Sum over the workgroup in a fixed order; valid in thread 0.
fn workgroup_sum(local: u32, value: f32) -> f32 {
    partial_sums[local] = value;
    workgroupBarrier();
    var sum = 0.0;
    if local < TILE {
        for (var k = 0u; k < TILE; k++) {
            sum += partial_sums[k * TILE + local];
        }
    }
    workgroupBarrier();
    partial_sums[local] = sum;
    workgroupBarrier();
    var total = 0.0;
    if local == 0u {
        for (var k = 0u; k < TILE; k++) {
            total += partial_sums[k];
        }
    }
    return total;
}

@compute @workgroup_size(THREADS)
fn loss_slopes(
    @builtin(workgroup_id) workgroup: vec3<u32>,
    @builtin(num_workgroups) groups: vec3<u32>,
    @builtin(local_invocation_index) local: u32,
) {
    let pixels = view.width * view.height;
    let at = workgroup.xy * TILE + vec2(local % TILE, local / TILE);
    let exists = at.x < view.width && at.y < view.height;
    let pixel = at.y * view.width + at.x;
    var w = 0.0;
    if exists {
        w = weight(pixel);
    }
    var ssim_sum = 0.0;
    for (var channel = 0u; channel < 3u; channel++) {
        for (var k = local; k < STAGED; k += THREADS) {
            let from_pixel = staged_pixel(workgroup, k);
            var both = vec2(0.0);
            if from_pixel != 0xffffffffu {
                both.x = pick(picture[from_pixel].xyz, channel);
                both.y = pick(photo_color(from_pixel), channel);
            }
            staged[k] = both;
        }
        workgroupBarrier();
        for (var k = local; k < ROW_FILTERED; k += THREADS) {
            filtered[k] = row_of_maps(k / TILE * SIDE + k % TILE);
        }
        workgroupBarrier();
        let m = column_of_maps(local);
        let mu_x = m.x;
        let mu_y = m.y;
        let squares = mu_x * mu_x + mu_y * mu_y;
        let a1 = 2.0 * mu_x * mu_y + SSIM_C1;
        let a2 = 2.0 * (m.w - mu_x * mu_y) + SSIM_C2;
        let b1 = squares + SSIM_C1;
        let b2 = m.z - squares + SSIM_C2;
        let inverse = 1.0 / (b1 * b2);
        let ssim = a1 * a2 * inverse;
        let v_xx = -ssim * inverse * b1;
        let v_xy = 2.0 * a1 * inverse;
        // Directly, and through s_xx = xx - mu_x^2 and s_xy = xy - mu_x mu_y.
        let direct = mu_y * a2 * inverse - mu_x * ssim * inverse * b2;
        let v_mu = 2.0 * direct - (2.0 * v_xx * mu_x + v_xy * mu_y);
        if exists {
            slopes[(3u * channel) * pixels + pixel] = w * v_mu;
            slopes[(3u * channel + 1u) * pixels + pixel] = w * v_xx;
            slopes[(3u * channel + 2u) * pixels + pixel] = w * v_xy;
            ssim_sum += w * ssim;
        }
    }
    let sum = workgroup_sum(local, ssim_sum);
    if local == 0u {
        sums[workgroup.y * groups.x + workgroup.x].x = sum;
    }
}

@compute @workgroup_size(THREADS)
fn loss_gradient(
    @builtin(workgroup_id) workgroup: vec3<u32>,
    @builtin(num_workgroups) groups: vec3<u32>,
    @builtin(local_invocation_index) local: u32,
) {
    let pixels = view.width * view.height;
    let at = workgroup.xy * TILE + vec2(local % TILE, local / TILE);
    let exists = at.x < view.width && at.y < view.height;
    let pixel = at.y * view.width + at.x;
    var color = vec3(0.0);
    var wanted = vec3(0.0);
    if exists {
        color = picture[pixel].xyz;
        wanted = photo_color(pixel);
    }
    // Through SSIM of the filtered maps.
    var v_ssim = vec3(0.0);
    for (var channel = 0u; channel < 3u; channel++) {
        for (var k = local; k < STAGED; k += THREADS) {
            let from_pixel = staged_pixel(workgroup, k);
            var planes = vec3(0.0);
            if from_pixel != 0xffffffffu {
                let slope = 3u * channel * pixels + from_pixel;
                planes = vec3(slopes[slope], slopes[slope + pixels], slopes[slope + 2u * pixels]);
            }
            staged_slopes[k] = planes.x;
            staged_slopes[STAGED + k] = planes.y;
            staged_slopes[2u * STAGED + k] = planes.z;
        }
        workgroupBarrier();
        for (var k = local; k < ROW_FILTERED; k += THREADS) {
            let row = k / TILE * SIDE + k % TILE;
            filtered_slopes[k] = row_of_slopes(row);
            filtered_slopes[ROW_FILTERED + k] = row_of_slopes(STAGED + row);
            filtered_slopes[2u * ROW_FILTERED + k] = row_of_slopes(2u * STAGED + row);
        }
        workgroupBarrier();
        let v_mu = column_of_slopes(local);
        let v_xx = column_of_slopes(ROW_FILTERED + local);
        let v_xy = column_of_slopes(2u * ROW_FILTERED + local);
        let v = v_mu + 2.0 * pick(color, channel) * v_xx + pick(wanted, channel) * v_xy;
        v_ssim = select(v_ssim, vec3(v), vec3(channel) == vec3(0u, 1u, 2u));
    }
    var l1 = 0.0;
    if exists {
        let w = weight(pixel);
        let off = color - wanted;
        let v_color = step.l1 * w * sign(off) - step.ssim * v_ssim;
        v_picture[pixel] = vec4(v_color, 0.0);
        totals[pixel] = dot(color, v_color);
        l1 = w * (abs(off.x) + abs(off.y) + abs(off.z));
    }
    let sum = workgroup_sum(local, l1);
    if local == 0u {
        sums[workgroup.y * groups.x + workgroup.x].y = sum;
    }
}
