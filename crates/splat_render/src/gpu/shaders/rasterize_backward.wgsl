// rasterize_backward: gradients of the picture to a gradient per (splat, tile) pair, each in a separate
// slot. Walks front to back like rasterize, so that both round and stop alike; the light behind the
// current splat is the pixel's total minus the light so far. Follows shared.wgsl, backward_pixels.wgsl,
// tile_list.wgsl and tile_memory.wgsl with tile_sums_memory.wgsl, or their variants for subgroups.

// In one row: llvmpipe fills its vectors along x alone.
const THREADS = 64u / ROWS;

// Four neighboring pixels.
struct Quad {
    center_x: vec4<f32>,
    center_y: f32,
    live: vec4<bool>,
    transmittance: vec4<f32>,
    // Sum over the remaining splats of weight times value times gradient.
    remaining: vec4<f32>,
    v_red: vec4<f32>,
    v_green: vec4<f32>,
    v_blue: vec4<f32>,
    v_depth: vec4<f32>,
}

struct Sums {
    u: vec4<f32>,
    v: vec4<f32>,
    uu: vec4<f32>,
    uv: vec4<f32>,
    vv: vec4<f32>,
    depth: vec4<f32>,
    red: vec4<f32>,
    green: vec4<f32>,
    blue: vec4<f32>,
    opacity: vec4<f32>,
    absolute_x: vec4<f32>,
    absolute_y: vec4<f32>,
}

// Vectors are made whole, as in rasterize.
fn load_quad(x: u32, y: u32) -> Quad {
    let a = pixel_at(x, y);
    let b = pixel_at(x + 1u, y);
    let c = pixel_at(x + 2u, y);
    let d = pixel_at(x + 3u, y);
    let rows = transpose(mat4x4(gradient_of(a), gradient_of(b), gradient_of(c), gradient_of(d)));
    let transmittance =
        vec4(transmittance_of(a), transmittance_of(b), transmittance_of(c), transmittance_of(d));
    var quad: Quad;
    quad.center_x = f32(x) + vec4(0.5, 1.5, 2.5, 3.5);
    quad.center_y = f32(y) + 0.5;
    quad.live = transmittance > vec4(0.0);
    quad.transmittance = abs(transmittance);
    quad.remaining = vec4(total_of(a), total_of(b), total_of(c), total_of(d));
    quad.v_red = rows[0];
    quad.v_green = rows[1];
    quad.v_blue = rows[2];
    quad.v_depth = rows[3];
    return quad;
}

fn accumulate(quad: ptr<function, Quad>, splat: Splat2d, sums: ptr<function, Sums>) {
    let dy = (*quad).center_y - splat.mean.y;
    let u = splat.pq.x * ((*quad).center_x - splat.mean.x) + splat.pq.y * dy;
    let v = splat.r * dy;
    let exponent = max(-0.5 * (u * u + v * v), vec4(-80.0));
    let gaussian = exp_accurate4(exponent);
    let uncapped = splat.opacity * gaussian;
    let alpha = min(uncapped, vec4(ALPHA_MAX));
    let transmittance = (*quad).transmittance;
    let next = transmittance * (1.0 - alpha);
    let hit = (*quad).live & (alpha >= vec4(ALPHA_MIN));
    let stops = hit & (next < vec4(TRANSMITTANCE_MIN));
    let live = (*quad).live & !stops;
    let adds = hit & live;
    let weight = select(vec4(0.0), transmittance * alpha, adds);
    let own = splat.color.x * (*quad).v_red + splat.color.y * (*quad).v_green
        + splat.color.z * (*quad).v_blue + splat.depth * (*quad).v_depth;
    let remaining = (*quad).remaining - weight * own;
    // The cap has no slope.
    let differs = adds & (uncapped <= vec4(ALPHA_MAX));
    let v_alpha = select(
        vec4(0.0),
        transmittance * own - remaining / (1.0 - alpha),
        differs,
    );
    let g = -alpha * v_alpha;
    let gu = g * u;
    let gv = g * v;
    (*sums).u += gu;
    (*sums).v += gv;
    (*sums).uu += gu * u;
    (*sums).uv += gu * v;
    (*sums).vv += gv * v;
    (*sums).depth += weight * (*quad).v_depth;
    (*sums).red += weight * (*quad).v_red;
    (*sums).green += weight * (*quad).v_green;
    (*sums).blue += weight * (*quad).v_blue;
    (*sums).opacity += gaussian * v_alpha;
    if SUMS == GRADIENT_ABSOLUTE {
        (*sums).absolute_x += abs(gu);
        (*sums).absolute_y += abs(splat.pq.y * gu + splat.r * gv);
    }
    (*quad).live = live;
    (*quad).remaining = remaining;
    (*quad).transmittance = select(transmittance, next, adds);
}

// For the dispatch that goes on with the list.
fn keep(quad: Quad, x: u32, y: u32) {
    for (var k = 0u; k < 4u; k++) {
        if x + k < view.width && y < view.height {
            let pixel = y * view.width + x + k;
            totals[pixel] = quad.remaining[k];
            transmittances[pixel] =
                select(-quad.transmittance[k], quad.transmittance[k], quad.live[k]);
        }
    }
}

@compute @workgroup_size(THREADS)
fn rasterize_backward(
    @builtin(workgroup_id) workgroup: vec3<u32>,
    @builtin(num_workgroups) groups: vec3<u32>,
    @builtin(local_invocation_index) thread: u32,
) {
    let list = tile_list(workgroup, groups);
    if !list.exists {
        return;
    }
    let tile = list.tile;
    let begin = list.begin;
    let end = list.end;
    let x = (tile % view.tiles_x) * TILE + 4u * (thread % 4u);
    let y = (tile / view.tiles_x) * TILE + ROWS * (thread / 4u);
    // A line with {row} stands once for each of the thread's rows, as in rasterize.
    var quad{row} = load_quad(x, y + {row}u);
    var written = begin;
    for (var batch = begin; batch < end; batch += BATCH) {
        let count = min(BATCH, end - batch);
        var ahead = read_ahead(batch, end, thread);
        for (var b = 0u; b < count; b++) {
            if AHEAD == 1u {
                ahead = read_ahead(batch + b, end, thread);
            }
            let splat = splat_of(ahead, b);
            var sums = Sums();
            accumulate(&quad{row}, splat, &sums);
            keep_sum(b, 0u, total(sums.u), thread);
            keep_sum(b, 1u, total(sums.v), thread);
            keep_sum(b, 2u, total(sums.uu), thread);
            keep_sum(b, 3u, total(sums.uv), thread);
            keep_sum(b, 4u, total(sums.vv), thread);
            keep_sum(b, 5u, total(sums.depth), thread);
            keep_sum(b, 6u, total(sums.red), thread);
            keep_sum(b, 7u, total(sums.green), thread);
            keep_sum(b, 8u, total(sums.blue), thread);
            keep_sum(b, 9u, total(sums.opacity), thread);
            if SUMS == GRADIENT_ABSOLUTE {
                keep_sum(b, 10u, total(sums.absolute_x), thread);
                keep_sum(b, 11u, total(sums.absolute_y), thread);
            }
        }
        var live = vec4(false);
        live = live | quad{row}.live;
        written = batch + count;
        if !write_sums(batch, count, any(live), thread) {
            break;
        }
    }
    // Slots after the tile's early stop and, for the last tile, after all tiles.
    write_zeros(written, end, thread);
    if tile + 1u == chunk.tile_end && chunk.list_begin == 0u {
        write_zeros(tile_begin[list.index + 1u], tile_begin[list.index + 2u], thread);
    }
    if list.goes_on {
        keep(quad{row}, x, y + {row}u);
    }
}
