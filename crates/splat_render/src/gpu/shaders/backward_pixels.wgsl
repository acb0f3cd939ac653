// Bindings and pixels of rasterize_backward, for rows and for blocks. Follows shared.wgsl
// and SUMS; a later file declares THREADS.

@group(0) @binding(0) var<uniform> view: View;
@group(0) @binding(1) var<uniform> chunk: Chunk;
@group(0) @binding(2) var<storage, read> splats2d: array<Splat2d>;
@group(0) @binding(3) var<storage, read> tile_begin: array<u32>;
@group(0) @binding(4) var<storage, read> splat_from_pair: array<u32>;
@group(0) @binding(5) var<storage, read> slot_from_pair: array<u32>;
// Gradients of color (xyz) and accumulated depth (w).
@group(0) @binding(6) var<storage, read> v_picture: array<vec4<f32>>;
// Per pixel: color . v_color + depth v_depth - transmittance v_alpha, background included; minus the
// light so far if a tile's list continues in the next dispatch.
@group(0) @binding(7) var<storage, read_write> totals: array<f32>;
// SUMS floats per slot: sums of g u, g v, g u^2, g u v, g v^2 with g the gradient of sigma, then depth,
// color 3, opacity, and on request the absolute gradients of the mean: |g u| (times p for x) and the one
// for y.
@group(0) @binding(8) var<storage, read_write> slots: array<f32>;
// Between such dispatches: transmittance, negative once the pixel has stopped.
@group(0) @binding(9) var<storage, read_write> transmittances: array<f32>;

// A pixel's place in the picture, or UINT_MAX outside.
fn pixel_at(x: u32, y: u32) -> u32 {
    return select(0xffffffffu, y * view.width + x, x < view.width && y < view.height);
}

fn gradient_of(pixel: u32) -> vec4<f32> {
    if pixel == 0xffffffffu {
        return vec4(0.0);
    }
    return v_picture[pixel];
}

fn total_of(pixel: u32) -> f32 {
    if pixel == 0xffffffffu {
        return 0.0;
    }
    return totals[pixel];
}

// Negative once the pixel has stopped, and outside the picture.
fn transmittance_of(pixel: u32) -> f32 {
    if pixel == 0xffffffffu {
        return -1.0;
    }
    if chunk.list_begin == 0u {
        return 1.0;
    }
    return transmittances[pixel];
}

// Empties the slots of these pairs.
fn write_zeros(begin: u32, end: u32, thread: u32) {
    for (var pair = begin + thread; pair < end; pair += THREADS) {
        let slot = slot_from_pair[pair] * SUMS;
        for (var entry = 0u; entry < SUMS; entry++) {
            slots[slot + entry] = 0.0;
        }
    }
}

fn total(x: vec4<f32>) -> f32 {
    return (x.x + x.y) + (x.z + x.w);
}
