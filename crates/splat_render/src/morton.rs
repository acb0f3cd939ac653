//! Splats in an order in which neighbors in space are neighbors in memory or in a file. Fits gain by
//! it, and so do formats that pack runs of splats against the run's own bounds, or as images.

/// Bits per axis of the cells that are ordered.
const BITS: u32 = 20;

/// Ids of the points along Morton's curve through their bounding box; equal cells keep the order.
pub fn morton_order(points: &[[f32; 3]]) -> Vec<usize> {
    let mut low = [f32::INFINITY; 3];
    let mut high = [f32::NEG_INFINITY; 3];
    for point in points {
        for k in 0..3 {
            low[k] = low[k].min(point[k]);
            high[k] = high[k].max(point[k]);
        }
    }
    let cells = f64::from((1u32 << BITS) - 1);
    let code = |point: &[f32; 3]| {
        (0..3).fold(0u64, |code, k| {
            let extent = f64::from(high[k]) - f64::from(low[k]);
            let place = (f64::from(point[k]) - f64::from(low[k])) / extent;
            // 0 / 0 is NaN and becomes 0: all points lie in one plane.
            code | spread((place * cells) as u64) << k
        })
    };
    let codes: Vec<u64> = points.iter().map(code).collect();
    let mut ids: Vec<usize> = (0..points.len()).collect();
    ids.sort_by_key(|&i| codes[i]);
    ids
}

/// Bit i of `x` at bit 3 i.
fn spread(x: u64) -> u64 {
    (0..BITS).fold(0, |spread, i| spread | (x >> i & 1) << (3 * i))
}
