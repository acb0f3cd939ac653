//! bin: 2D splats to lists of splats per tile, ordered by depth and index.
//!
//! All splats are sorted by depth first; each then emits its tiles in that order, and a stable
//! sort by tile alone leaves every tile's list in depth order.

use std::ops::Range;

use bytemuck::Zeroable;

use super::device::{Gpu, Groups, Op};
use super::kernels::Kernel;
use super::layout::{ALL_SPLATS, Chunk, ChunkCount, SUM_ROWS, SUM_SETS, SortPass, StatusHead};
use super::project::Projection;
use crate::constants::TILE;
use crate::error::{Error, Result};

/// Buffers that grow with the splats.
#[derive(Debug)]
pub(super) struct SplatBins {
    splats: u32,
    keys: [wgpu::Buffer; 2],
    order: [wgpu::Buffer; 2],
    /// Start of each rank's pairs, and the total.
    pub offsets: wgpu::Buffer,
    segment_sums: wgpu::Buffer,
    histogram: wgpu::Buffer,
    /// Dispatches and draws whose size only the device knows, as bin_scan.wgsl lays them out.
    pub dispatches: wgpu::Buffer,
    /// Counts that only the device knows.
    pub status: wgpu::Buffer,
}

/// Buffers that grow with the pairs and tiles.
#[derive(Debug)]
pub(super) struct PairBins {
    capacity: u32,
    digit_bits: u32,
    keys: [wgpu::Buffer; 2],
    slots: [wgpu::Buffer; 2],
    splat_from_slot: wgpu::Buffer,
    /// Start of each tile's pairs, the end of all tiles' pairs, and the number of pairs.
    pub tile_begin: wgpu::Buffer,
}

/// A contiguous run of tiles whose pairs fit the buffers.
#[derive(Debug)]
pub(super) struct TileChunk {
    pub chunk: Chunk,
    pub uniform: wgpu::Buffer,
    /// The same for each dispatch of the rasterize kernels, which walk a part of all lists each.
    pub passes: Vec<wgpu::Buffer>,
}

impl TileChunk {
    pub fn new(gpu: &Gpu, chunk: Chunk) -> Self {
        let chunk = Chunk { groups_max: gpu.groups_max, ..chunk };
        // A splat is in a tile's list once at most.
        let longest = chunk.splats.min(chunk.capacity).max(1);
        let passes = (0..longest)
            .step_by(gpu.list_limit as usize)
            .map(|list_begin| {
                let list_end = list_begin.saturating_add(gpu.list_limit);
                gpu.uniform(&Chunk { list_begin, list_end, ..chunk })
            })
            .collect();
        Self { chunk, uniform: gpu.uniform(&chunk), passes }
    }

    pub fn tiles(&self) -> u32 {
        self.chunk.tile_end - self.chunk.tile_begin
    }
}

pub(super) fn tile_count(width: u32, height: u32) -> u32 {
    width.div_ceil(TILE) * height.div_ceil(TILE)
}

/// Maximum number of pairs whose gradient slots of `slot_floats` floats can be bound at once.
pub(super) fn pair_limit(gpu: &Gpu, slot_floats: usize) -> u32 {
    (gpu.binding_limit / (slot_floats as u64 * 4)).min(u64::from(u32::MAX / 2)) as u32
}

impl SplatBins {
    pub fn new(gpu: &Gpu, splats: u32, chunks: u32) -> Result<Self> {
        let words = |n: u32| u64::from(n) * 4;
        let pair = |label| -> Result<[wgpu::Buffer; 2]> {
            Ok([gpu.bindable(label, words(splats))?, gpu.bindable(label, words(splats))?])
        };
        let status = gpu.bindable("status", Self::status_bytes(chunks))?;
        let head = StatusHead { splats, step: 1, overflow: 0, visible: 0 };
        gpu.write(&status, 0, bytemuck::bytes_of(&head));
        Ok(Self {
            splats,
            keys: pair("depth keys")?,
            order: pair("depth order")?,
            offsets: gpu.bindable("offsets", words(splats) + 4)?,
            segment_sums: gpu.buffer("segment sums", words(gpu.segments()))?,
            histogram: gpu.zeroed("histogram", words(histogram_rows(gpu) << gpu.digit_bits()))?,
            dispatches: gpu.buffer("dispatches", 56)?,
            status,
        })
    }

    /// Bytes of [`Self::status`] for `chunks` chunks.
    pub fn status_bytes(chunks: u32) -> u64 {
        size_of::<StatusHead>() as u64 + u64::from(chunks.max(1)) * size_of::<ChunkCount>() as u64
    }

    /// Splats by depth; the result of the sort after an even number of passes.
    pub fn order(&self) -> &wgpu::Buffer {
        &self.order[0]
    }

    /// The depth keys, input of [`Self::depth_ops`].
    pub fn keys(&self) -> &wgpu::Buffer {
        &self.keys[0]
    }

    /// Makes the depth keys of splats that were projected before.
    pub fn key_op(&self, gpu: &Gpu, drawn: Projection<'_>, chunk: &TileChunk) -> Op {
        let bindings = [
            drawn.view.into(),
            (&chunk.uniform).into(),
            drawn.splats2d.into(),
            (&self.status).into(),
            self.order().into(),
            self.keys().into(),
            (&self.segment_sums).into(),
        ];
        gpu.op(Kernel::DepthKeys, &bindings, gpu.groups(self.splats, 256))
    }

    /// Sorts the splats by depth and leaves culled ones out; counts the rest in [`Self::status`].
    pub fn depth_ops(&self, gpu: &Gpu) -> Vec<Op> {
        let passes = u32::BITS / gpu.digit_bits();
        let first = SortPass { chunk: ALL_SPLATS, is_first: 1, ..SortPass::zeroed() };
        self.sort_ops(gpu, first, passes, &self.keys, &self.order)
    }

    /// Sorts all splats in the order of [`Self::depth_ops`] by other keys; stable.
    pub fn resort_ops(&self, gpu: &Gpu) -> Vec<Op> {
        let first = SortPass { chunk: ALL_SPLATS, ..SortPass::zeroed() };
        self.sort_ops(gpu, first, u32::BITS / gpu.digit_bits(), &self.keys, &self.order)
    }

    /// A dispatch of workgroups of 64 splats in the depth order each, once pairs were counted.
    pub fn of_order(&self) -> Groups {
        Groups::Indirect(self.dispatches.clone(), 0)
    }

    /// Indirect groups of 64 of all splats once pairs are counted; none if the pairs do not fit.
    pub fn of_all(&self) -> Groups {
        Groups::Indirect(self.dispatches.clone(), 12)
    }

    /// Counts the pairs of a chunk: [`Self::offsets`] and the chunk's entry in [`Self::status`].
    pub fn count_ops(&self, gpu: &Gpu, drawn: Projection<'_>, chunk: &TileChunk) -> Vec<Op> {
        vec![
            gpu.op(
                Kernel::TileCounts,
                &[
                    drawn.view.into(),
                    (&chunk.uniform).into(),
                    drawn.splats2d.into(),
                    (&self.status).into(),
                    self.order().into(),
                    (&self.offsets).into(),
                    (&self.segment_sums).into(),
                ],
                [gpu.segments(), 1],
            ),
            gpu.op(
                Kernel::ScanApply,
                &[
                    (&chunk.uniform).into(),
                    (&self.offsets).into(),
                    (&self.segment_sums).into(),
                    (&self.status).into(),
                    (&self.dispatches).into(),
                ],
                [gpu.segments(), 1],
            ),
        ]
    }

    /// Emits a counted chunk's pairs and sorts them by tile.
    pub fn pair_ops(
        &self,
        gpu: &Gpu,
        drawn: Projection<'_>,
        chunk: &TileChunk,
        pairs: &PairBins,
    ) -> Vec<Op> {
        let mut ops = vec![gpu.op(
            Kernel::Emit,
            &[
                drawn.view.into(),
                (&chunk.uniform).into(),
                drawn.splats2d.into(),
                (&self.status).into(),
                self.order().into(),
                (&self.offsets).into(),
                (&pairs.keys[0]).into(),
                (&pairs.slots[0]).into(),
                (&pairs.splat_from_slot).into(),
            ],
            self.of_order(),
        )];
        let passes = sort_passes(chunk.tiles(), gpu.digit_bits());
        let first = SortPass { chunk: chunk.chunk.index, ..SortPass::zeroed() };
        ops.extend(self.sort_ops(gpu, first, passes, &pairs.keys, &pairs.slots));
        let last = (passes % 2) as usize;
        // Enough workgroups to fill a device; each walks on by the number of all threads.
        let groups = pairs.capacity.div_ceil(64).clamp(1, 4 * gpu.segments());
        ops.push(gpu.op(
            Kernel::Ranges,
            &[
                (&chunk.uniform).into(),
                (&self.status).into(),
                (&pairs.keys[last]).into(),
                (&pairs.slots[last]).into(),
                (&pairs.splat_from_slot).into(),
                pairs.splat_from_pair(chunk.tiles()).into(),
                (&pairs.tile_begin).into(),
            ],
            [groups, 1],
        ));
        ops
    }

    fn sort_ops(
        &self,
        gpu: &Gpu,
        first: SortPass,
        passes: u32,
        keys: &[wgpu::Buffer; 2],
        values: &[wgpu::Buffer; 2],
    ) -> Vec<Op> {
        debug_assert!(gpu.digit_bits() != 8 || passes >= 2, "{passes}");
        let mut ops = Vec::new();
        for pass in 0..passes {
            let uniform = gpu.uniform(&SortPass {
                shift: pass * gpu.digit_bits(),
                is_first: if pass == 0 { first.is_first } else { 0 },
                sum_set: if pass + 1 == passes { 2 } else { pass % 2 },
                ..first
            });
            let (from, to) = ((pass % 2) as usize, ((pass + 1) % 2) as usize);
            let bindings = [
                (&uniform).into(),
                (&self.status).into(),
                (&keys[from]).into(),
                (&values[from]).into(),
                (&self.histogram).into(),
                (&keys[to]).into(),
                (&values[to]).into(),
            ];
            let all = [gpu.segments(), 1];
            if gpu.digit_bits() == 8 {
                ops.push(gpu.op(Kernel::SortCount, &bindings, all));
                ops.push(gpu.op(Kernel::SortPlace, &bindings, all));
            } else {
                ops.push(gpu.op(Kernel::SortHistogram, &bindings, all));
                ops.push(gpu.op(Kernel::SortScan, &bindings, [1, 1]));
                ops.push(gpu.op(Kernel::SortScatter, &bindings, all));
            }
        }
        ops
    }

    /// Cuts tiles into chunks whose pairs fit; reads the counts back. Needs the depth order.
    pub fn plan(
        &self,
        gpu: &Gpu,
        drawn: Projection<'_>,
        tiles: u32,
        slot_floats: usize,
    ) -> Result<(Vec<Range<u32>>, u32)> {
        let limit = pair_limit(gpu, slot_floats);
        let (mut open, mut done) = (std::iter::once(0..tiles).collect::<Vec<_>>(), Vec::new());
        let mut capacity = 0;
        while let Some(range) = open.pop() {
            let whole = Chunk::whole(tiles, self.splats, u32::MAX);
            let part = Chunk { tile_begin: range.start, tile_end: range.end, ..whole };
            let ops = self.count_ops(gpu, drawn, &TileChunk::new(gpu, part));
            let bytes = size_of::<StatusHead>() + size_of::<ChunkCount>();
            let status = gpu.download(&ops, &[(&self.status, bytes as u64)])?;
            let count: ChunkCount =
                bytemuck::pod_read_unaligned(&status[0][size_of::<StatusHead>()..]);
            if count.total <= limit {
                capacity = capacity.max(count.total);
                done.push(range);
            } else if range.len() == 1 {
                return Err(Error::argument(
                    "means",
                    format!(
                        "{} splats are in one 16x16 tile, but the device takes {limit}; use fewer \
                         splats or backend cpu",
                        count.total
                    ),
                ));
            } else {
                let middle = range.start + range.len() as u32 / 2;
                open.push(middle..range.end);
                open.push(range.start..middle);
            }
        }
        Ok((done, capacity))
    }
}

/// Rows of counts in the histogram; the sort by eight bits has sums of segments, too.
fn histogram_rows(gpu: &Gpu) -> u32 {
    gpu.segments() + if gpu.digit_bits() == 8 { SUM_SETS * SUM_ROWS } else { 0 }
}

/// Passes that order the ids of `tiles` tiles and the one behind them; the sort by eight bits needs two.
fn sort_passes(tiles: u32, digit_bits: u32) -> u32 {
    let least = if digit_bits == 8 { 2 } else { 1 };
    (u32::BITS - tiles.leading_zeros()).div_ceil(digit_bits).max(least)
}

impl PairBins {
    pub fn new(gpu: &Gpu, capacity: u32, tiles: u32) -> Result<Self> {
        let words = |n: u32| u64::from(n) * 4;
        let buffer = |label| gpu.bindable(label, words(capacity));
        Ok(Self {
            capacity,
            digit_bits: gpu.digit_bits(),
            keys: [buffer("tile keys")?, buffer("tile keys")?],
            slots: [buffer("slots")?, buffer("slots")?],
            splat_from_slot: buffer("splat_from_slot")?,
            tile_begin: gpu.bindable("tile_begin", words(tiles) + 8)?,
        })
    }

    /// The splat of each pair in tile order, in a buffer of keys that is free after the sort.
    pub fn splat_from_pair(&self, tiles: u32) -> &wgpu::Buffer {
        &self.keys[((sort_passes(tiles, self.digit_bits) + 1) % 2) as usize]
    }

    /// Slots in tile order after the sort of a chunk of `tiles` tiles.
    pub fn slot_from_pair(&self, tiles: u32) -> &wgpu::Buffer {
        &self.slots[(sort_passes(tiles, self.digit_bits) % 2) as usize]
    }
}
