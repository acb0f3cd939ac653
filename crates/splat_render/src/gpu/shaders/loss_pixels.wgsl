// Bindings of the loss, and a photo's pixels. Follows shared.wgsl.

@group(0) @binding(0) var<uniform> view: View;
@group(0) @binding(1) var<uniform> step: Step;
@group(0) @binding(2) var<storage, read> picture: array<vec4<f32>>;
// RGBA, 8 bits each, straight alpha.
@group(0) @binding(3) var<storage, read> photo: array<u32>;
@group(0) @binding(4) var<storage, read> weights: array<f32>;
// Data between passes.
@group(0) @binding(5) var<storage, read_write> slopes: array<f32>;
@group(0) @binding(6) var<storage, read_write> v_picture: array<vec4<f32>>;
@group(0) @binding(7) var<storage, read_write> totals: array<f32>;
// Weighted sums of SSIM and of |x - y|, of a workgroup or of a line.
@group(0) @binding(8) var<storage, read_write> sums: array<vec2<f32>>;

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
