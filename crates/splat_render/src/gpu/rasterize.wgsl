// rasterize: every tile's splats, front to back, to colours, depth and final transmittance. A
// thread owns four neighbouring pixels, so that a splat is read once for the four; splats are read
// straight from storage (staging them in workgroup memory was slower). Follows shared.wgsl.

@group(0) @binding(0) var<uniform> view: View;
@group(0) @binding(1) var<uniform> chunk: Chunk;
@group(0) @binding(2) var<storage, read> splats2d: array<Splat2d>;
@group(0) @binding(3) var<storage, read> tile_begin: array<u32>;
@group(0) @binding(4) var<storage, read> splat_from_pair: array<u32>;
// Colour over the background and final transmittance, row-major.
@group(0) @binding(5) var<storage, read_write> picture: array<vec4<f32>>;
@group(0) @binding(6) var<storage, read_write> depths: array<f32>;

@compute @workgroup_size(4, 16)
fn rasterize(
    @builtin(workgroup_id) workgroup: vec3<u32>,
    @builtin(num_workgroups) groups: vec3<u32>,
    @builtin(local_invocation_id) local: vec3<u32>,
) {
    let relative = workgroup.y * groups.x + workgroup.x;
    let tile = chunk.tile_begin + relative;
    if tile >= chunk.tile_end {
        return;
    }
    let x = (tile % view.tiles_x) * TILE + 4u * local.x;
    let y = (tile / view.tiles_x) * TILE + local.y;
    let center_x = f32(x) + vec4(0.5, 1.5, 2.5, 3.5);
    let center_y = f32(y) + 0.5;
    let exists = vec4(x, x + 1u, x + 2u, x + 3u) < vec4(view.width);
    var live = exists & vec4(y < view.height);
    var transmittance = vec4(1.0);
    var red = vec4(0.0);
    var green = vec4(0.0);
    var blue = vec4(0.0);
    var depth = vec4(0.0);
    let end = tile_begin[relative + 1u];
    for (var pair = tile_begin[relative]; pair < end; pair++) {
        let splat = splats2d[splat_from_pair[pair]];
        let dy = center_y - splat.mean.y;
        let u = splat.pq.x * (center_x - splat.mean.x) + splat.pq.y * dy;
        let v = splat.r * dy;
        let exponent = max(-0.5 * (u * u + v * v), vec4(-80.0));
        let alpha = min(splat.opacity * exp_accurate4(exponent), vec4(ALPHA_MAX));
        let next = transmittance * (1.0 - alpha);
        let hit = live & (alpha >= vec4(ALPHA_MIN));
        let stops = hit & (next < vec4(TRANSMITTANCE_MIN));
        live = live & !stops;
        let adds = hit & live;
        let weight = select(vec4(0.0), transmittance * alpha, adds);
        red += weight * splat.color.x;
        green += weight * splat.color.y;
        blue += weight * splat.color.z;
        depth += weight * splat.depth;
        transmittance = select(transmittance, next, adds);
        if !any(live) {
            break;
        }
    }
    if y >= view.height {
        return;
    }
    red += transmittance * view.background.x;
    green += transmittance * view.background.y;
    blue += transmittance * view.background.z;
    for (var k = 0u; k < 4u; k++) {
        if x + k < view.width {
            let pixel = y * view.width + x + k;
            picture[pixel] = vec4(red[k], green[k], blue[k], transmittance[k]);
            depths[pixel] = depth[k];
        }
    }
}
