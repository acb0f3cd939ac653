//! The order that density control leaves splats in. As shaders/density_order.wgsl, bit for bit.

/// Cells of the bounding box along an axis, along whose curve splats are ordered.
pub(crate) const CELLS: u32 = 1 << 20;

/// Cells of a bounding box: its low corner and the scale of offsets from it.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct Cells {
    pub low: [f32; 3],
    pub scale: [f32; 3],
}

impl Cells {
    /// Of the box between two corners.
    pub fn new(low: [f32; 3], high: [f32; 3]) -> Self {
        let scale = std::array::from_fn(|k| {
            let extent = f64::from(high[k]) - f64::from(low[k]);
            let scale = (f64::from(CELLS - 1) / extent) as f32;
            // All points lie in one plane, or there are none.
            if scale.is_finite() && scale > 0.0 { scale } else { 0.0 }
        });
        Self { low, scale }
    }

    /// A point's place on Morton's curve: the lower and the upper halves of its cell's bits.
    fn code(&self, point: [f32; 3]) -> (u32, u32) {
        let mut code = (0, 0);
        for k in 0..3 {
            let place = (point[k] - self.low[k]) * self.scale[k];
            let cell =
                if place.is_finite() { place.clamp(0.0, (CELLS - 1) as f32) as u32 } else { 0 };
            for bit in 0..10 {
                code.0 |= (cell >> bit & 1) << (3 * bit + k as u32);
                code.1 |= (cell >> (bit + 10) & 1) << (3 * bit + k as u32);
            }
        }
        code
    }
}

/// Ids of the points along Morton's curve through the box of the finite ones: neighbors in space become
/// neighbors in memory, and tiles and pairs of splats near each other, too.
pub(super) fn cell_order(points: &[[f32; 3]]) -> Vec<usize> {
    let (mut low, mut high) = ([f32::INFINITY; 3], [f32::NEG_INFINITY; 3]);
    for point in points.iter().filter(|point| point.iter().all(|v| v.is_finite())) {
        for k in 0..3 {
            low[k] = low[k].min(point[k]);
            high[k] = high[k].max(point[k]);
        }
    }
    let cells = Cells::new(low, high);
    let codes: Vec<_> = points.iter().map(|&point| cells.code(point)).collect();
    let mut ids: Vec<usize> = (0..points.len()).collect();
    ids.sort_by_key(|&i| (codes[i].1, codes[i].0));
    ids
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn neighbors_in_space_become_neighbors_in_memory() {
        let order = cell_order(&[[3.0, 0.0, 0.0], [0.0; 3], [2.9, 0.0, 0.0], [f32::NAN; 3]]);
        assert_eq!(order, [1, 3, 2, 0]);
        assert_eq!(cell_order(&[[1.0; 3]; 3]), [0, 1, 2]);
    }
}
