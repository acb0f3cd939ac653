// Which pixels and tiles a 2D splat touches, exactly up to a safety margin. Culling only leaves out pairs
// that contribute nothing, so the margin costs time but never changes the picture.

struct Footprint {
    center: vec2<f32>,
    // Radius of the ellipse after whitening, margin included.
    reach: f32,
    // x = (-shear w +- sqrt(reach^2 - w^2)) / p for w = r dy.
    shear: f32,
    p: f32,
    r: f32,
    // Height of the ellipse's rightmost point.
    w_right: f32,
    row_begin: u32,
    row_end: u32,
}

fn footprint(splat: Splat2d) -> Footprint {
    var f: Footprint;
    f.center = splat.mean;
    f.p = splat.pq.x;
    f.r = splat.r;
    if all(splat.radii == vec2(0.0)) || splat.opacity <= ALPHA_MIN {
        return f;
    }
    f.reach = sqrt(2.0 * log(splat.opacity / ALPHA_MIN) * 1.0001 + 1e-3);
    f.shear = splat.pq.y / splat.r;
    if abs(f.shear) > 1.0 {
        // Written for shears whose square overflows.
        let inverse = 1.0 / f.shear;
        f.w_right = -sign(f.shear) * f.reach / sqrt(1.0 + inverse * inverse);
    } else {
        f.w_right = -f.shear * f.reach / sqrt(1.0 + f.shear * f.shear);
    }
    let half = f.reach / f.r + 0.01 + 1e-5 * abs(f.center.y);
    let low = f.center.y - half - 0.5;
    let high = f.center.y + half - 0.5;
    let last_pixel = f32(view.height - 1u);
    if high < 0.0 || low > last_pixel {
        return f;
    }
    f.row_begin = u32(clamp(low, 0.0, last_pixel)) / TILE;
    f.row_end = u32(clamp(high, 0.0, last_pixel)) / TILE + 1u;
    return f;
}

// First and one-past-last pixel of the splat in rows band_begin to band_end - 1 of the picture; equal if
// there is none.
fn pixels(f: Footprint, band_begin: u32, band_end: u32) -> vec2<u32> {
    let slack = 0.01 + 1e-5 * abs(f.center.y);
    let w_low = f.r * (f32(band_begin) + 0.5 - slack - f.center.y);
    let w_high = f.r * (f32(band_end) - 0.5 + slack - f.center.y);
    if w_low > f.reach || w_high < -f.reach {
        return vec2(0u);
    }
    let low = clamp(w_low, -f.reach, f.reach);
    let high = clamp(w_high, -f.reach, f.reach);
    // The boundary is concave on the right and convex on the left, so that its extreme within the
    // band lies at its own or at the nearer end of the band.
    let w_right = clamp(f.w_right, low, high);
    let w_left = clamp(-f.w_right, low, high);
    let square = f.reach * f.reach;
    let right = (-f.shear * w_right + sqrt(max(square - w_right * w_right, 0.0))) / f.p;
    let left = (-f.shear * w_left - sqrt(max(square - w_left * w_left, 0.0))) / f.p;
    let margin = 0.02 + 1e-5 * (abs(f.center.x) + (abs(f.shear) + 1.0) * f.reach / f.p);
    let first = ceil(f.center.x + left - margin - 0.5);
    let last = floor(f.center.x + right + margin - 0.5);
    let last_pixel = f32(view.width - 1u);
    if last < 0.0 || first > last_pixel || last < first {
        return vec2(0u);
    }
    return vec2(u32(clamp(first, 0.0, last_pixel)), u32(clamp(last, 0.0, last_pixel)) + 1u);
}

// First and one-past-last tile column of a row of tiles; empty if begin >= end.
fn columns(f: Footprint, row: u32) -> vec2<u32> {
    let span = pixels(f, row * TILE, min(row * TILE + TILE, view.height));
    return vec2(span.x / TILE, (span.y + TILE - 1u) / TILE);
}

// `columns` cut to the chunk's tiles.
fn chunk_columns(f: Footprint, row: u32) -> vec2<u32> {
    let span = columns(f, row);
    let row_begin = row * view.tiles_x;
    let begin = max(chunk.tile_begin, row_begin) - row_begin;
    let end = max(chunk.tile_end, row_begin) - row_begin;
    return vec2(max(span.x, begin), min(span.y, end));
}

// Rows of tiles that the splat and the chunk share.
fn chunk_rows(f: Footprint) -> vec2<u32> {
    let end = (chunk.tile_end + view.tiles_x - 1u) / view.tiles_x;
    return vec2(max(f.row_begin, chunk.tile_begin / view.tiles_x), min(f.row_end, end));
}
