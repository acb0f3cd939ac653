//! bin: extents to splat ids ordered by (tile, depth, index).

use std::ops::Range;
use std::sync::atomic::{AtomicU32, Ordering::Relaxed};

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

    /// Appends the tiles of a visible splat: per row of tiles, the span of its ellipse {alpha >=
    /// ALPHA_MIN} within the band of that row's pixel centers, slightly widened against rounding.
    pub fn push(&mut self, splat: &Splat2d, width: u32, height: u32) {
        let before = self.tiles.len();
        self.push_tiles(splat, width, height);
        self.counts.push((self.tiles.len() - before) as u32);
    }

    fn push_tiles(&mut self, splat: &Splat2d, width: u32, height: u32) {
        let tile = TILE as f32;
        let (columns, rows) = (width.div_ceil(TILE), height.div_ceil(TILE));
        let [mx, my] = splat.mean;
        let [p, q, r] = splat.factor;
        let [rx, ry] = splat.radii;
        let reach = splat.reach * (1.0 + 1e-5) + 1e-5;
        let slack = |radius: f32, center: f32| 1e-2 + 4e-6 * (radius + center.abs());
        let (slack_x, slack_y) = (slack(rx, mx), slack(ry, my));
        // Tiles with a pixel center in [low, high]; a tile's first and last center are half a pixel
        // inside. After the clamp, truncation rounds down.
        let tiles_of = |low: f32, high: f32, count: u32| {
            let of = |x: f32| (x / tile).clamp(0.0, (count - 1) as f32) as u32;
            of(low + 0.5)..=of(high - 0.5)
        };
        let box_x = [mx - rx - slack_x, mx + rx + slack_x];
        let in_box = tiles_of(box_x[0], box_x[1], columns);
        let is_seen = |[left, right]: [f32; 2]| right >= 0.5 && left <= width as f32 - 0.5;
        if !is_seen(box_x) {
            return;
        }
        // Height at which the ellipse is widest to the right; to the left it is the opposite.
        let widest = -q * reach.sqrt() / (r * (q * q + r * r).sqrt());
        let inverse_p = 1.0 / p;
        let rows_in_box = tiles_of(my - ry - slack_y, my + ry + slack_y, rows);
        let is_one = in_box.start() == in_box.end() && rows_in_box.start() == rows_in_box.end();
        for row in rows_in_box {
            let low = (row * TILE) as f32 + 0.5 - my;
            let high = low + (tile - 1.0);
            // The whole band lies above or below the ellipse.
            let nearest = 0.0f32.clamp(low, high);
            if (r * nearest) * (r * nearest) > reach {
                continue;
            }
            let first = row * columns;
            if is_one {
                self.tiles.push(first + in_box.start());
                continue;
            }
            let at = |dy: f32, side: f32| {
                let dy = dy.clamp(low, high);
                let rest = (reach - (r * dy) * (r * dy)).max(0.0).sqrt();
                (-q * dy + side * rest) * inverse_p
            };
            let right = mx + at(widest, 1.0) + slack_x;
            let left = mx + at(-widest, -1.0) - slack_x;
            if is_seen([left, right]) {
                self.tiles.extend(tiles_of(left, right, columns).map(|column| first + column));
            }
        }
    }
}

/// Fewest pairs for which a task of their own pays.
const GROUP: usize = 1 << 14;

#[derive(Debug, Default)]
pub(super) struct Bins {
    /// `[tiles + 1]` start of each tile's list.
    pub starts: Vec<u32>,
    /// Splat ids by (tile, depth, index); slots during the sort. Atomic, since tasks interleave.
    pub splats: Vec<AtomicU32>,
    /// `[N + 1]` start of each splat's slots: a place per pair, splat-major.
    slots: Vec<u32>,
    /// Position in `splats` of each slot. While they are sorted, the slot's splat.
    position_from_slot: Vec<AtomicU32>,
    /// By group of splats and by tile: the number of pairs, then the position of the next pair.
    cursors: Vec<u32>,
}

impl Bins {
    /// Sorts the chunks' tiles. `depth(i)` is called only for splats that touch a tile. Tasks first put
    /// splats into tiles in memory order, then sort each tile's list, which fits into the cache. All keys
    /// differ, so the result does not depend on the tasks.
    pub fn fill(
        &mut self,
        chunks: &[ChunkTiles],
        tiles: usize,
        depth: impl Fn(usize) -> f32 + Sync,
    ) -> Result<()> {
        let total = self.place_slots(chunks)?;
        let groups = rayon::current_num_threads().min(total / GROUP).max(1);
        let group = chunks.len().div_ceil(groups).max(1);
        self.cursors.clear();
        self.cursors.resize(groups * tiles, 0);
        self.cursors.par_chunks_mut(tiles).zip(chunks.par_chunks(group)).for_each(
            |(counts, chunks)| {
                for &tile in chunks.iter().flat_map(|chunk| &chunk.tiles) {
                    counts[tile as usize] += 1;
                }
            },
        );
        self.starts.clear();
        self.starts.reserve(tiles + 1);
        let mut next = 0;
        for tile in 0..tiles {
            self.starts.push(next);
            for counts in self.cursors.chunks_exact_mut(tiles) {
                next += std::mem::replace(&mut counts[tile], next);
            }
        }
        self.starts.push(next);

        self.splats.resize_with(total, AtomicU32::default);
        let (splats, slots) = (&self.splats, &self.slots);
        self.cursors.par_chunks_mut(tiles).zip(chunks.par_chunks(group)).enumerate().for_each(
            |(g, (cursors, chunks))| {
                let first_slot = slots[g * group * CHUNK];
                let tiles = chunks.iter().flat_map(|chunk| &chunk.tiles);
                for (slot, &tile) in (first_slot..).zip(tiles) {
                    let cursor = &mut cursors[tile as usize];
                    splats[*cursor as usize].store(slot, Relaxed);
                    *cursor += 1;
                }
            },
        );
        let (starts, positions) = (&self.starts, &self.position_from_slot);
        (0..tiles).into_par_iter().for_each_init(Vec::new, |keys, tile| {
            let list = starts[tile] as usize..starts[tile + 1] as usize;
            keys.clear();
            keys.extend(splats[list.clone()].iter().map(|slot| {
                let slot = slot.load(Relaxed);
                let splat = positions[slot as usize].load(Relaxed) as usize;
                // Depths are positive, so their bits order as they do; slots break ties.
                u64::from(depth(splat).to_bits()) << 32 | u64::from(slot)
            }));
            keys.sort_unstable();
            for (position, key) in list.zip(keys) {
                let slot = (*key & 0xffff_ffff) as usize;
                splats[position].store(positions[slot].load(Relaxed), Relaxed);
                positions[slot].store(position as u32, Relaxed);
            }
        });
        Ok(())
    }

    /// Fills `slots` and the splats of each, and returns how many slots there are.
    fn place_slots(&mut self, chunks: &[ChunkTiles]) -> Result<usize> {
        let mut total = 0u32;
        let mut firsts = Vec::with_capacity(chunks.len());
        for chunk in chunks {
            firsts.push(total);
            let count = u32::try_from(chunk.tiles.len()).ok();
            total = count.and_then(|count| total.checked_add(count)).ok_or_else(|| {
                let reason = "touch more than 2^32 tiles; render a smaller picture";
                Error::argument("splats", reason)
            })?;
        }
        let splats = chunks.iter().map(|chunk| chunk.counts.len()).sum::<usize>();
        self.slots.resize(splats + 1, 0);
        self.slots[0] = 0;
        self.position_from_slot.resize_with(total as usize, AtomicU32::default);
        let mut rest = self.position_from_slot.as_mut_slice();
        let mut owners = Vec::with_capacity(chunks.len());
        for chunk in chunks {
            let (part, after) = rest.split_at_mut(chunk.tiles.len());
            owners.push(part);
            rest = after;
        }
        (self.slots[1..].par_chunks_mut(CHUNK), chunks, firsts, owners)
            .into_par_iter()
            .enumerate()
            .for_each(|(k, (slots, chunk, mut total, owners))| {
                let mut owners = owners.iter_mut();
                for (at, (slot, &count)) in slots.iter_mut().zip(&chunk.counts).enumerate() {
                    total += count;
                    *slot = total;
                    for owner in owners.by_ref().take(count as usize) {
                        *owner.get_mut() = (k * CHUNK + at) as u32;
                    }
                }
            });
        Ok(total as usize)
    }

    /// Positions in `splats` of the pairs of a run of splats, splat-major.
    #[inline(always)]
    pub fn positions_of(&self, splats: Range<usize>) -> impl Iterator<Item = usize> {
        let slots = self.slots[splats.start] as usize..self.slots[splats.end] as usize;
        self.position_from_slot[slots].iter().map(|position| position.load(Relaxed) as usize)
    }

    /// Positions in `splats` of a tile's list.
    pub fn range(&self, tile: usize) -> Range<usize> {
        self.starts[tile] as usize..self.starts[tile + 1] as usize
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

fn splats2d(projected: &Projected<f32>) -> Vec<Option<Splat2d>> {
    (0..projected.len())
        .map(|i| {
            projected.is_drawn(i).then(|| Splat2d {
                mean: projected.means2d[i],
                factor: projected.factors[i],
                depth: projected.depths[i],
                color: projected.colors[i],
                opacity: projected.opacities[i],
                reach: 2.0 * (projected.opacities[i] / ALPHA_MIN).ln(),
                radii: projected.radii[i],
            })
        })
        .collect()
}

/// Input of the rasterize stages.
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

    /// The lists of many splats equal a plain sort's for any number of threads.
    #[test]
    fn lists_are_sorted_by_tile_depth_and_index() {
        let mut rng = rand_pcg::Pcg64::seed_from_u64(8);
        let (width, height, n) = (320u32, 240u32, 30_000);
        let depths: Vec<f32> = (0..n).map(|_| rng.random_range(1..500) as f32).collect();
        let splats: Vec<Option<Splat2d>> = depths
            .iter()
            .map(|&depth| {
                let side = rng.random_range(0.5f32..12.0);
                let mean =
                    [rng.random_range(0.0..width as f32), rng.random_range(0.0..height as f32)];
                rng.random_bool(0.8).then(|| Splat2d {
                    mean,
                    factor: [3.0 / side, 0.0, 3.0 / side],
                    depth,
                    color: [0.0; 3],
                    opacity: 0.9,
                    reach: 2.0 * (0.9 / ALPHA_MIN).ln(),
                    radii: [side; 2],
                })
            })
            .collect();
        let chunks = touched_tiles(&splats, width, height);
        let tiles = (width.div_ceil(TILE) * height.div_ceil(TILE)) as usize;
        let mut expected = Vec::new();
        for (k, chunk) in chunks.iter().enumerate() {
            let mut tiles = chunk.tiles.iter();
            for (at, &count) in chunk.counts.iter().enumerate() {
                let i = k * CHUNK + at;
                let pairs = tiles.by_ref().take(count as usize);
                expected.extend(pairs.map(|&tile| (tile, depths[i].to_bits(), i as u32)));
            }
        }
        let by_slot = expected.clone();
        expected.sort_unstable();
        let mut bins = Bins::default();
        for threads in [1, 2, 3, 8] {
            let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
            pool.install(|| bins.fill(&chunks, tiles, |i| depths[i])).unwrap();
            let ids = bins.splats.iter().map(|id| id.load(Relaxed));
            assert!(ids.eq(expected.iter().map(|(_, _, i)| *i)), "{threads} threads");
            for (tile, of_tile) in (0..tiles).map(|tile| (tile, bins.range(tile))) {
                assert!(expected[of_tile].iter().all(|pair| pair.0 as usize == tile));
            }
            let by_position = bins.positions_of(0..n).map(|position| expected[position]);
            assert!(by_position.eq(by_slot.iter().copied()), "{threads} threads");
            for i in 0..n {
                assert!(bins.positions_of(i..i + 1).all(|at| expected[at].2 as usize == i));
            }
        }
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
                reach: (reach * reach) as f32,
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
        // Tiles that an ellipse enters only between pixel centers.
        assert!(excess < 0.03, "{listed} tiles are listed where {needed} are reached");
    }
}
