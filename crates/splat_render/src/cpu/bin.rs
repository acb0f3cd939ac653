//! bin: extents to splat ids ordered by (tile, depth, index).

use std::ops::Range;
use std::sync::atomic::{AtomicU32, AtomicU64, Ordering::Relaxed};

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
    /// How many of these are not 0.
    seen: usize,
}

impl ChunkTiles {
    pub fn clear(&mut self) {
        self.tiles.clear();
        self.counts.clear();
        self.seen = 0;
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
        let count = (self.tiles.len() - before) as u32;
        self.counts.push(count);
        self.seen += usize::from(count > 0);
    }
}

/// Fewest splats for which a task of the sort pays.
const GROUP: usize = 4096;

/// Splats sorted into tiles.
#[derive(Debug, Default)]
pub(super) struct Bins {
    /// `[tiles + 1]` start of each tile's list.
    pub starts: Vec<u32>,
    /// Splat ids by (tile, depth, index). Atomic, as are the others that many tasks write, each its
    /// own places all over them.
    pub splats: Vec<AtomicU32>,
    /// `[N + 1]` start of each splat's slots, splat-major.
    pub slots: Vec<u32>,
    /// Position in `splats` of each slot.
    pub position_from_slot: Vec<AtomicU32>,
    sort: DepthSort,
    /// By group of splats that follow each other in depth and by tile: pairs at first, then where
    /// the group's next pair goes.
    cursors: Vec<u32>,
}

impl Bins {
    /// Sorts the chunks' tiles. `depth(i)` is asked only for splats that touch a tile.
    ///
    /// There are as many tasks as threads, since each costs a look at all tiles; that shows in no
    /// result, because no two pairs have the same place in the order. Several must count their pairs
    /// before they can place them, which costs what a second thread brings.
    pub fn fill(
        &mut self,
        chunks: &[ChunkTiles],
        tiles: usize,
        depth: impl Fn(usize) -> f32 + Sync,
    ) -> Result<()> {
        let seen = chunks.iter().map(|chunk| chunk.seen).sum::<usize>();
        let threads = rayon::current_num_threads();
        let groups = if threads > 2 { threads.min(seen / GROUP).max(1) } else { 1 };
        let total = self.place_slots(chunks)?;
        self.sort.fill(chunks, seen, depth);
        self.sort.run(groups);

        let group = seen.div_ceil(groups).max(1);
        let (keys, slots) = (&self.sort.keys, &self.slots);
        self.cursors.clear();
        self.cursors.resize(groups * tiles, 0);
        if groups == 1 {
            // Tiles in any order will do: as they lie.
            for chunk in chunks {
                for &tile in &chunk.tiles {
                    self.cursors[tile as usize] += 1;
                }
            }
        } else {
            self.cursors.par_chunks_mut(tiles).zip(keys.par_chunks(group)).for_each(
                |(counts, keys)| {
                    for key in keys {
                        let (_, tiles) = tiles_of(chunks, slots, key);
                        for &tile in tiles {
                            counts[tile as usize] += 1;
                        }
                    }
                },
            );
        }
        self.starts.clear();
        self.starts.resize(tiles + 1, 0);
        for counts in self.cursors.chunks_exact(tiles) {
            for (sum, count) in self.starts[1..].iter_mut().zip(counts) {
                *sum += count;
            }
        }
        for tile in 0..tiles {
            self.starts[tile + 1] += self.starts[tile];
        }
        let mut next = self.starts.clone();
        for counts in self.cursors.chunks_exact_mut(tiles) {
            for (next, count) in next.iter_mut().zip(counts) {
                let pairs = std::mem::replace(count, *next);
                *next += pairs;
            }
        }

        self.splats.resize_with(total, AtomicU32::default);
        self.position_from_slot.resize_with(total, AtomicU32::default);
        let (splats, position_from_slot) = (&self.splats, &self.position_from_slot);
        self.cursors.par_chunks_mut(tiles).zip(keys.par_chunks(group)).for_each(
            |(cursors, keys)| {
                for key in keys {
                    let (i, tiles) = tiles_of(chunks, slots, key);
                    let positions = &position_from_slot[slots[i] as usize..][..tiles.len()];
                    for (place, &tile) in positions.iter().zip(tiles) {
                        let cursor = &mut cursors[tile as usize];
                        splats[*cursor as usize].store(i as u32, Relaxed);
                        place.store(*cursor, Relaxed);
                        *cursor += 1;
                    }
                }
            },
        );
        Ok(())
    }

    /// Fills `slots` and returns how many there are.
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
        (self.slots[1..].par_chunks_mut(CHUNK), chunks, firsts).into_par_iter().for_each(
            |(slots, chunk, mut total)| {
                for (slot, count) in slots.iter_mut().zip(&chunk.counts) {
                    total += count;
                    *slot = total;
                }
            },
        );
        Ok(total as usize)
    }

    /// Copies what belongs to the pairs of a run of splats, splat-major. Pairs lie anywhere in
    /// memory: asked for together, they are waited for together.
    pub fn take_pairs<T: Copy>(&self, splats: Range<usize>, from: &[T], to: &mut Vec<T>) {
        let slots = self.slots[splats.start] as usize..self.slots[splats.end] as usize;
        to.clear();
        to.extend(
            self.position_from_slot[slots]
                .iter()
                .map(|position| from[position.load(Relaxed) as usize]),
        );
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

/// The splat of a key, and the tiles that it touches.
#[inline(always)]
fn tiles_of<'a>(chunks: &'a [ChunkTiles], slots: &[u32], key: &AtomicU64) -> (usize, &'a [u32]) {
    let i = (key.load(Relaxed) & 0xffff_ffff) as usize;
    let base = slots[i / CHUNK * CHUNK];
    let range = (slots[i] - base) as usize..(slots[i + 1] - base) as usize;
    (i, &chunks[i / CHUNK].tiles[range])
}

/// Splats in the order of their depths.
#[derive(Debug, Default)]
struct DepthSort {
    /// Depth in the upper 32 bits, index in the lower ones.
    keys: Vec<AtomicU64>,
    spare: Vec<AtomicU64>,
    /// By group and pass: keys of each digit at first, then where the next one goes.
    counts: Vec<[[u32; DIGITS]; PASSES]>,
}

/// Bits of a digit of the sort, how many values it has, and digits of a depth.
const BITS: u32 = 11;
const DIGITS: usize = 1 << BITS;
const PASSES: usize = 3;

impl DepthSort {
    /// Takes in the `seen` splats that touch a tile, by index.
    fn fill(&mut self, chunks: &[ChunkTiles], seen: usize, depth: impl Fn(usize) -> f32 + Sync) {
        self.keys.resize_with(seen, AtomicU64::default);
        self.spare.resize_with(seen, AtomicU64::default);
        let mut rest = self.keys.as_mut_slice();
        let mut parts = Vec::with_capacity(chunks.len());
        for chunk in chunks {
            let (part, after) = rest.split_at_mut(chunk.seen);
            parts.push(part);
            rest = after;
        }
        parts.into_par_iter().zip(chunks).enumerate().for_each(|(k, (keys, chunk))| {
            let seen = chunk.counts.iter().enumerate().filter(|(_, count)| **count > 0);
            for (key, (at, _)) in keys.iter_mut().zip(seen) {
                let i = k * CHUNK + at;
                // Depths are positive, so their bits order as they do; the index breaks ties.
                *key.get_mut() = u64::from(depth(i).to_bits()) << 32 | i as u64;
            }
        });
    }

    /// Stable least-significant-digit radix sort by depth, by so many groups of keys side by side.
    fn run(&mut self, groups: usize) {
        let group = self.keys.len().div_ceil(groups).max(1);
        self.counts.clear();
        self.counts.resize(groups, [[0; DIGITS]; PASSES]);
        for pass in 0..PASSES {
            let (keys, spare) = (&self.keys, &self.spare);
            // What a group has of each digit changes from pass to pass, but not if it has all keys.
            let counted = if groups > 1 { pass..pass + 1 } else { 0..PASSES };
            if groups > 1 || pass == 0 {
                self.counts.par_iter_mut().zip(keys.par_chunks(group)).for_each(
                    |(counts, keys)| {
                        for key in keys {
                            let key = key.load(Relaxed);
                            for pass in counted.clone() {
                                counts[pass][digit(key, pass)] += 1;
                            }
                        }
                    },
                );
            }
            let mut sum = 0;
            for digit in 0..DIGITS {
                for counts in &mut self.counts {
                    sum += std::mem::replace(&mut counts[pass][digit], sum);
                }
            }
            self.counts.par_iter_mut().zip(keys.par_chunks(group)).for_each(|(counts, keys)| {
                for key in keys {
                    let key = key.load(Relaxed);
                    let cursor = &mut counts[pass][digit(key, pass)];
                    spare[*cursor as usize].store(key, Relaxed);
                    *cursor += 1;
                }
            });
            std::mem::swap(&mut self.keys, &mut self.spare);
        }
    }
}

/// The digit of a key's depth that a pass sorts by.
#[inline(always)]
fn digit(key: u64, pass: usize) -> usize {
    (key >> (32 + BITS * pass as u32)) as usize & (DIGITS - 1)
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
        for groups in [1, 2, 5] {
            let key = |(i, d): (usize, &f32)| (u64::from(d.to_bits()) << 32 | i as u64).into();
            let keys = depths.iter().enumerate().map(key).collect();
            let spare = depths.iter().map(|_| AtomicU64::default()).collect();
            let mut sort = DepthSort { keys, spare, counts: Vec::new() };
            sort.run(groups);
            let ids: Vec<u64> = sort.keys.iter().map(|k| k.load(Relaxed) & 0xffff_ffff).collect();
            assert_eq!(ids, [4, 1, 3, 2, 6, 0, 5], "{groups} groups");
        }
    }

    /// The lists of many splats on any number of threads are those of a plain sort.
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
            let ids: Vec<u32> = bins.splats.iter().map(|id| id.load(Relaxed)).collect();
            assert!(ids.iter().eq(expected.iter().map(|(_, _, i)| i)), "{threads} threads");
            for (tile, of_tile) in (0..tiles).map(|tile| (tile, bins.range(tile))) {
                assert!(expected[of_tile].iter().all(|pair| pair.0 as usize == tile));
            }
            for (pair, position) in by_slot.iter().zip(&bins.position_from_slot) {
                assert_eq!(expected[position.load(Relaxed) as usize], *pair);
            }
            for i in 0..n {
                let slots = bins.slots[i] as usize..bins.slots[i + 1] as usize;
                assert!(by_slot[slots].iter().all(|pair| pair.2 as usize == i));
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
