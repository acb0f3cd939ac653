// Composes one or two canvases over the background; the first is left of the divider.

struct Look {
    background: vec3<f32>,
    // First pixel column of the second canvas.
    divider: f32,
    // 1 if the canvases hold depths, shown from `depth_near` to `depth_far`.
    is_depth: u32,
    depth_near: f32,
    depth_far: f32,
}

@group(0) @binding(0) var<uniform> look: Look;
@group(0) @binding(1) var left: texture_2d<f32>;
@group(0) @binding(2) var right: texture_2d<f32>;

@vertex
fn cover(@builtin(vertex_index) vertex: u32) -> @builtin(position) vec4<f32> {
    // One triangle that is larger than the picture.
    return vec4(f32(vertex & 1u) * 4.0 - 1.0, f32(vertex >> 1u) * 4.0 - 1.0, 0.0, 1.0);
}

// Near is light and warm, far dark and cold; evenly darker in between.
fn depth_color(part: f32) -> vec3<f32> {
    var stops = array(
        vec3(1.0, 0.96, 0.80),
        vec3(0.98, 0.72, 0.35),
        vec3(0.80, 0.35, 0.35),
        vec3(0.40, 0.18, 0.48),
        vec3(0.06, 0.06, 0.24),
    );
    let at = clamp(part, 0.0, 1.0) * 4.0;
    let stop = min(u32(at), 3u);
    return mix(stops[stop], stops[stop + 1u], at - f32(stop));
}

@fragment
fn compose(@builtin(position) position: vec4<f32>) -> @location(0) vec4<f32> {
    let pixel = vec2<i32>(position.xy);
    var texel = textureLoad(left, pixel, 0);
    if position.x >= look.divider {
        texel = textureLoad(right, pixel, 0);
    }
    var color = texel.rgb;
    if look.is_depth == 1u && texel.a > 0.0 {
        let depth = texel.r / texel.a;
        color = texel.a * depth_color((depth - look.depth_near) / (look.depth_far - look.depth_near));
    }
    return vec4(color + (1.0 - texel.a) * look.background, 1.0);
}
