// The original density control, second part: those that stay, and behind them what is added, clones and
// halves of splits. As fit_device/original.rs, bit for bit where multiplications and additions are not
// fused and quotients are rounded as there. Follows shared.wgsl and original_run.wgsl.

@group(0) @binding(2) var<storage, read> told: array<u32>;
// Splats that stay, and those of them that grow.
@group(0) @binding(3) var<storage, read> staying: array<u32>;
@group(0) @binding(4) var<storage, read> growing: array<u32>;
// The numbers of both, each behind a sum.
@group(0) @binding(5) var<storage, read> totals: array<vec2<u32>, 2>;
@group(0) @binding(6) var<storage, read_write> drawn: array<f32>;
// Twice the row of a splat's colours and moments, and 1 where its moments are to be zero.
@group(0) @binding(7) var<storage, read_write> rows: array<u32>;

// A normal draw: the sum of twelve uniform ones, less its mean.
fn normal(base: u32, axis: u32) -> f32 {
    var sum = 0u;
    for (var k = 0u; k < 6u; k++) {
        let word = hash(base + 6u * axis + k);
        sum += (word >> 16u) + (word & 0xffffu);
    }
    return f32(i32(sum) - 393210) * (1.0 / 65536.0);
}

// e^x to 0.4 %, in whole numbers.
fn exp_whole(x: f32) -> f32 {
    let power = i32(floor(clamp(x, -87.0, 88.0) * 94548.27));
    let fraction = u32(power & 0xffff);
    let bend = (((fraction * (0x10000u - fraction)) >> 16u) * 22493u) >> 16u;
    return bitcast<f32>((u32((power >> 16u) + 127) << 23u) | ((fraction - bend) << 7u));
}

// Where one of the halves of a splat comes to lie.
fn half_mean(at: u32, base: u32) -> vec3<f32> {
    let mean = vec3(geometry[at], geometry[at + 1u], geometry[at + 2u]);
    let w = geometry[at + 6u];
    let x = geometry[at + 7u];
    let y = geometry[at + 8u];
    let z = geometry[at + 9u];
    let norm2 = ((w * w + x * x) + y * y) + z * z;
    if norm2 < QUAT_NORM2_MIN {
        return mean;
    }
    let s = 2.0 / norm2;
    let a = exp_whole(geometry[at + 3u]) * normal(base, 0u);
    let b = exp_whole(geometry[at + 4u]) * normal(base, 1u);
    let c = exp_whole(geometry[at + 5u]) * normal(base, 2u);
    let moved = mean + vec3(
        ((1.0 - s * (y * y + z * z)) * a + (s * (x * y - w * z)) * b) + (s * (x * z + w * y)) * c,
        ((s * (x * y + w * z)) * a + (1.0 - s * (x * x + z * z)) * b) + (s * (y * z - w * x)) * c,
        ((s * (x * z - w * y)) * a + (s * (y * z + w * x)) * b) + (1.0 - s * (x * x + y * y)) * c,
    );
    return select(mean, moved, is_finite3(moved));
}

@compute @workgroup_size(64)
fn original_draw(
    @builtin(workgroup_id) workgroup: vec3<u32>,
    @builtin(num_workgroups) groups: vec3<u32>,
    @builtin(local_invocation_index) local: u32,
) {
    let k = linear_index(workgroup, groups, local, 64u);
    let stay = totals[0].y;
    if k >= stay + totals[1].y {
        return;
    }
    let is_fresh = k >= stay;
    var i = 0u;
    if is_fresh {
        i = growing[k - stay];
    } else {
        i = staying[k];
    }
    let at = i * GEOMETRY;
    let to = k * GEOMETRY;
    for (var c = 0u; c < GEOMETRY; c++) {
        drawn[to + c] = geometry[at + c];
    }
    let splits = (told[i] & (GROWS | LARGE)) == (GROWS | LARGE);
    if splits {
        let mean = half_mean(at, hash(i ^ hash(run.seed ^ u32(is_fresh))));
        drawn[to] = mean.x;
        drawn[to + 1u] = mean.y;
        drawn[to + 2u] = mean.z;
        for (var c = 3u; c < 6u; c++) {
            drawn[to + c] = geometry[at + c] - LOG_SPLIT_SHRINK;
        }
    }
    rows[k] = 2u * i + u32(is_fresh || splits);
}
