// exposure and exposure_backward: a photo's gain and offset. Each thread sums pixels at a stride, a
// workgroup its threads in order, the host the groups. Follows shared.wgsl.

// Fourth components are unused except background's: 1 if the photo has alpha and keeps its background.
struct Exposure {
    gain: vec4<f32>,
    offset: vec4<f32>,
    // How a color grows with the transmittance.
    behind: vec4<f32>,
    background: vec4<f32>,
}

@group(0) @binding(0) var<uniform> view: View;
@group(0) @binding(1) var<uniform> exposed: Exposure;
// Colors (xyz) and transmittance (w).
@group(0) @binding(2) var<storage, read> picture: array<vec4<f32>>;
// Colors a photo has (xyz) and, from backward, the gradient of alpha (w).
@group(0) @binding(3) var<storage, read_write> corrected: array<vec4<f32>>;
// Gradients: of the corrected colors before, of the picture's after.
@group(0) @binding(4) var<storage, read_write> v_picture: array<vec4<f32>>;
// As rasterize_backward reads them.
@group(0) @binding(5) var<storage, read_write> totals: array<f32>;
// Per workgroup: sums of the gradients of gain, then of offset.
@group(0) @binding(6) var<storage, read_write> sums: array<f32>;

const THREADS = 64u;
const SUMS = 6u;

var<workgroup> partial_sums: array<f32, 384>; // SUMS THREADS

// A corrected pixel before the clamp.
fn raw(pixel: vec4<f32>) -> vec3<f32> {
    return exposed.gain.xyz * pixel.xyz + exposed.offset.xyz + pixel.w * exposed.behind.xyz;
}

@compute @workgroup_size(THREADS)
fn exposure(
    @builtin(workgroup_id) workgroup: vec3<u32>,
    @builtin(local_invocation_index) local: u32,
) {
    let pixels = view.width * view.height;
    for (var i = workgroup.x * THREADS + local; i < pixels; i += EXPOSURE_GROUPS * THREADS) {
        let pixel = picture[i];
        corrected[i] = vec4(clamp(raw(pixel), vec3(0.0), vec3(1.0)), pixel.w);
    }
}

@compute @workgroup_size(THREADS)
fn exposure_backward(
    @builtin(workgroup_id) workgroup: vec3<u32>,
    @builtin(local_invocation_index) local: u32,
) {
    let pixels = view.width * view.height;
    var v_gain = vec3(0.0);
    var v_offset = vec3(0.0);
    for (var i = workgroup.x * THREADS + local; i < pixels; i += EXPOSURE_GROUPS * THREADS) {
        let pixel = picture[i];
        let before = raw(pixel);
        let gradient = v_picture[i].xyz;
        // Gradients that would move a clamped color further out are dropped. Brackets, because "<" and
        // ">" in one expression open and close a template list.
        let over = (before > vec3(1.0)) & (gradient < vec3(0.0));
        let under = (before < vec3(0.0)) & (gradient > vec3(0.0));
        let leaves = over | under;
        let v = select(gradient, vec3(0.0), leaves);
        // The part of the pixel that the exposure does not change.
        let kept = pixel.w * exposed.background.w;
        v_gain += v * (pixel.xyz - kept * exposed.background.xyz);
        v_offset += v * (1.0 - kept);
        let v_color = exposed.gain.xyz * v;
        v_picture[i] = vec4(v_color, v_picture[i].w);
        let v_transmittance = dot(v, exposed.behind.xyz);
        corrected[i].w = -v_transmittance;
        totals[i] = dot(pixel.xyz, v_color) + pixel.w * v_transmittance;
    }
    for (var c = 0u; c < 3u; c++) {
        partial_sums[c * THREADS + local] = v_gain[c];
        partial_sums[(3u + c) * THREADS + local] = v_offset[c];
    }
    workgroupBarrier();
    if local < SUMS {
        var sum = 0.0;
        for (var k = 0u; k < THREADS; k++) {
            sum += partial_sums[local * THREADS + k];
        }
        sums[workgroup.x * SUMS + local] = sum;
    }
}
