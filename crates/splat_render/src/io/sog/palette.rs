//! A palette of vectors that stands for many: splits the group of largest error in two until there
//! are enough groups. Each vector is looked at once per level of splits, so that 65 536 rows cost
//! little more than 256.

use std::collections::BinaryHeap;

/// Rows, and which row each vector has.
pub struct Palette {
    /// `[rows * width]` means of the groups.
    pub rows: Vec<f32>,
    /// Row of each vector.
    pub labels: Vec<u16>,
}

/// A range of the ids, its squared error, and its widest axis.
struct Group {
    start: usize,
    end: usize,
    error: f64,
    axis: usize,
    mean: Vec<f32>,
}

impl PartialEq for Group {
    fn eq(&self, other: &Self) -> bool {
        self.cmp(other).is_eq()
    }
}
impl Eq for Group {}
impl PartialOrd for Group {
    fn partial_cmp(&self, other: &Self) -> Option<std::cmp::Ordering> {
        Some(self.cmp(other))
    }
}
impl Ord for Group {
    fn cmp(&self, other: &Self) -> std::cmp::Ordering {
        self.error.total_cmp(&other.error).then(other.start.cmp(&self.start))
    }
}

/// A palette of at most `rows_max` (and 65 536) rows for vectors of `width` numbers each.
pub fn palette(vectors: &[f32], width: usize, rows_max: usize) -> Palette {
    let vector = |id: u32| &vectors[id as usize * width..][..width];
    let mut ids: Vec<u32> = (0..(vectors.len() / width) as u32).collect();
    let group = |ids: &[u32], start: usize| {
        let mut sums = vec![(0.0f64, 0.0f64); width];
        for &id in ids {
            for (sum, &value) in sums.iter_mut().zip(vector(id)) {
                sum.0 += f64::from(value);
                sum.1 += f64::from(value) * f64::from(value);
            }
        }
        let count = ids.len() as f64;
        let (mut error, mut axis, mut widest) = (0.0, 0, -1.0);
        for (k, (sum, squares)) in sums.iter().enumerate() {
            let spread = (squares - sum * sum / count).max(0.0);
            error += spread;
            if spread > widest {
                (axis, widest) = (k, spread);
            }
        }
        let mean = sums.iter().map(|(sum, _)| (sum / count) as f32).collect();
        Group { start, end: start + ids.len(), error, axis, mean }
    };
    let mut groups = BinaryHeap::new();
    let mut whole = Vec::new();
    if !ids.is_empty() {
        groups.push(group(&ids, 0));
    }
    while groups.len() + whole.len() < rows_max.min(1 << 16) {
        let Some(widest) = groups.pop() else { break };
        let Group { start, end, axis, .. } = widest;
        let middle = widest.mean[axis];
        let members = &mut ids[start..end];
        members.sort_by_key(|&id| vector(id)[axis] > middle);
        let split = members.partition_point(|&id| vector(id)[axis] <= middle);
        if split == 0 || split == members.len() {
            // All equal, up to rounding.
            whole.push(widest);
            continue;
        }
        let (low, high) = members.split_at(split);
        let (low, high) = (group(low, start), group(high, start + split));
        groups.push(low);
        groups.push(high);
    }
    whole.extend(groups.into_vec());
    whole.sort_by_key(|group| group.start);
    let mut labels = vec![0; ids.len()];
    for (row, group) in whole.iter().enumerate() {
        for &id in &ids[group.start..group.end] {
            labels[id as usize] = row as u16;
        }
    }
    Palette { rows: whole.into_iter().flat_map(|group| group.mean).collect(), labels }
}
