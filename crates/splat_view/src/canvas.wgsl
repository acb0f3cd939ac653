// Copies the rasterizer's picture onto its columns of a canvas.

struct Place {
    // First column.
    begin: u32,
    // Number of columns.
    width: u32,
}

@group(0) @binding(0) var<uniform> place: Place;
// Color without background, and final transmittance.
@group(0) @binding(1) var<storage, read> picture: array<vec4<f32>>;

@vertex
fn cover(@builtin(vertex_index) vertex: u32) -> @builtin(position) vec4<f32> {
    // One triangle that is larger than the canvas.
    return vec4(f32(vertex & 1u) * 4.0 - 1.0, f32(vertex >> 1u) * 4.0 - 1.0, 0.0, 1.0);
}

@fragment
fn lay(@builtin(position) position: vec4<f32>) -> @location(0) vec4<f32> {
    let at = vec2<u32>(position.xy);
    let pixel = picture[at.y * place.width + at.x - place.begin];
    return vec4(pixel.rgb, 1.0 - pixel.a);
}
