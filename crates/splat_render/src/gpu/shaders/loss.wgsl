// loss: L1 and D-SSIM of the picture against a photo, with the picture's gradient. Two passes of a
// separable filter: to the slopes of SSIM by the filtered maps, then back. A thread filters four
// neighbors at once. The first pass writes derivatives of the weighted SSIM sum by the filtered x, xx and
// xy: nine planes, by channel first. Follows loss_pixels.wgsl.

const THREADS = 64u;
// Taps on each side of the window's center.
const HALF = 5;
// Values that four neighboring outputs need.
const SPAN = 14u;
// Rows of a tile with the window's margin.
const ROWS_FILTERED = 26u;
const STRIP = 416u; // ROWS_FILTERED * TILE

// Maps filtered along rows.
var<workgroup> filtered: array<f32, 2080>; // 5 STRIP
var<workgroup> partial_sums: array<f32, THREADS>;

fn exists(x: i32, y: i32) -> bool {
    return x >= 0 && y >= 0 && x < i32(view.width) && y < i32(view.height);
}

// Four rows of a filtered map at a column, filtered along the column.
fn column(map: u32, x: u32, y: u32) -> vec4<f32> {
    var sum = vec4(0.0);
    for (var k = 0u; k < SPAN; k++) {
        sum += SSIM_FOUR[k] * filtered[map * STRIP + (y + k) * TILE + x];
    }
    return sum;
}

fn store(map: u32, at: u32, values: vec4<f32>) {
    for (var k = 0u; k < 4u; k++) {
        filtered[map * STRIP + at + k] = values[k];
    }
}

// Sum over the workgroup in a fixed order; valid in thread 0.
fn workgroup_sum(local: u32, value: f32) -> f32 {
    partial_sums[local] = value;
    workgroupBarrier();
    var sum = 0.0;
    if local == 0u {
        for (var k = 0u; k < THREADS; k++) {
            sum += partial_sums[k];
        }
    }
    return sum;
}

@compute @workgroup_size(THREADS)
fn loss_slopes(
    @builtin(workgroup_id) workgroup: vec3<u32>,
    @builtin(num_workgroups) groups: vec3<u32>,
    @builtin(local_invocation_index) local: u32,
) {
    let pixels = view.width * view.height;
    let corner = vec2<i32>(workgroup.xy * TILE);
    let in_tile = vec2(local % TILE, local / TILE * 4u);
    var ssim_sum = 0.0;
    for (var channel = 0u; channel < 3u; channel++) {
        for (var task = local; task < ROWS_FILTERED * 4u; task += THREADS) {
            let x = corner.x + i32(task % 4u) * 4 - HALF;
            let y = corner.y + i32(task / 4u) - HALF;
            var mu_x = vec4(0.0);
            var mu_y = vec4(0.0);
            var xx = vec4(0.0);
            var yy = vec4(0.0);
            var xy = vec4(0.0);
            for (var k = 0u; k < SPAN; k++) {
                // Outside counts as zero.
                if exists(x + i32(k), y) {
                    let pixel = u32(y) * view.width + u32(x + i32(k));
                    let a = picture[pixel][channel];
                    let b = photo_color(pixel)[channel];
                    let tap = SSIM_FOUR[k];
                    mu_x += tap * a;
                    mu_y += tap * b;
                    xx += tap * (a * a);
                    yy += tap * (b * b);
                    xy += tap * (a * b);
                }
            }
            store(0u, task * 4u, mu_x);
            store(1u, task * 4u, mu_y);
            store(2u, task * 4u, xx);
            store(3u, task * 4u, yy);
            store(4u, task * 4u, xy);
        }
        workgroupBarrier();
        let mu_x = column(0u, in_tile.x, in_tile.y);
        let mu_y = column(1u, in_tile.x, in_tile.y);
        let xx = column(2u, in_tile.x, in_tile.y);
        let yy = column(3u, in_tile.x, in_tile.y);
        let xy = column(4u, in_tile.x, in_tile.y);
        let squares = mu_x * mu_x + mu_y * mu_y;
        let a1 = 2.0 * mu_x * mu_y + SSIM_C1;
        let a2 = 2.0 * (xy - mu_x * mu_y) + SSIM_C2;
        let b1 = squares + SSIM_C1;
        let b2 = xx + yy - squares + SSIM_C2;
        let inverse = 1.0 / (b1 * b2);
        let ssim = a1 * a2 * inverse;
        let v_xx = -ssim * inverse * b1;
        let v_xy = 2.0 * a1 * inverse;
        // Directly, and through s_xx = xx - mu_x^2 and s_xy = xy - mu_x mu_y.
        let direct = mu_y * a2 * inverse - mu_x * ssim * inverse * b2;
        let v_mu = 2.0 * direct - (2.0 * v_xx * mu_x + v_xy * mu_y);
        for (var k = 0u; k < 4u; k++) {
            let x = u32(corner.x) + in_tile.x;
            let y = u32(corner.y) + in_tile.y + k;
            if x < view.width && y < view.height {
                let pixel = y * view.width + x;
                let w = weight(pixel);
                slopes[(3u * channel) * pixels + pixel] = w * v_mu[k];
                slopes[(3u * channel + 1u) * pixels + pixel] = w * v_xx[k];
                slopes[(3u * channel + 2u) * pixels + pixel] = w * v_xy[k];
                ssim_sum += w * ssim[k];
            }
        }
        workgroupBarrier();
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
    let corner = vec2<i32>(workgroup.xy * TILE);
    let in_tile = vec2(local % TILE, local / TILE * 4u);
    // Per channel: gradient through SSIM of the filtered maps, four rows each.
    var v_mu: array<vec4<f32>, 3>;
    var v_xx: array<vec4<f32>, 3>;
    var v_xy: array<vec4<f32>, 3>;
    for (var channel = 0u; channel < 3u; channel++) {
        for (var task = local; task < ROWS_FILTERED * 4u; task += THREADS) {
            let x = corner.x + i32(task % 4u) * 4 - HALF;
            let y = corner.y + i32(task / 4u) - HALF;
            var mu = vec4(0.0);
            var xx = vec4(0.0);
            var xy = vec4(0.0);
            for (var k = 0u; k < SPAN; k++) {
                if exists(x + i32(k), y) {
                    let at = (3u * channel) * pixels + u32(y) * view.width + u32(x + i32(k));
                    let tap = SSIM_FOUR[k];
                    mu += tap * slopes[at];
                    xx += tap * slopes[at + pixels];
                    xy += tap * slopes[at + 2u * pixels];
                }
            }
            store(0u, task * 4u, mu);
            store(1u, task * 4u, xx);
            store(2u, task * 4u, xy);
        }
        workgroupBarrier();
        v_mu[channel] = column(0u, in_tile.x, in_tile.y);
        v_xx[channel] = column(1u, in_tile.x, in_tile.y);
        v_xy[channel] = column(2u, in_tile.x, in_tile.y);
        workgroupBarrier();
    }
    var l1_sum = 0.0;
    for (var k = 0u; k < 4u; k++) {
        let x = u32(corner.x) + in_tile.x;
        let y = u32(corner.y) + in_tile.y + k;
        if x < view.width && y < view.height {
            let pixel = y * view.width + x;
            let w = weight(pixel);
            let color = picture[pixel].xyz;
            let wanted = photo_color(pixel);
            let off = color - wanted;
            let v_ssim = vec3(v_mu[0][k], v_mu[1][k], v_mu[2][k])
                + 2.0 * color * vec3(v_xx[0][k], v_xx[1][k], v_xx[2][k])
                + wanted * vec3(v_xy[0][k], v_xy[1][k], v_xy[2][k]);
            let v_color = step.l1 * w * sign(off) - step.ssim * v_ssim;
            v_picture[pixel] = vec4(v_color, 0.0);
            totals[pixel] = dot(color, v_color);
            l1_sum += w * (abs(off.x) + abs(off.y) + abs(off.z));
        }
    }
    let sum = workgroup_sum(local, l1_sum);
    if local == 0u {
        sums[workgroup.y * groups.x + workgroup.x].y = sum;
    }
}
