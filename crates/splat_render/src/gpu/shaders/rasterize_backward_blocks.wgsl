// rasterize_backward for GPUs: as rasterize_backward.wgsl, with threads in two roles. For ITEMS splats at a
// time, a thread first walks them for its pixel and leaves two numbers each; then it adds up four pixels
// of one splat. Sums have a fixed order. Follows shared.wgsl, backward_pixels.wgsl, tile_list.wgsl,
// bin_tiles.wgsl and tile_blocks.wgsl.

const BATCH = 32u;
const ITEMS = 4u;
// `touched` has one word for each block.
const_assert WORDS == 1u;
// Threads of a block that add up one splat.
const PARTS = 32u / ITEMS;
// One more than a block's threads, so that a column's entries lie in different memory banks.
const STRIDE = 33u;

// First [block][weight and g of an item][pixel], then [block][entry][thread].
var<workgroup> partials: array<f32, BLOCKS * SUMS * STRIDE>;
var<workgroup> any_live: u32;
// [batch even or odd][block]: 1 if a pixel is live when the batch begins.
var<workgroup> live_blocks: array<u32, 2u * BLOCKS>;

struct Pixel {
    center: vec2<f32>,
    v: vec4<f32>,
    live: bool,
    transmittance: f32,
    // Sum over the remaining splats of weight times value times gradient.
    remaining: f32,
}

// Four neighboring pixels.
struct Quad {
    center_x: vec4<f32>,
    center_y: f32,
    v_red: vec4<f32>,
    v_green: vec4<f32>,
    v_blue: vec4<f32>,
    v_depth: vec4<f32>,
}

// The splat's weight at the pixel, and g = -alpha v_alpha.
fn walk(pixel: ptr<function, Pixel>, splat: Splat2d) -> vec2<f32> {
    let dy = (*pixel).center.y - splat.mean.y;
    let u = splat.pq.x * ((*pixel).center.x - splat.mean.x) + splat.pq.y * dy;
    let v = splat.r * dy;
    let exponent = max(-0.5 * (u * u + v * v), -80.0);
    let uncapped = splat.opacity * exp_accurate(exponent);
    let alpha = min(uncapped, ALPHA_MAX);
    let transmittance = (*pixel).transmittance;
    let next = transmittance * (1.0 - alpha);
    if !((*pixel).live && alpha >= ALPHA_MIN) {
        return vec2(0.0);
    }
    if next < TRANSMITTANCE_MIN {
        (*pixel).live = false;
        return vec2(0.0);
    }
    let weight = transmittance * alpha;
    let v_pixel = (*pixel).v;
    let own = splat.color.x * v_pixel.x + splat.color.y * v_pixel.y + splat.color.z * v_pixel.z
        + splat.depth * v_pixel.w;
    let remaining = (*pixel).remaining - weight * own;
    (*pixel).remaining = remaining;
    (*pixel).transmittance = next;
    // The cap has no slope.
    let v_alpha = select(0.0, transmittance * own - remaining / (1.0 - alpha), uncapped <= ALPHA_MAX);
    return vec2(weight, -alpha * v_alpha);
}

// Four floats from `at`.
fn four(at: u32) -> vec4<f32> {
    return vec4(partials[at], partials[at + 1u], partials[at + 2u], partials[at + 3u]);
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
    let block = thread / 32u;
    let lane = thread % 32u;
    let corner = block_corner(tile, block);
    let at = corner + vec2(lane % 8u, lane / 8u);
    let index = pixel_at(at.x, at.y);
    // A list continues in another dispatch on software drivers alone.
    let before = transmittance_of(index);
    var pixel = Pixel(
        vec2<f32>(at) + 0.5, gradient_of(index), before > 0.0, abs(before), total_of(index),
    );
    // In the second role: an item, and four of the block's pixels.
    let item = lane / PARTS;
    let part = lane % PARTS;
    let x = corner.x + 4u * (part % 2u);
    let y = corner.y + part / 2u;
    let rows = transpose(mat4x4(
        gradient_of(pixel_at(x, y)),
        gradient_of(pixel_at(x + 1u, y)),
        gradient_of(pixel_at(x + 2u, y)),
        gradient_of(pixel_at(x + 3u, y)),
    ));
    let quad = Quad(
        f32(x) + vec4(0.5, 1.5, 2.5, 3.5), f32(y) + 0.5, rows[0], rows[1], rows[2], rows[3],
    );
    // In the third: an entry of a splat's slot.
    let entry = thread % SUMS;
    let entry_item = thread / SUMS;
    let block_partials = block * SUMS * STRIDE;
    clear_touched(0u, thread);
    if thread < BLOCKS {
        live_blocks[thread] = 1u;
    }
    workgroupBarrier();
    var odd = 0u;
    var written = begin;
    for (var batch = begin; batch < end; batch += BATCH) {
        let count = min(BATCH, end - batch);
        if thread == 0u {
            any_live = 0u;
        }
        if thread < BLOCKS {
            live_blocks[(1u - odd) * BLOCKS + thread] = 0u;
        }
        if thread < count {
            stage(batch + thread, thread, tile, odd);
        }
        workgroupBarrier();
        clear_touched(1u - odd, thread);
        let block_bits = select(0u, atomicLoad(&touched[odd * BLOCKS + block]), live_blocks[odd * BLOCKS + block] == 1u);
        for (var first = 0u; first < count; first += ITEMS) {
            let touching = (block_bits >> first) & ((1u << ITEMS) - 1u);
            for (var rest = touching; rest != 0u; rest &= rest - 1u) {
                let k = firstTrailingBit(rest);
                let values = walk(&pixel, staged(first + k));
                partials[block_partials + 2u * k * STRIDE + lane] = values.x;
                partials[block_partials + (2u * k + 1u) * STRIDE + lane] = values.y;
            }
            workgroupBarrier();
            let is_touching = ((touching >> item) & 1u) == 1u;
            // Entries 0 to 3, 4 to 7, 8 and 9, and the absolute gradients.
            var low = vec4(0.0);
            var middle = vec4(0.0);
            var high = vec2(0.0);
            var absolute = vec2(0.0);
            if is_touching {
                let splat = staged(first + item);
                let values = block_partials + 2u * item * STRIDE + 4u * part;
                let weight = four(values);
                let g = four(values + STRIDE);
                let dy = quad.center_y - splat.mean.y;
                let u = splat.pq.x * (quad.center_x - splat.mean.x) + splat.pq.y * dy;
                let v = splat.r * dy;
                let gu = g * u;
                let gv = g * v;
                low = vec4(total(gu), total(gv), total(gu * u), total(gu * v));
                middle = vec4(
                    total(gv * v), total(weight * quad.v_depth), total(weight * quad.v_red),
                    total(weight * quad.v_green),
                );
                // If g is not 0, alpha is opacity times the Gaussian.
                high = vec2(total(weight * quad.v_blue), -total(g) / splat.opacity);
                if SUMS == GRADIENT_ABSOLUTE {
                    absolute = vec2(total(abs(gu)), total(abs(splat.pq.y * gu + splat.r * gv)));
                }
            }
            workgroupBarrier();
            if is_touching {
                let own = block_partials + lane;
                partials[own] = low.x;
                partials[own + STRIDE] = low.y;
                partials[own + 2u * STRIDE] = low.z;
                partials[own + 3u * STRIDE] = low.w;
                partials[own + 4u * STRIDE] = middle.x;
                partials[own + 5u * STRIDE] = middle.y;
                partials[own + 6u * STRIDE] = middle.z;
                partials[own + 7u * STRIDE] = middle.w;
                partials[own + 8u * STRIDE] = high.x;
                partials[own + 9u * STRIDE] = high.y;
                if SUMS == GRADIENT_ABSOLUTE {
                    partials[own + (SUMS - 2u) * STRIDE] = absolute.x;
                    partials[own + (SUMS - 1u) * STRIDE] = absolute.y;
                }
            }
            workgroupBarrier();
            let k = first + entry_item;
            if entry_item < ITEMS && k < count {
                var sum = 0.0;
                for (var other = 0u; other < BLOCKS; other++) {
                    let bits = atomicLoad(&touched[odd * BLOCKS + other]);
                    if ((bits >> k) & 1u) == 1u && live_blocks[odd * BLOCKS + other] == 1u {
                        let values = (other * SUMS + entry) * STRIDE + entry_item * PARTS;
                        sum += total(four(values)) + total(four(values + 4u));
                    }
                }
                slots[slot_from_pair[batch + k] * SUMS + entry] = sum;
            }
            workgroupBarrier();
        }
        if pixel.live {
            any_live = 1u;
            live_blocks[(1u - odd) * BLOCKS + block] = 1u;
        }
        odd = 1u - odd;
        written = batch + count;
        if workgroupUniformLoad(&any_live) == 0u {
            break;
        }
    }
    // Slots after the tile's early stop and, for the last tile, after all tiles.
    write_zeros(written, end, thread);
    if tile + 1u == chunk.tile_end && chunk.list_begin == 0u {
        write_zeros(tile_begin[list.index + 1u], tile_begin[list.index + 2u], thread);
    }
    if list.goes_on && index != 0xffffffffu {
        totals[index] = pixel.remaining;
        transmittances[index] = select(-pixel.transmittance, pixel.transmittance, pixel.live);
    }
}
