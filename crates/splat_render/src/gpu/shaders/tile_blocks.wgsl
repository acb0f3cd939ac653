// A tile's splats in workgroup memory, a batch at a time, and the blocks of 8x4 pixels that each touches:
// for GPUs. 32 neighboring threads draw a block, one pixel each, and skip the splats that miss it. Follows
// bin_tiles.wgsl; the file that follows declares BATCH, the number of splats in a batch.

const THREADS = TILE * TILE;
const BLOCKS = 8u;
// Words of a block's bits, one bit for each splat of a batch.
const WORDS = (BATCH + 31u) / 32u;

// Mean, p, q.
var<workgroup> staged_geometry: array<vec4<f32>, BATCH>;
// Color, r.
var<workgroup> staged_color: array<vec4<f32>, BATCH>;
// Depth, opacity.
var<workgroup> staged_rest: array<vec2<f32>, BATCH>;
// [batch even or odd][block][word]: a batch is staged while the words of the next are cleared.
var<workgroup> touched: array<atomic<u32>, 2u * BLOCKS * WORDS>;

fn block_corner(tile: u32, block: u32) -> vec2<u32> {
    return vec2(tile % view.tiles_x, tile / view.tiles_x) * TILE + vec2(block % 2u, block / 2u) * vec2(8u, 4u);
}

// Clears the words of even or odd batches. A barrier must follow before the next batch is staged.
fn clear_touched(odd: u32, thread: u32) {
    if thread < BLOCKS * WORDS {
        atomicStore(&touched[odd * BLOCKS * WORDS + thread], 0u);
    }
}

// Stages a pair's splat as the batch's splat k. A barrier must follow before it is read.
fn stage(pair: u32, k: u32, tile: u32, odd: u32) {
    let splat = splats2d[splat_from_pair[pair]];
    staged_geometry[k] = vec4(splat.mean, splat.pq);
    staged_color[k] = vec4(splat.color, splat.r);
    staged_rest[k] = vec2(splat.depth, splat.opacity);
    let f = footprint(splat);
    for (var block = 0u; block < BLOCKS; block += 2u) {
        let corner = block_corner(tile, block);
        if corner.y < view.height {
            let span = pixels(f, corner.y, min(corner.y + 4u, view.height));
            let word = (odd * BLOCKS + block) * WORDS + k / 32u;
            if span.x < corner.x + 8u && span.y > corner.x {
                atomicOr(&touched[word], 1u << (k % 32u));
            }
            if span.x < corner.x + 16u && span.y > corner.x + 8u {
                atomicOr(&touched[word + WORDS], 1u << (k % 32u));
            }
        }
    }
}

fn staged(k: u32) -> Splat2d {
    let geometry = staged_geometry[k];
    let color = staged_color[k];
    let rest = staged_rest[k];
    return Splat2d(geometry.xy, geometry.zw, color.xyz, color.w, rest.x, rest.y, vec2(0.0));
}
