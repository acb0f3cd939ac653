// loss on software adapters, which pay much for a memory load and more for a barrier: a thread processes
// a whole column or row and keeps the window's eleven values in registers. The passes are: down the
// columns of the picture; along the rows of the result, to the slopes of SSIM and at once through the
// filter again; down the columns of that. Follows loss_pixels.wgsl.

const THREADS = 8u;
// Taps on each side of the window's center.
const HALF = 5u;
// Floats of a pixel between passes: filtered x, y, xx + yy and xy; then derivatives of the weighted SSIM
// sum by the filtered x, xx and xy.
const PLANES = 12u;

// The last eleven values, the oldest first.
struct Line {
    a: vec3<f32>,
    b: vec3<f32>,
    c: vec3<f32>,
    d: vec3<f32>,
    e: vec3<f32>,
    f: vec3<f32>,
    g: vec3<f32>,
    h: vec3<f32>,
    i: vec3<f32>,
    j: vec3<f32>,
    k: vec3<f32>,
}

fn push(line: ptr<function, Line>, value: vec3<f32>) {
    (*line).a = (*line).b;
    (*line).b = (*line).c;
    (*line).c = (*line).d;
    (*line).d = (*line).e;
    (*line).e = (*line).f;
    (*line).f = (*line).g;
    (*line).g = (*line).h;
    (*line).h = (*line).i;
    (*line).i = (*line).j;
    (*line).j = (*line).k;
    (*line).k = value;
}

// The filter at the value HALF before the newest.
fn filtered(line: ptr<function, Line>) -> vec3<f32> {
    return SSIM_TAP_0 * ((*line).a + (*line).k) + SSIM_TAP_1 * ((*line).b + (*line).j)
        + SSIM_TAP_2 * ((*line).c + (*line).i) + SSIM_TAP_3 * ((*line).d + (*line).h)
        + SSIM_TAP_4 * ((*line).e + (*line).g) + SSIM_TAP_5 * (*line).f;
}

fn load(pixel: u32, map: u32) -> vec3<f32> {
    let at = pixel * PLANES + 3u * map;
    return vec3(slopes[at], slopes[at + 1u], slopes[at + 2u]);
}

fn store(pixel: u32, map: u32, value: vec3<f32>) {
    let at = pixel * PLANES + 3u * map;
    slopes[at] = value.x;
    slopes[at + 1u] = value.y;
    slopes[at + 2u] = value.z;
}

@compute @workgroup_size(THREADS)
fn loss_columns(@builtin(global_invocation_id) id: vec3<u32>) {
    let x = id.x;
    if x >= view.width {
        return;
    }
    var means_x = Line();
    var means_y = Line();
    var squares = Line();
    var products = Line();
    for (var y = 0u; y < view.height + HALF; y++) {
        // Outside counts as zero.
        var a = vec3(0.0);
        var b = vec3(0.0);
        if y < view.height {
            let pixel = y * view.width + x;
            a = picture[pixel].xyz;
            b = photo_color(pixel);
        }
        push(&means_x, a);
        push(&means_y, b);
        push(&squares, a * a + b * b);
        push(&products, a * b);
        if y >= HALF {
            let pixel = (y - HALF) * view.width + x;
            store(pixel, 0u, filtered(&means_x));
            store(pixel, 1u, filtered(&means_y));
            store(pixel, 2u, filtered(&squares));
            store(pixel, 3u, filtered(&products));
        }
    }
}

@compute @workgroup_size(THREADS)
fn loss_rows(@builtin(global_invocation_id) id: vec3<u32>) {
    let y = id.x;
    if y >= view.height {
        return;
    }
    let row = y * view.width;
    var means_x = Line();
    var means_y = Line();
    var squares = Line();
    var products = Line();
    var slopes_mu = Line();
    var slopes_xx = Line();
    var slopes_xy = Line();
    var ssim_sum = 0.0;
    for (var x = 0u; x < view.width + 2u * HALF; x++) {
        var a = vec3(0.0);
        var b = vec3(0.0);
        var c = vec3(0.0);
        var d = vec3(0.0);
        if x < view.width {
            a = load(row + x, 0u);
            b = load(row + x, 1u);
            c = load(row + x, 2u);
            d = load(row + x, 3u);
        }
        push(&means_x, a);
        push(&means_y, b);
        push(&squares, c);
        push(&products, d);
        var v_mu = vec3(0.0);
        var v_xx = vec3(0.0);
        var v_xy = vec3(0.0);
        if x >= HALF && x < view.width + HALF {
            let mu_x = filtered(&means_x);
            let mu_y = filtered(&means_y);
            let mu_squares = mu_x * mu_x + mu_y * mu_y;
            let a1 = 2.0 * mu_x * mu_y + SSIM_C1;
            let a2 = 2.0 * (filtered(&products) - mu_x * mu_y) + SSIM_C2;
            let b1 = mu_squares + SSIM_C1;
            let b2 = filtered(&squares) - mu_squares + SSIM_C2;
            let inverse = 1.0 / (b1 * b2);
            let ssim = a1 * a2 * inverse;
            let w = weight(row + x - HALF);
            v_xx = -ssim * inverse * b1;
            v_xy = 2.0 * a1 * inverse;
            // Directly, and through s_xx = xx - mu_x^2 and s_xy = xy - mu_x mu_y.
            let direct = mu_y * a2 * inverse - mu_x * ssim * inverse * b2;
            v_mu = w * (2.0 * direct - (2.0 * v_xx * mu_x + v_xy * mu_y));
            v_xx *= w;
            v_xy *= w;
            ssim_sum += w * (ssim.x + ssim.y + ssim.z);
        }
        push(&slopes_mu, v_mu);
        push(&slopes_xx, v_xx);
        push(&slopes_xy, v_xy);
        if x >= 2u * HALF {
            // Read before: this thread is far ahead in its row.
            let pixel = row + x - 2u * HALF;
            store(pixel, 0u, filtered(&slopes_mu));
            store(pixel, 1u, filtered(&slopes_xx));
            store(pixel, 2u, filtered(&slopes_xy));
        }
    }
    sums[y].x = ssim_sum;
    if y >= view.width {
        sums[y].y = 0.0;
    }
}

@compute @workgroup_size(THREADS)
fn loss_columns_gradient(@builtin(global_invocation_id) id: vec3<u32>) {
    let x = id.x;
    if x >= view.width {
        return;
    }
    var slopes_mu = Line();
    var slopes_xx = Line();
    var slopes_xy = Line();
    var l1_sum = 0.0;
    for (var y = 0u; y < view.height + HALF; y++) {
        var a = vec3(0.0);
        var b = vec3(0.0);
        var c = vec3(0.0);
        if y < view.height {
            let pixel = y * view.width + x;
            a = load(pixel, 0u);
            b = load(pixel, 1u);
            c = load(pixel, 2u);
        }
        push(&slopes_mu, a);
        push(&slopes_xx, b);
        push(&slopes_xy, c);
        if y >= HALF {
            let pixel = (y - HALF) * view.width + x;
            let w = weight(pixel);
            let color = picture[pixel].xyz;
            let wanted = photo_color(pixel);
            let off = color - wanted;
            let v_ssim = filtered(&slopes_mu) + 2.0 * color * filtered(&slopes_xx)
                + wanted * filtered(&slopes_xy);
            let v_color = step.l1 * w * sign(off) - step.ssim * v_ssim;
            v_picture[pixel] = vec4(v_color, 0.0);
            totals[pixel] = dot(color, v_color);
            l1_sum += w * (abs(off.x) + abs(off.y) + abs(off.z));
        }
    }
    sums[x].y = l1_sum;
    if x >= view.height {
        sums[x].x = 0.0;
    }
}
