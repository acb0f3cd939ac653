//! bin: extents to splat ids ordered by (tile, depth, index).

use std::ops::Range;

use rayon::prelude::*;

use super::project::Splat2d;
use super::tile::TileSplat;
use crate::constants::{ALPHA_MIN, TILE};
use crate::error::{Error, Result};
use crate::stages::Projected;

/// Splats per parallel task.
pub(super) const CHUNK: usize = 1024;

/// Tiles that splats touch, in splat order, one chunk of [`CHUNK`] splats each.
#[derive(Debug, Default, Clone)]
pub(super) struct ChunkTiles {
    /// Tile ids, splat-major: a splat's ids are contiguous.
    tiles: Vec<u32>,
    /// Number of tiles of each splat of the chunk.
    counts: Vec<u32>,
}

impl ChunkTiles {
    pub fn clear(&mut self) {
        self.tiles.clear();
        self.counts.clear();
    }

    /// Appends a splat that touches nothing.
    pub fn push_culled(&mut self) {
        self.counts.push(0);
    }

    /// Appends the tiles that a visible splat touches: per row of tiles, the exact span of its
    /// ellipse {alpha >= ALPHA_MIN} within the band of that row's pixel centres, a little widened
    /// against rounding.
    pub fn push(&mut self, splat: &Splat2d, width: u32, height: u32) {
        let before = self.tiles.len();
        let tile = TILE as f32;
        let (columns, rows) = (width.div_ceil(TILE), height.div_ceil(TILE));
        let [mx, my] = splat.mean;
        let [p, q, r] = splat.factor;
        let [rx, ry] = splat.radii;
        let reach = 2.0 * (splat.opacity / ALPHA_MIN).ln() * (1.0 + 1e-5) + 1e-5;
        let slack = |radius: f32, center: f32| 1e-2 + 4e-6 * (radius + center.abs());
        let (slack_x, slack_y) = (slack(rx, mx), slack(ry, my));
        // First and last row of tiles whose band of pixel centres meets the box.
        let row_of = |y: f32| (y / tile).floor().clamp(0.0, (rows - 1) as f32) as u32;
        let (first, last) = (row_of(my - ry - slack_y - 0.5), row_of(my + ry + slack_y - 0.5));
        // Height at which the ellipse is widest to the right; to the left it is the opposite.
        let widest = -q * reach.sqrt() / (r * (q * q + r * r).sqrt());
        for row in first..=last {
            let low = (row * TILE) as f32 + 0.5 - my;
            let high = low + (tile - 1.0);
            let at = |dy: f32, side: f32| {
                let dy = dy.clamp(low, high);
                let rest = (reach - (r * dy) * (r * dy)).max(0.0).sqrt();
                (-q * dy + side * rest) / p
            };
            // The whole band lies above or below the ellipse.
            let nearest = 0.0f32.clamp(low, high);
            if (r * nearest) * (r * nearest) > reach {
                continue;
            }
            let right = mx + at(widest, 1.0) + slack_x;
            let left = mx + at(-widest, -1.0) - slack_x;
            if !(right >= 0.5 && left <= width as f32 - 0.5) {
                continue;
            }
            let column_of = |x: f32| (x / tile).floor().clamp(0.0, (columns - 1) as f32) as u32;
            // A tile's last pixel centre lies half a pixel before its right edge, hence the -0.5
            // on the right and, on the left, the +0.5 on the tile that ends there.
            let from = column_of(left + 0.5);
            let to = column_of(right - 0.5);
            for column in from..=to {
                self.tiles.push(row * columns + column);
            }
        }
        self.counts.push((self.tiles.len() - before) as u32);
    }
}

/// Splats sorted into tiles.
#[derive(Debug, Default, Clone)]
pub(super) struct Bins {
    /// `[tiles + 1]` start of each tile's list.
    pub starts: Vec<u32>,
    /// Splat ids by (tile, depth, index).
    pub splats: Vec<u32>,
    /// `[N + 1]` start of each splat's slots, splat-major.
    pub slots: Vec<u32>,
    /// Position in `splats` of each slot.
    pub position_from_slot: Vec<u32>,
    keys: Vec<u64>,
    spare: Vec<u64>,
}

impl Bins {
    /// Sorts the chunks' tiles. `depth(i)` is asked only for splats that touch a tile.
    pub fn fill(
        &mut self,
        chunks: &[ChunkTiles],
        tiles: usize,
        depth: impl Fn(usize) -> f32,
    ) -> Result<()> {
        self.starts.clear();
        self.starts.resize(tiles + 1, 0);
        self.slots.clear();
        self.slots.push(0);
        self.keys.clear();
        let mut total = 0u32;
        let mut i = 0usize;
        for chunk in chunks {
            for &tile in &chunk.tiles {
                self.starts[tile as usize + 1] += 1;
            }
            for &count in &chunk.counts {
                if count > 0 {
                    // Depths are positive, so their bits order as they do; the index breaks ties.
                    self.keys.push(u64::from(depth(i).to_bits()) << 32 | i as u64);
                }
                total = total.checked_add(count).ok_or_else(|| {
                    let reason = "touch more than 2^32 tiles; render a smaller picture";
                    Error::argument("splats", reason)
                })?;
                self.slots.push(total);
                i += 1;
            }
        }
        for tile in 0..tiles {
            self.starts[tile + 1] += self.starts[tile];
        }
        sort_by_depth(&mut self.keys, &mut self.spare);

        self.splats.resize(total as usize, 0);
        self.position_from_slot.resize(total as usize, 0);
        let mut cursors = self.starts.clone();
        for &key in &self.keys {
            let i = (key & 0xffff_ffff) as usize;
            let chunk = &chunks[i / CHUNK];
            let base = self.slots[i / CHUNK * CHUNK] as usize;
            for slot in self.slots[i] as usize..self.slots[i + 1] as usize {
                let cursor = &mut cursors[chunk.tiles[slot - base] as usize];
                self.splats[*cursor as usize] = i as u32;
                self.position_from_slot[slot] = *cursor;
                *cursor += 1;
            }
        }
        Ok(())
    }

    /// Copies what belongs to the pairs of a run of splats, splat-major. Pairs lie anywhere in
    /// memory: asked for together, they are waited for together.
    pub fn take_pairs<T: Copy>(&self, splats: Range<usize>, from: &[T], to: &mut Vec<T>) {
        let slots = self.slots[splats.start] as usize..self.slots[splats.end] as usize;
        to.clear();
        to.extend(self.position_from_slot[slots].iter().map(|&position| from[position as usize]));
    }

    /// Where splat `i`'s pairs lie in what [`Bins::take_pairs`] took of a run that begins with
    /// splat `first`.
    pub fn pairs_of(&self, first: usize, i: usize) -> Range<usize> {
        let base = self.slots[first];
        (self.slots[i] - base) as usize..(self.slots[i + 1] - base) as usize
    }

    /// Positions in `splats` of a tile's list.
    pub fn range(&self, tile: usize) -> Range<usize> {
        self.starts[tile] as usize..self.starts[tile + 1] as usize
    }
}

/// Stable least-significant-digit radix sort by the upper 32 bits: three passes of 11 bits.
fn sort_by_depth(keys: &mut Vec<u64>, spare: &mut Vec<u64>) {
    const BITS: u32 = 11;
    const SIZE: usize = 1 << BITS;
    spare.resize(keys.len(), 0);
    let mut counts = vec![[0u32; SIZE]; 3];
    for &key in keys.iter() {
        for (pass, counts) in counts.iter_mut().enumerate() {
            counts[(key >> (32 + BITS * pass as u32)) as usize & (SIZE - 1)] += 1;
        }
    }
    for (pass, counts) in counts.iter_mut().enumerate() {
        let mut sum = 0;
        for count in counts.iter_mut() {
            sum += std::mem::replace(count, sum);
        }
        for &key in keys.iter() {
            let cursor = &mut counts[(key >> (32 + BITS * pass as u32)) as usize & (SIZE - 1)];
            spare[*cursor as usize] = key;
            *cursor += 1;
        }
        std::mem::swap(keys, spare);
    }
}

/// Tiles of all splats, in parallel over chunks.
fn touched_tiles(splats: &[Option<Splat2d>], width: u32, height: u32) -> Vec<ChunkTiles> {
    splats
        .par_chunks(CHUNK)
        .map(|chunk| {
            let mut tiles = ChunkTiles::default();
            for splat in chunk {
                match splat {
                    Some(splat) => tiles.push(splat, width, height),
                    None => tiles.push_culled(),
                }
            }
            tiles
        })
        .collect()
}

/// 2D splats, None where they are not drawn.
fn splats2d(projected: &Projected<f32>) -> Vec<Option<Splat2d>> {
    (0..projected.len())
        .map(|i| {
            projected.is_drawn(i).then(|| Splat2d {
                mean: projected.means2d[i],
                factor: projected.factors[i],
                depth: projected.depths[i],
                color: projected.colors[i],
                opacity: projected.opacities[i],
                radii: projected.radii[i],
            })
        })
        .collect()
}

/// What the rasterize stages read.
pub(super) struct Binned {
    pub splats: Vec<TileSplat>,
    pub bins: Bins,
}

pub(super) fn bin(projected: &Projected<f32>) -> Result<Binned> {
    let splats = splats2d(projected);
    let chunks = touched_tiles(&splats, projected.width, projected.height);
    let tiles = projected.width.div_ceil(TILE) * projected.height.div_ceil(TILE);
    let mut bins = Bins::default();
    bins.fill(&chunks, tiles as usize, |i| projected.depths[i])?;
    let splats =
        splats.iter().map(|s| s.as_ref().map_or_else(TileSplat::default, TileSplat::new)).collect();
    Ok(Binned { splats, bins })
}

#[cfg(test)]
mod tests {
    use rand::{Rng, SeedableRng};

    use super::*;

    #[test]
    fn radix_sort_orders_by_depth_then_index() {
        let depths = [3.0f32, 1.0, 2.0, 1.0, 1e-3, 1e9, 2.0];
        let mut keys: Vec<u64> = depths
            .iter()
            .enumerate()
            .map(|(i, d)| u64::from(d.to_bits()) << 32 | i as u64)
            .collect();
        sort_by_depth(&mut keys, &mut Vec::new());
        let ids: Vec<u64> = keys.iter().map(|k| k & 0xffff_ffff).collect();
        assert_eq!(ids, [4, 1, 3, 2, 6, 0, 5]);
    }

    /// Every tile with a pixel that a splat reaches is listed, and hardly any other.
    #[test]
    fn tiles_are_those_that_splats_reach() {
        let mut rng = rand_pcg::Pcg64::seed_from_u64(7);
        let (width, height) = (203u32, 150u32);
        let (columns, rows) = (width.div_ceil(TILE), height.div_ceil(TILE));
        let (mut listed, mut needed) = (0, 0);
        for _ in 0..3000 {
            let mut deviation = || rng.random_range(0.0f64..4.5).exp() * 0.3;
            let (long, short) = (deviation(), deviation());
            let (sin, cos) = rng.random_range(0.0..std::f64::consts::TAU).sin_cos();
            let xx = (long * cos).powi(2) + (short * sin).powi(2);
            let yy = (long * sin).powi(2) + (short * cos).powi(2);
            let xy = (long * long - short * short) * sin * cos;
            let det = (long * short).powi(2);
            let factor = [(yy / det).sqrt(), -xy / (yy * det).sqrt(), yy.sqrt().recip()];
            let opacity = rng.random_range(0.005..1.0);
            let reach = (2.0 * (opacity / f64::from(ALPHA_MIN)).ln()).sqrt();
            let splat = Splat2d {
                mean: [rng.random_range(-40.0..243.0), rng.random_range(-40.0..190.0)],
                factor: factor.map(|v| v as f32),
                depth: 1.0,
                color: [0.0; 3],
                opacity: opacity as f32,
                radii: [reach * xx.sqrt(), reach * yy.sqrt()].map(|v| v as f32),
            };
            let mut tiles = ChunkTiles::default();
            tiles.push(&splat, width, height);
            listed += tiles.tiles.len();
            let [p, q, r] = splat.factor.map(f64::from);
            for tile in 0..columns * rows {
                let (left, top) = (tile % columns * TILE, tile / columns * TILE);
                let reached = (top..(top + TILE).min(height)).any(|y| {
                    (left..(left + TILE).min(width)).any(|x| {
                        let dx = f64::from(x) + 0.5 - f64::from(splat.mean[0]);
                        let dy = f64::from(y) + 0.5 - f64::from(splat.mean[1]);
                        let (u, v) = (p * dx + q * dy, r * dy);
                        opacity * (-0.5 * (u * u + v * v)).exp() >= f64::from(ALPHA_MIN)
                    })
                });
                assert!(!reached || tiles.tiles.contains(&tile), "{splat:?} misses tile {tile}");
                needed += usize::from(reached);
            }
        }
        assert!(needed > 10_000, "only {needed} tiles are reached");
        let excess = listed as f64 / needed as f64 - 1.0;
        println!("{listed} tiles listed, {needed} reached: {:.2} % too many", 100.0 * excess);
        // Those that an ellipse enters between pixel centres only.
        assert!(excess < 0.03, "{listed} tiles are listed where {needed} are reached");
    }
}
