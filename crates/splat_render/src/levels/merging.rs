//! Merges splats into fewer that look alike from afar: neighbors along Morton's curve are merged, first
//! the pairs that move the least color.
//!
//! The mean, spread and color of a merged splat are its sources' averages weighted by opacity times area
//! (as in Kerbl et al., "A Hierarchical 3D Gaussian Representation", 2024); its opacity times its area is
//! their sum. The cost of a merge is the weighted square of the movement, as in Ward's clustering
//! ("Hierarchical Grouping to Optimize an Objective Function", 1963).

use std::cmp::Reverse;
use std::collections::BinaryHeap;

use glam::{DMat3, DQuat, DVec3};

use super::symmetric::axes;
use crate::splats::SplatArrays;

/// Maximum opacity of a merged splat: a logit of 1 is infinite.
const OPACITY_MAX: f64 = 0.995;
/// Cost of a color difference, relative to a distance of the root of both spreads.
const COLOR: f64 = 4.0;
/// The lowest coefficient of degree 0 that differs from black: color = 0.5 + coefficient / (2 sqrt(pi)).
const BLACK: f32 = -1.772_453_9;
/// Nothing weighs less than this.
const TINY: f64 = 1e-30;

/// The splats of a level.
pub struct Merged {
    /// In the order of their sources.
    pub splats: SplatArrays,
    /// Root mean square distance that color was moved, world units.
    pub moved: f64,
}

/// A splat, or several that became one.
#[derive(Clone, Copy)]
struct Cluster {
    weight: f64,
    mean: DVec3,
    spread: DMat3,
    /// How many it stands for; none if it is a part of another.
    members: u32,
    /// Changes whenever it does.
    version: u32,
    before: u32,
    after: u32,
}

/// No cluster.
const NONE: u32 = u32::MAX;

/// A cost, which is not NaN, that can be ordered.
#[derive(PartialEq, PartialOrd)]
struct Cost(f64);
impl Eq for Cost {}
#[expect(clippy::derive_ord_xor_partial_ord, reason = "costs are not NaN")]
impl Ord for Cost {
    fn cmp(&self, other: &Self) -> std::cmp::Ordering {
        self.0.total_cmp(&other.0)
    }
}

/// Two neighbors, and their versions when their merging had that cost.
type Pair = (Reverse<(Cost, u32)>, u32, [u32; 2]);

/// Levels of the splats, which lie in Morton's order and are finite, one for each of the falling counts.
pub fn merged(splats: &SplatArrays, counts: &[usize]) -> Vec<Merged> {
    let mut merging = Merging::new(splats);
    counts
        .iter()
        .map(|&count| {
            while merging.left > count.max(1) && merging.step() {}
            merging.level(splats)
        })
        .collect()
}

struct Merging {
    clusters: Vec<Cluster>,
    /// Weighted means of SH, `stride` rows for each cluster.
    sh: Vec<[f32; 3]>,
    stride: usize,
    pairs: BinaryHeap<Pair>,
    left: usize,
    /// Weighted squares of moves.
    moves: f64,
}

impl Merging {
    fn new(splats: &SplatArrays) -> Self {
        let n = splats.len();
        let clusters = (0..n).map(|i| {
            let opacity = 1.0 / (1.0 + (-f64::from(splats.opacities[i])).exp());
            let scales =
                DVec3::from(splats.scales[i].map(|s| f64::from(s).clamp(-80.0, 80.0).exp()));
            let [w, x, y, z] = splats.quats[i].map(f64::from);
            let rotation = DMat3::from_quat(DQuat::from_xyzw(x, y, z, w).normalize());
            let along = rotation * DMat3::from_diagonal(scales);
            Cluster {
                weight: (opacity * area(scales)).max(TINY),
                mean: DVec3::from(splats.means[i].map(f64::from)),
                spread: along * along.transpose(),
                members: 1,
                version: 0,
                before: (i as u32).checked_sub(1).unwrap_or(NONE),
                after: if i + 1 < n { i as u32 + 1 } else { NONE },
            }
        });
        let mut sh = splats.sh.clone();
        // Colors darker than black are drawn black, so clamp them in means.
        for row in sh.chunks_exact_mut(splats.stride()) {
            row[0] = row[0].map(|c| c.max(BLACK));
        }
        let mut out = Self {
            clusters: clusters.collect(),
            sh,
            stride: splats.stride(),
            pairs: BinaryHeap::with_capacity(n),
            left: n,
            moves: 0.0,
        };
        for i in 0..n as u32 {
            out.offer(i);
        }
        out
    }

    /// Considers to merge a cluster with the next.
    fn offer(&mut self, i: u32) {
        if i == NONE || self.clusters[i as usize].after == NONE {
            return;
        }
        let one = &self.clusters[i as usize];
        let other = &self.clusters[one.after as usize];
        let color = |i: u32| DVec3::from(self.sh[i as usize * self.stride].map(f64::from));
        let apart = one.mean.distance_squared(other.mean);
        let size = trace(&one.spread) + trace(&other.spread);
        let unlike = color(i).distance_squared(color(one.after));
        let cost = reduced(one.weight, other.weight) * (apart + COLOR * size * unlike);
        let cost = if cost.is_nan() { f64::INFINITY } else { cost };
        self.pairs.push((Reverse((Cost(cost), i)), one.after, [one.version, other.version]));
    }

    /// Merges the two that cost least; false if there are none.
    fn step(&mut self) -> bool {
        while let Some((Reverse((_, i)), j, versions)) = self.pairs.pop() {
            let (one, other) = (self.clusters[i as usize], self.clusters[j as usize]);
            let is_current = one.members > 0
                && other.members > 0
                && one.after == j
                && [one.version, other.version] == versions;
            if is_current {
                self.merge(i, j);
                return true;
            }
        }
        false
    }

    fn merge(&mut self, i: u32, j: u32) {
        let (one, other) = (self.clusters[i as usize], self.clusters[j as usize]);
        let weight = one.weight + other.weight;
        let part = other.weight / weight;
        let apart = other.mean - one.mean;
        self.moves += reduced(one.weight, other.weight) * apart.length_squared();
        let outer = DMat3::from_cols(apart * apart.x, apart * apart.y, apart * apart.z);
        self.clusters[i as usize] = Cluster {
            weight,
            mean: one.mean + apart * part,
            spread: one.spread * (1.0 - part) + other.spread * part + outer * (part * (1.0 - part)),
            members: one.members + other.members,
            version: one.version + 1,
            before: one.before,
            after: other.after,
        };
        self.clusters[j as usize].members = 0;
        if other.after != NONE {
            self.clusters[other.after as usize].before = i;
        }
        for k in 0..self.stride {
            let second = self.sh[j as usize * self.stride + k];
            let first = &mut self.sh[i as usize * self.stride + k];
            for (a, b) in first.iter_mut().zip(second) {
                *a += ((f64::from(b) - f64::from(*a)) * part) as f32;
            }
        }
        self.left -= 1;
        self.offer(i);
        self.offer(one.before);
    }

    /// The clusters as splats; clusters of one splat are unchanged.
    fn level(&self, splats: &SplatArrays) -> Merged {
        let ids: Vec<usize> =
            (0..self.clusters.len()).filter(|&i| self.clusters[i].members > 0).collect();
        let mut out = splats.select(&ids);
        for (at, &i) in ids.iter().enumerate() {
            let cluster = &self.clusters[i];
            if cluster.members == 1 {
                continue;
            }
            let (squares, turned) = axes(cluster.spread.to_cols_array_2d());
            let sizes = DVec3::from(squares.map(|s| s.max(TINY).sqrt()));
            let opaque = (cluster.weight / area(sizes)).clamp(1e-4, OPACITY_MAX);
            // `turned` has the axes as columns, in rows.
            let turn = DQuat::from_mat3(&DMat3::from_cols_array_2d(&turned).transpose());
            out.means[at] = cluster.mean.as_vec3().to_array();
            out.quats[at] = [turn.w, turn.x, turn.y, turn.z].map(|c| c as f32);
            out.scales[at] = sizes.to_array().map(|s| s.ln() as f32);
            out.opacities[at] = (opaque / (1.0 - opaque)).ln() as f32;
            out.sh[at * self.stride..(at + 1) * self.stride]
                .copy_from_slice(&self.sh[i * self.stride..(i + 1) * self.stride]);
        }
        let total: f64 = ids.iter().map(|&i| self.clusters[i].weight).sum();
        Merged { splats: out, moved: (self.moves / total.max(TINY)).sqrt() }
    }
}

/// Increase of a sum of squares about the mean by merging two weights, per squared distance.
fn reduced(a: f64, b: f64) -> f64 {
    a * b / (a + b)
}

fn trace(m: &DMat3) -> f64 {
    m.x_axis.x + m.y_axis.y + m.z_axis.z
}

/// The surface of an ellipsoid with these half axes, up to a factor.
fn area(size: DVec3) -> f64 {
    size.x * size.y + size.y * size.z + size.z * size.x
}
