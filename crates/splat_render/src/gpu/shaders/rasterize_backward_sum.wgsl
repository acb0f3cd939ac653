// rasterize_backward_sum: adds a splat's slots in their order and finishes the moments to the
// gradients of its center and factor. Follows shared.wgsl.

@group(0) @binding(0) var<uniform> chunk: Chunk;
@group(0) @binding(1) var<storage, read> status: Status;
@group(0) @binding(2) var<storage, read> splats2d: array<Splat2d>;
@group(0) @binding(3) var<storage, read> order: array<u32>;
@group(0) @binding(4) var<storage, read> offsets: array<u32>;
@group(0) @binding(5) var<storage, read> slots: array<f32>;
// SUMS floats per splat: mean 2, factor 3, depth, color 3, opacity, and on request the absolute mean 2;
// raw sums until the picture's last chunk.
@group(0) @binding(6) var<storage, read_write> v_splats2d: array<f32>;

@compute @workgroup_size(64)
fn rasterize_backward_sum(
    @builtin(workgroup_id) workgroup: vec3<u32>,
    @builtin(local_invocation_index) local: u32,
) {
    let rank = indirect_index(workgroup, chunk.groups_max, local, 64u);
    if rank >= status.visible || status.overflow != 0u {
        return;
    }
    let i = order[rank];
    var sums: array<f32, SUMS>;
    if chunk.is_first == 0u {
        for (var k = 0u; k < SUMS; k++) {
            sums[k] = v_splats2d[i * SUMS + k];
        }
    }
    let end = offsets[rank + 1u];
    for (var slot = offsets[rank]; slot < end; slot++) {
        for (var k = 0u; k < SUMS; k++) {
            sums[k] += slots[slot * SUMS + k];
        }
    }
    if chunk.is_last == 1u {
        let splat = splats2d[i];
        let p = splat.pq.x;
        let q = splat.pq.y;
        let r = splat.r;
        // sigma = (u^2 + v^2) / 2 with u = p dx + q dy, v = r dy.
        let u = sums[0];
        let v = sums[1];
        let uu = sums[2];
        let uv = sums[3];
        let vv = sums[4];
        sums[0] = -p * u;
        sums[1] = -(q * u + r * v);
        sums[2] = (uu - q / r * uv) / p;
        sums[3] = uv / r;
        sums[4] = vv / r;
        if SUMS == GRADIENT_ABSOLUTE {
            sums[SUMS - 2u] *= p;
        }
    }
    for (var k = 0u; k < SUMS; k++) {
        v_splats2d[i * SUMS + k] = select(0.0, sums[k], is_finite(sums[k]));
    }
}
