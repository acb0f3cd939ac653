// depth_loss: relative difference of a picture's depth and a photo's; adds its gradients to the
// picture's. Each thread sums pixels at a stride, a workgroup its threads in order, the host the groups.
// Follows shared.wgsl.

struct DepthStep {
    // Weight of a pixel of confidence 1 in the loss.
    scale: f32,
}

@group(0) @binding(0) var<uniform> view: View;
@group(0) @binding(1) var<uniform> step: DepthStep;
// Colors (xyz) and transmittance (w).
@group(0) @binding(2) var<storage, read> picture: array<vec4<f32>>;
// Accumulated depths.
@group(0) @binding(3) var<storage, read> depths: array<f32>;
// The photo's depth and its confidence, 0 if unknown.
@group(0) @binding(4) var<storage, read> photo: array<vec2<f32>>;
// Gradients of color (xyz) and accumulated depth (w).
@group(0) @binding(5) var<storage, read_write> v_picture: array<vec4<f32>>;
// As rasterize_backward reads them.
@group(0) @binding(6) var<storage, read_write> totals: array<f32>;
// Per workgroup: sum of the loss.
@group(0) @binding(7) var<storage, read_write> sums: array<f32>;

const THREADS = 64u;

var<workgroup> partial_sums: array<f32, THREADS>;

@compute @workgroup_size(THREADS)
fn depth_loss(
    @builtin(workgroup_id) workgroup: vec3<u32>,
    @builtin(local_invocation_index) local: u32,
) {
    let pixels = view.width * view.height;
    var loss = 0.0;
    for (var i = workgroup.x * THREADS + local; i < pixels; i += DEPTH_GROUPS * THREADS) {
        let transmittance = picture[i].w;
        let alpha = 1.0 - transmittance;
        let depth = depths[i];
        let known = photo[i];
        if known.y > 0.0 && alpha >= DEPTH_ALPHA {
            let weight = step.scale * known.y;
            let expected = alpha * known.x;
            let inverse = 1.0 / (depth + expected);
            let difference = (depth - expected) * inverse;
            let slope = 4.0 * sign(difference) * inverse * inverse;
            let v_alpha = -weight * slope * depth * known.x;
            let v_depth = weight * slope * expected;
            loss += weight * 2.0 * abs(difference);
            v_picture[i].w = v_depth;
            totals[i] += depth * v_depth - transmittance * v_alpha;
        }
    }
    partial_sums[local] = loss;
    workgroupBarrier();
    if local == 0u {
        var sum = 0.0;
        for (var k = 0u; k < THREADS; k++) {
            sum += partial_sums[k];
        }
        sums[workgroup.x] = sum;
    }
}
