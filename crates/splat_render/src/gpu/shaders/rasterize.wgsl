// rasterize: every tile's splats, front to back, to colors, depth and final transmittance. A
// thread owns four neighboring pixels of each of ROWS rows, so that a splat is read once for all of
// them. Follows shared.wgsl, tile_list.wgsl and tile_memory.wgsl or tile_subgroup.wgsl.

@group(0) @binding(0) var<uniform> view: View;
@group(0) @binding(1) var<uniform> chunk: Chunk;
@group(0) @binding(2) var<storage, read> splats2d: array<Splat2d>;
@group(0) @binding(3) var<storage, read> tile_begin: array<u32>;
@group(0) @binding(4) var<storage, read> splat_from_pair: array<u32>;
// Color over the background and final transmittance, row-major. If a tile's list continues in the next
// dispatch: color so far and transmittance, negative once the pixel has stopped.
@group(0) @binding(5) var<storage, read_write> picture: array<vec4<f32>>;
@group(0) @binding(6) var<storage, read_write> depths: array<f32>;

// In one row: llvmpipe fills its vectors along x alone.
const THREADS = 64u / ROWS;

// Four neighboring pixels.
struct Quad {
    live: vec4<bool>,
    transmittance: vec4<f32>,
    red: vec4<f32>,
    green: vec4<f32>,
    blue: vec4<f32>,
    depth: vec4<f32>,
}

// A pixel's state after the previous dispatch: `picture`, and the depth.
struct Kept {
    pixel: vec4<f32>,
    depth: f32,
}

// Pixels outside of the picture have stopped.
fn kept(x: u32, y: u32) -> Kept {
    if x < view.width && y < view.height {
        let pixel = y * view.width + x;
        return Kept(picture[pixel], depths[pixel]);
    }
    return Kept(vec4(0.0, 0.0, 0.0, -1.0), 0.0);
}

// Vectors are made whole: DX12's older compiler refuses stores to a component that a loop picks.
fn start(x: u32, y: u32) -> Quad {
    let exists = vec4(x, x + 1u, x + 2u, x + 3u) < vec4(view.width);
    var quad: Quad;
    quad.live = exists & vec4(y < view.height);
    quad.transmittance = vec4(1.0);
    if chunk.list_begin > 0u {
        let a = kept(x, y);
        let b = kept(x + 1u, y);
        let c = kept(x + 2u, y);
        let d = kept(x + 3u, y);
        let rows = transpose(mat4x4(a.pixel, b.pixel, c.pixel, d.pixel));
        quad.red = rows[0];
        quad.green = rows[1];
        quad.blue = rows[2];
        quad.transmittance = abs(rows[3]);
        quad.live = rows[3] > vec4(0.0);
        quad.depth = vec4(a.depth, b.depth, c.depth, d.depth);
    }
    return quad;
}

fn blend(quad: Quad, splat: Splat2d, p_dx: vec4<f32>, center_y: f32) -> Quad {
    let dy = center_y - splat.mean.y;
    let u = p_dx + splat.pq.y * dy;
    let v = splat.r * dy;
    let exponent = max(-0.5 * (u * u + v * v), vec4(-80.0));
    let alpha = min(splat.opacity * exp_accurate4(exponent), vec4(ALPHA_MAX));
    let next = quad.transmittance * (1.0 - alpha);
    let hit = quad.live & (alpha >= vec4(ALPHA_MIN));
    let stops = hit & (next < vec4(TRANSMITTANCE_MIN));
    let live = quad.live & !stops;
    let adds = hit & live;
    let weight = select(vec4(0.0), quad.transmittance * alpha, adds);
    return Quad(
        live,
        select(quad.transmittance, next, adds),
        quad.red + weight * splat.color.x,
        quad.green + weight * splat.color.y,
        quad.blue + weight * splat.color.z,
        quad.depth + weight * splat.depth,
    );
}

fn finish(quad: Quad, x: u32, y: u32, goes_on: bool) {
    let behind = select(quad.transmittance, vec4(0.0), goes_on);
    let red = quad.red + behind * view.background.x;
    let green = quad.green + behind * view.background.y;
    let blue = quad.blue + behind * view.background.z;
    let stopped = vec4(goes_on) & !quad.live;
    let transmittance = select(quad.transmittance, -quad.transmittance, stopped);
    for (var k = 0u; k < 4u; k++) {
        if x + k < view.width && y < view.height {
            let pixel = y * view.width + x + k;
            picture[pixel] = vec4(red[k], green[k], blue[k], transmittance[k]);
            depths[pixel] = quad.depth[k];
        }
    }
}

@compute @workgroup_size(THREADS)
fn rasterize(
    @builtin(workgroup_id) workgroup: vec3<u32>,
    @builtin(num_workgroups) groups: vec3<u32>,
    @builtin(local_invocation_index) thread: u32,
) {
    let list = tile_list(workgroup, groups);
    if !list.exists {
        return;
    }
    let tile = list.tile;
    let end = list.end;
    let goes_on = list.goes_on;
    let x = (tile % view.tiles_x) * TILE + 4u * (thread % 4u);
    let y = (tile / view.tiles_x) * TILE + ROWS * (thread / 4u);
    let center_x = f32(x) + vec4(0.5, 1.5, 2.5, 3.5);
    let center_y = f32(y) + 0.5;
    // A line with {row} stands once for each of the thread's rows: gpu/kernels repeats it. A loop over
    // an array of rows is not unrolled by every driver, and then lives in memory.
    var quad{row} = start(x, y + {row}u);
    var walking = true;
    for (var batch = list.begin; walking && batch < end; batch += AHEAD) {
        let ahead = read_ahead(batch, end, thread);
        for (var k = 0u; k < AHEAD && batch + k < end; k++) {
            let splat = splat_of(ahead, k);
            let p_dx = splat.pq.x * (center_x - splat.mean.x);
            var live = vec4(false);
            quad{row} = blend(quad{row}, splat, p_dx, center_y + {row}.0);
            live = live | quad{row}.live;
            walking = walks_on(any(live));
            if !walking {
                break;
            }
        }
    }
    finish(quad{row}, x, y + {row}u, goes_on);
}
