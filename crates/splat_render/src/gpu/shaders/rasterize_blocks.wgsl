// rasterize for GPUs: as rasterize.wgsl, with the same bits, one pixel per thread. Follows shared.wgsl,
// tile_list.wgsl, bin_tiles.wgsl and tile_blocks.wgsl.

@group(0) @binding(0) var<uniform> view: View;
@group(0) @binding(1) var<uniform> chunk: Chunk;
@group(0) @binding(2) var<storage, read> splats2d: array<Splat2d>;
@group(0) @binding(3) var<storage, read> tile_begin: array<u32>;
@group(0) @binding(4) var<storage, read> splat_from_pair: array<u32>;
// As in rasterize.wgsl.
@group(0) @binding(5) var<storage, read_write> picture: array<vec4<f32>>;
@group(0) @binding(6) var<storage, read_write> depths: array<f32>;

const BATCH = 256u;

var<workgroup> any_live: u32;

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
    let block = thread / 32u;
    let at = block_corner(tile, block) + vec2(thread % 8u, thread / 8u % 4u);
    let exists = all(at < vec2(view.width, view.height));
    let pixel = at.y * view.width + at.x;
    let center = vec2<f32>(at) + 0.5;
    var live = exists;
    var color = vec3(0.0);
    var depth = 0.0;
    var transmittance = 1.0;
    // A list continues in another dispatch on software drivers alone.
    if exists && chunk.list_begin > 0u {
        let kept = picture[pixel];
        color = kept.xyz;
        transmittance = abs(kept.w);
        live = kept.w > 0.0;
        depth = depths[pixel];
    }
    clear_touched(0u, thread);
    workgroupBarrier();
    var odd = 0u;
    for (var batch = list.begin; batch < end; batch += BATCH) {
        if thread == 0u {
            any_live = 0u;
        }
        if batch + thread < end {
            stage(batch + thread, thread, tile, odd);
        }
        workgroupBarrier();
        clear_touched(1u - odd, thread);
        for (var word = 0u; live && word < WORDS; word++) {
            var bits = atomicLoad(&touched[(odd * BLOCKS + block) * WORDS + word]);
            for (; live && bits != 0u; bits &= bits - 1u) {
                let splat = staged(32u * word + firstTrailingBit(bits));
                let dy = center.y - splat.mean.y;
                let u = splat.pq.x * (center.x - splat.mean.x) + splat.pq.y * dy;
                let v = splat.r * dy;
                let exponent = max(-0.5 * (u * u + v * v), -80.0);
                let alpha = min(splat.opacity * exp_accurate(exponent), ALPHA_MAX);
                let next = transmittance * (1.0 - alpha);
                if alpha >= ALPHA_MIN {
                    live = next >= TRANSMITTANCE_MIN;
                    if live {
                        let weight = transmittance * alpha;
                        color += weight * splat.color;
                        depth += weight * splat.depth;
                        transmittance = next;
                    }
                }
            }
        }
        if live {
            any_live = 1u;
        }
        odd = 1u - odd;
        if workgroupUniformLoad(&any_live) == 0u {
            break;
        }
    }
    if exists {
        let goes_on = list.goes_on;
        if goes_on {
            transmittance = select(-transmittance, transmittance, live);
        } else {
            color += transmittance * view.background;
        }
        picture[pixel] = vec4(color, transmittance);
        depths[pixel] = depth;
    }
}
