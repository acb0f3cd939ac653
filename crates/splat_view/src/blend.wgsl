// Draws each splat as a quad, blended back to front. Follows splat_render's shared.wgsl.

struct Style {
    // Rows of the world-to-camera matrix.
    world_to_camera: array<vec4<f32>, 3>,
    // The picture in pixels.
    size: vec2<f32>,
    // As Display in display.rs.
    display: u32,
    // Depths are divided by it, so that half floats hold them.
    depth_unit: f32,
    // Radius of points, in pixels.
    radius: f32,
}

const SPLATS = 0u;
const POINTS = 1u;
const ELLIPSES = 2u;
const DEPTH = 3u;
const NORMALS = 4u;

// Radius of an ellipse's edge, in standard deviations.
const ELLIPSE = 1.5;

@group(0) @binding(0) var<uniform> style: Style;
@group(0) @binding(1) var<storage, read> splats2d: array<Splat2d>;
@group(0) @binding(2) var<storage, read> order: array<u32>;
@group(0) @binding(3) var<storage, read> geometry: array<f32>;
// Vertices and instances of the draw of all splats in `order`.
@group(0) @binding(4) var<storage, read> quads: array<u32, 4>;

struct Corner {
    @builtin(position) position: vec4<f32>,
    // Place relative to the center, in standard deviations; for points in radii.
    @location(0) whitened: vec2<f32>,
    @location(1) @interpolate(flat) color: vec3<f32>,
    @location(2) @interpolate(flat) opacity: f32,
}

// The shortest axis of a splat, turned to the camera, in camera axes.
fn normal(i: u32) -> vec3<f32> {
    let row = i * GEOMETRY;
    let scales = vec3(geometry[row + 3u], geometry[row + 4u], geometry[row + 5u]);
    let q = vec4(
        geometry[row + 6u], geometry[row + 7u], geometry[row + 8u], geometry[row + 9u]
    );
    var axis = vec3(0.0, 0.0, 1.0);
    if scales.x <= scales.y && scales.x <= scales.z {
        axis = vec3(1.0, 0.0, 0.0);
    } else if scales.y <= scales.z {
        axis = vec3(0.0, 1.0, 0.0);
    }
    let unit = q / length(q);
    let twice = 2.0 * cross(unit.yzw, axis);
    let world = axis + unit.x * twice + cross(unit.yzw, twice);
    let mean = vec4(geometry[row], geometry[row + 1u], geometry[row + 2u], 1.0);
    let m = style.world_to_camera;
    let at = vec3(dot(m[0], mean), dot(m[1], mean), dot(m[2], mean));
    let n = vec3(dot(m[0].xyz, world), dot(m[1].xyz, world), dot(m[2].xyz, world));
    return select(n, -n, dot(n, at) > 0.0);
}

@vertex
fn corner(@builtin(vertex_index) vertex: u32, @builtin(instance_index) instance: u32) -> Corner {
    let i = order[quads[1] - 1u - instance];
    let splat = splats2d[i];
    var out: Corner;
    // Four equal corners cover nothing.
    out.position = vec4(0.0, 0.0, 0.0, 1.0);
    if splat.opacity <= ALPHA_MIN {
        return out;
    }
    let side = vec2(f32(vertex & 1u), f32(vertex >> 1u)) * 2.0 - 1.0;
    var offset = side * style.radius;
    out.whitened = side;
    if style.display != POINTS {
        // Beyond it alpha is below ALPHA_MIN.
        var reach = sqrt(2.0 * log(splat.opacity / ALPHA_MIN) * 1.0001 + 1e-3);
        if style.display == ELLIPSES {
            reach = ELLIPSE;
        }
        out.whitened = side * reach;
        let dy = out.whitened.y / splat.r;
        offset = vec2((out.whitened.x - splat.pq.y * dy) / splat.pq.x, dy);
    }
    let pixel = (splat.mean + offset) / style.size;
    out.position = vec4(2.0 * pixel.x - 1.0, 1.0 - 2.0 * pixel.y, 0.0, 1.0);
    out.opacity = splat.opacity;
    out.color = splat.color;
    if style.display == DEPTH {
        out.color = vec3(splat.depth / style.depth_unit);
    } else if style.display == NORMALS {
        let n = normal(i);
        // Right is red, up green, towards the camera blue.
        out.color = vec3(0.5 + 0.5 * n.x, 0.5 - 0.5 * n.y, 0.5 - 0.5 * n.z);
    }
    return out;
}

@fragment
fn shade(in: Corner) -> @location(0) vec4<f32> {
    let square = dot(in.whitened, in.whitened);
    if style.display == POINTS {
        if square > 1.0 {
            discard;
        }
        return vec4(in.color, 1.0);
    }
    if style.display == ELLIPSES {
        if square > ELLIPSE * ELLIPSE {
            discard;
        }
        // Darker towards the rim, to separate neighbors.
        return vec4(in.color * (1.0 - 0.7 * square / (ELLIPSE * ELLIPSE)), 1.0);
    }
    let alpha = min(in.opacity * exp(-0.5 * square), ALPHA_MAX);
    if alpha < ALPHA_MIN {
        discard;
    }
    return vec4(in.color * alpha, alpha);
}
