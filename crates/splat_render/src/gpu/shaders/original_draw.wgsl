// The original density control, second part: the splats that stay, followed by clones and halves of
// splits. Matches fit_device/original.rs bit for bit. Follows shared.wgsl and original_run.wgsl.

@group(0) @binding(2) var<storage, read> flags: array<u32>;
// Indices of splats that stay; the next binding lists the growing ones among them.
@group(0) @binding(3) var<storage, read> staying: array<u32>;
@group(0) @binding(4) var<storage, read> growing: array<u32>;
// The numbers of both, each behind a sum.
@group(0) @binding(5) var<storage, read> totals: array<vec2<u32>, 2>;
@group(0) @binding(6) var<storage, read_write> drawn: array<f32>;
// Twice the row of a splat's colors and moments, plus 1 if its moments become zero.
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

// The result of one operation, or 0 if it is tiny: some drivers flush such numbers, so all must.
fn kept(x: f32) -> f32 {
    let bits = bitcast<u32>(rounded(x, run.zero));
    return bitcast<f32>(select(bits, 0u, (bits & 0x7fffffffu) < KEPT_BITS_MIN));
}

fn times(a: f32, b: f32) -> f32 {
    return kept(a * b);
}

fn plus(a: f32, b: f32) -> f32 {
    return kept(a + b);
}

// 2 / x of a finite x that is not tiny. A driver's quotient may be 2.5 units in the last place off, so it
// is made of products and differences, which all round alike: Newton's steps for the inverse of x
// without its power of two, from a first guess to 12 %.
fn two_over(x: f32) -> f32 {
    let bits = bitcast<u32>(x);
    let fraction = bitcast<f32>((bits & 0x7fffffu) | 0x3f800000u);
    var inverse = bitcast<f32>(INVERSE_GUESS - bitcast<u32>(fraction));
    for (var k = 0u; k < 4u; k++) {
        inverse = times(inverse, plus(2.0, -times(fraction, inverse)));
    }
    return kept(bitcast<f32>(bitcast<u32>(inverse) + 0x40000000u - (bits & 0x7f800000u)));
}

// Position of one of the halves of a splat.
fn half_mean(at: u32, base: u32) -> vec3<f32> {
    let mean = vec3(geometry[at], geometry[at + 1u], geometry[at + 2u]);
    let w = kept(geometry[at + 6u]);
    let x = kept(geometry[at + 7u]);
    let y = kept(geometry[at + 8u]);
    let z = kept(geometry[at + 9u]);
    let ww = times(w, w);
    let xx = times(x, x);
    let yy = times(y, y);
    let zz = times(z, z);
    let norm2 = plus(plus(plus(ww, xx), yy), zz);
    if norm2 < QUAT_NORM2_MIN || !is_finite(norm2) {
        return mean;
    }
    let s = two_over(norm2);
    let xy = times(x, y);
    let xz = times(x, z);
    let yz = times(y, z);
    let wx = times(w, x);
    let wy = times(w, y);
    let wz = times(w, z);
    let a = times(exp_whole(kept(geometry[at + 3u])), normal(base, 0u));
    let b = times(exp_whole(kept(geometry[at + 4u])), normal(base, 1u));
    let c = times(exp_whole(kept(geometry[at + 5u])), normal(base, 2u));
    let moved = vec3(
        plus(kept(mean.x), plus(plus(
            times(plus(1.0, -times(s, plus(yy, zz))), a),
            times(times(s, plus(xy, -wz)), b)),
            times(times(s, plus(xz, wy)), c))),
        plus(kept(mean.y), plus(plus(
            times(times(s, plus(xy, wz)), a),
            times(plus(1.0, -times(s, plus(xx, zz))), b)),
            times(times(s, plus(yz, -wx)), c))),
        plus(kept(mean.z), plus(plus(
            times(times(s, plus(xz, -wy)), a),
            times(times(s, plus(yz, wx)), b)),
            times(plus(1.0, -times(s, plus(xx, yy))), c))),
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
    let splits = (flags[i] & (GROWS | LARGE)) == (GROWS | LARGE);
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
