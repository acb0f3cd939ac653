//! Space in cells of about equally many splats: a tree of planes across the axes.

pub enum Node {
    /// Splits at a plane across an axis: below it and the rest.
    Split {
        axis: usize,
        at: f32,
        halves: [usize; 2],
    },
    Cell(usize),
}

/// The tree; its root comes first.
pub struct Cells {
    pub nodes: Vec<Node>,
    /// Number of cells, which are numbered along the tree: neighbors have near numbers.
    pub count: usize,
}

/// Quantiles between which a cell's side is measured, since a few points are far out.
const ENDS: [f64; 2] = [0.1, 0.9];

impl Cells {
    /// Splits until no cell has more than `most` of the points.
    pub fn new(points: &mut [[f32; 3]], most: usize) -> Self {
        let mut out = Self { nodes: Vec::new(), count: 0 };
        out.grow(points, most.max(1));
        out
    }

    fn grow(&mut self, points: &mut [[f32; 3]], most: usize) -> usize {
        let number = self.nodes.len();
        let split = if points.len() > most { split(points) } else { None };
        let Some((axis, at, below)) = split else {
            self.nodes.push(Node::Cell(self.count));
            self.count += 1;
            return number;
        };
        self.nodes.push(Node::Split { axis, at, halves: [0; 2] });
        let (low, high) = points.split_at_mut(below);
        let ends = [self.grow(low, most), self.grow(high, most)];
        self.nodes[number] = Node::Split { axis, at, halves: ends };
        number
    }

    /// The cell of a point.
    pub fn of(&self, point: &[f32; 3]) -> usize {
        let mut at = 0;
        loop {
            match &self.nodes[at] {
                Node::Cell(number) => return *number,
                Node::Split { axis, at: plane, halves } => {
                    at = halves[usize::from(point[*axis] >= *plane)];
                }
            }
        }
    }
}

/// Splits points at the middle of their longest axis; None if no plane has points on both sides.
fn split(points: &mut [[f32; 3]]) -> Option<(usize, f32, usize)> {
    let last = points.len() - 1;
    let mut at = |axis: usize, part: f64| {
        let k = (part * last as f64) as usize;
        points.select_nth_unstable_by(k, |a, b| a[axis].total_cmp(&b[axis])).1[axis]
    };
    let sides = [0, 1, 2].map(|axis| at(axis, ENDS[1]) - at(axis, ENDS[0]));
    let mut order = [0, 1, 2];
    order.sort_by(|&a, &b| sides[b].total_cmp(&sides[a]));
    for axis in order {
        points.sort_unstable_by(|a, b| a[axis].total_cmp(&b[axis]));
        let plane = points[points.len() / 2][axis];
        let below = points.partition_point(|p| p[axis] < plane);
        // If half of them lie on the plane, use the next larger number.
        let (plane, below) = match below {
            0 => {
                let below = points.partition_point(|p| p[axis] <= plane);
                (points.get(below).map_or(plane, |p| p[axis]), below)
            }
            below => (plane, below),
        };
        if below > 0 && below < points.len() {
            return Some((axis, plane, below));
        }
    }
    None
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn cells_are_balanced_and_each_point_is_in_one() {
        let mut points: Vec<[f32; 3]> = (0..1000u32)
            .map(|i| [0, 1, 2].map(|k| ((i * [7, 11, 13][k]) % 101) as f32 * [1.0, 3.0, 0.1][k]))
            .collect();
        points.push([1e9, 0.0, 0.0]);
        let all = points.clone();
        let cells = Cells::new(&mut points, 100);
        let mut held = vec![0; cells.count];
        for point in &all {
            held[cells.of(point)] += 1;
        }
        assert_eq!(held.iter().sum::<i32>(), 1001);
        assert!(held.iter().all(|&n| (30..=100).contains(&n)), "{held:?}");
    }

    #[test]
    fn points_at_one_place_are_one_cell() {
        let cells = Cells::new(&mut [[1.0, 2.0, 3.0]; 50], 10);
        assert_eq!(cells.count, 1);
        let mut two = [[0.0; 3]; 50];
        two[49] = [0.0, 5.0, 0.0];
        let cells = Cells::new(&mut two, 10);
        assert_eq!(cells.count, 2);
        assert_ne!(cells.of(&[0.0; 3]), cells.of(&[0.0, 5.0, 0.0]));
    }
}
