// loss: L1 and D-SSIM of the picture against a photo, with the picture's gradient. Two passes with
// the window's filter, which is separable and done in workgroup memory: first to the slopes of SSIM
// by the filtered maps, then back through the same filter. Follows shared.wgsl.

@group(0) @binding(0) var<uniform> view: View;
@group(0) @binding(1) var<uniform> step: Step;
@group(0) @binding(2) var<storage, read> picture: array<vec4<f32>>;
// RGBA, 8 bits each, straight alpha.
@group(0) @binding(3) var<storage, read> photo: array<u32>;
@group(0) @binding(4) var<storage, read> weights: array<f32>;
// Derivatives of the weighted SSIM sum by the filtered x, xx and xy: nine planes, by channel first.
@group(0) @binding(5) var<storage, read_write> slopes: array<f32>;
@group(0) @binding(6) var<storage, read_write> v_picture: array<vec4<f32>>;
@group(0) @binding(7) var<storage, read_write> totals: array<f32>;
// Per workgroup: weighted sums of SSIM and of |x - y|.
@group(0) @binding(8) var<storage, read_write> sums: array<vec2<f32>>;

const HALF = 5u;
const SPAN = 26u; // TILE + 2 HALF
const AREA = 676u; // SPAN * SPAN
const STRIP = 416u; // SPAN * TILE

// Maps with their margin (AREA each), then maps filtered along rows (STRIP each): two and five in
// loss_slopes, three and three in loss_gradient.
var<workgroup> tile: array<f32, 3432>;
const FILTERED_SLOPES = 1352u; // 2 AREA
const FILTERED_GRADIENT = 2028u; // 3 AREA

fn photo_color(pixel: u32) -> vec3<f32> {
    let rgba = unpack4x8unorm(photo[pixel]);
    return rgba.xyz * rgba.w + view.background * (1.0 - rgba.w);
}

fn weight(pixel: u32) -> f32 {
    if step.has_weights == 1u {
        return weights[pixel];
    }
    return 1.0;
}

// The pixel of an entry of `maps`, and whether it lies in the picture; outside counts as zero.
fn pixel_of(workgroup: vec3<u32>, entry: u32) -> vec2<u32> {
    let x = i32(workgroup.x * TILE + entry % SPAN) - i32(HALF);
    let y = i32(workgroup.y * TILE + entry / SPAN) - i32(HALF);
    let inside = x >= 0 && y >= 0 && x < i32(view.width) && y < i32(view.height);
    return select(vec2(0u), vec2(u32(y * i32(view.width) + x), 1u), inside);
}

// Sum over the workgroup in a fixed order; valid in thread 0. Overwrites the first map, which no
// thread reads any more once all have filtered it.
fn workgroup_sum(local: u32, value: f32) -> f32 {
    tile[local] = value;
    workgroupBarrier();
    var sum = 0.0;
    if local < 16u {
        for (var k = 0u; k < 16u; k++) {
            sum += tile[local * 16u + k];
        }
    }
    workgroupBarrier();
    tile[local] = sum;
    workgroupBarrier();
    sum = 0.0;
    if local == 0u {
        for (var k = 0u; k < 16u; k++) {
            sum += tile[k];
        }
    }
    return sum;
}

@compute @workgroup_size(16, 16)
fn loss_slopes(
    @builtin(workgroup_id) workgroup: vec3<u32>,
    @builtin(num_workgroups) groups: vec3<u32>,
    @builtin(local_invocation_id) id: vec3<u32>,
    @builtin(local_invocation_index) local: u32,
) {
    let x = workgroup.x * TILE + id.x;
    let y = workgroup.y * TILE + id.y;
    let exists = x < view.width && y < view.height;
    let pixel = select(0u, y * view.width + x, exists);
    let pixels = view.width * view.height;
    let w = weight(pixel);
    var ssim_sum = 0.0;
    for (var channel = 0u; channel < 3u; channel++) {
        for (var entry = local; entry < AREA; entry += 256u) {
            let at = pixel_of(workgroup, entry);
            let inside = at.y == 1u;
            tile[entry] = select(0.0, picture[at.x][channel], inside);
            tile[AREA + entry] = select(0.0, photo_color(at.x)[channel], inside);
        }
        workgroupBarrier();
        for (var entry = local; entry < STRIP; entry += 256u) {
            let begin = (entry / TILE) * SPAN + entry % TILE;
            var mu_x = 0.0;
            var mu_y = 0.0;
            var xx = 0.0;
            var yy = 0.0;
            var xy = 0.0;
            for (var k = 0u; k < 11u; k++) {
                let tap = SSIM_WINDOW[k];
                let a = tile[begin + k];
                let b = tile[AREA + begin + k];
                mu_x += tap * a;
                mu_y += tap * b;
                xx += tap * (a * a);
                yy += tap * (b * b);
                xy += tap * (a * b);
            }
            tile[FILTERED_SLOPES + entry] = mu_x;
            tile[FILTERED_SLOPES + STRIP + entry] = mu_y;
            tile[FILTERED_SLOPES + 2u * STRIP + entry] = xx;
            tile[FILTERED_SLOPES + 3u * STRIP + entry] = yy;
            tile[FILTERED_SLOPES + 4u * STRIP + entry] = xy;
        }
        workgroupBarrier();
        var f: array<f32, 5>;
        for (var map = 0u; map < 5u; map++) {
            for (var k = 0u; k < 11u; k++) {
                let entry = map * STRIP + (id.y + k) * TILE + id.x;
                f[map] += SSIM_WINDOW[k] * tile[FILTERED_SLOPES + entry];
            }
        }
        let mu_x = f[0];
        let mu_y = f[1];
        let squares = mu_x * mu_x + mu_y * mu_y;
        let a1 = 2.0 * mu_x * mu_y + SSIM_C1;
        let a2 = 2.0 * (f[4] - mu_x * mu_y) + SSIM_C2;
        let b1 = squares + SSIM_C1;
        let b2 = f[2] + f[3] - squares + SSIM_C2;
        let inverse = 1.0 / (b1 * b2);
        let ssim = a1 * a2 * inverse;
        let v_xx = -ssim * inverse * b1;
        let v_xy = 2.0 * a1 * inverse;
        // Directly, and through s_xx = xx - mu_x^2 and s_xy = xy - mu_x mu_y.
        let direct = mu_y * a2 * inverse - mu_x * ssim * inverse * b2;
        let through = 2.0 * v_xx * mu_x + v_xy * mu_y;
        if exists {
            slopes[(3u * channel) * pixels + pixel] = w * (2.0 * direct - through);
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

@compute @workgroup_size(16, 16)
fn loss_gradient(
    @builtin(workgroup_id) workgroup: vec3<u32>,
    @builtin(num_workgroups) groups: vec3<u32>,
    @builtin(local_invocation_id) id: vec3<u32>,
    @builtin(local_invocation_index) local: u32,
) {
    let x = workgroup.x * TILE + id.x;
    let y = workgroup.y * TILE + id.y;
    let exists = x < view.width && y < view.height;
    let pixel = select(0u, y * view.width + x, exists);
    let pixels = view.width * view.height;
    let w = weight(pixel);
    let color = picture[pixel].xyz;
    let wanted = photo_color(pixel);
    var v_color = vec3(0.0);
    for (var channel = 0u; channel < 3u; channel++) {
        for (var entry = local; entry < AREA; entry += 256u) {
            let at = pixel_of(workgroup, entry);
            for (var map = 0u; map < 3u; map++) {
                let slope = slopes[(3u * channel + map) * pixels + at.x];
                tile[map * AREA + entry] = select(0.0, slope, at.y == 1u);
            }
        }
        workgroupBarrier();
        for (var entry = local; entry < STRIP; entry += 256u) {
            let begin = (entry / TILE) * SPAN + entry % TILE;
            for (var map = 0u; map < 3u; map++) {
                var sum = 0.0;
                for (var k = 0u; k < 11u; k++) {
                    sum += SSIM_WINDOW[k] * tile[map * AREA + begin + k];
                }
                tile[FILTERED_GRADIENT + map * STRIP + entry] = sum;
            }
        }
        workgroupBarrier();
        var f: array<f32, 3>;
        for (var map = 0u; map < 3u; map++) {
            for (var k = 0u; k < 11u; k++) {
                let entry = map * STRIP + (id.y + k) * TILE + id.x;
                f[map] += SSIM_WINDOW[k] * tile[FILTERED_GRADIENT + entry];
            }
        }
        let v_ssim = f[0] + 2.0 * color[channel] * f[1] + wanted[channel] * f[2];
        v_color[channel] =
            step.l1 * w * sign(color[channel] - wanted[channel]) - step.ssim * v_ssim;
    }
    var l1_sum = 0.0;
    if exists {
        v_picture[pixel] = vec4(v_color, 0.0);
        totals[pixel] = dot(color, v_color);
        let off = abs(color - wanted);
        l1_sum = w * (off.x + off.y + off.z);
    }
    let sum = workgroup_sum(local, l1_sum);
    if local == 0u {
        sums[workgroup.y * groups.x + workgroup.x].y = sum;
    }
}
