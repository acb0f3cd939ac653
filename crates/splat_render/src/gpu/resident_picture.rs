//! Pictures on the device: resident splats, binned and rasterized for one camera after another. The host
//! reads back only the number of (splat, tile) pairs.

use std::ops::Range;

use super::bin::{PairBins, TileChunk, pair_limit, tile_count};
use super::device::Gpu;
use super::layout::{Chunk, ChunkCount, StatusHead, View};
use super::rasterize::{PictureBuffers, rasterize_ops};
use super::resident::{ResidentSplats, ResidentView};
use crate::constants::TILE;
use crate::error::{Error, Result};

/// A picture on the device, with the buffers of its stages.
#[derive(Debug)]
pub struct ResidentPicture {
    width: u32,
    height: u32,
    buffers: PictureBuffers,
    pairs: PairBins,
    /// Pairs that `pairs` has room for.
    capacity: u32,
    counted: wgpu::Buffer,
}

impl ResidentPicture {
    /// For pictures of at most `width` x `height` pixels.
    pub fn new(gpu: &Gpu, width: u32, height: u32) -> Result<Self> {
        let pixels = u64::from(width) * u64::from(height);
        Ok(Self {
            width,
            height,
            buffers: PictureBuffers::new(gpu, pixels)?,
            pairs: PairBins::new(gpu, 0, tile_count(width, height))?,
            capacity: 0,
            counted: gpu.readable(size_of::<ChunkCount>() as u64),
        })
    }

    /// `[H * W]` color without background, and final transmittance, row-major.
    pub fn picture(&self) -> &wgpu::Buffer {
        &self.buffers.picture
    }

    /// Draws the columns of a camera's picture: submits project, sort and a count of the pairs, waits for
    /// the count, and records the rest to `encoder`. Each stage gets the timestamps of its last pass; if
    /// the pairs exceed one binding, rasterize includes later parts' bin stages.
    pub fn record(
        &mut self,
        gpu: &Gpu,
        encoder: &mut wgpu::CommandEncoder,
        splats: &ResidentSplats,
        view: &ResidentView<'_>,
        columns: Range<u32>,
        [project, sort, mut bin, mut rasterize]: [Option<wgpu::ComputePassTimestampWrites<'_>>; 4],
    ) -> Result<()> {
        view.validate()?;
        let camera = view.camera;
        let width = columns.end.saturating_sub(columns.start);
        let fits = tile_count(width, camera.height) <= tile_count(self.width, self.height)
            && u64::from(width) * u64::from(camera.height)
                <= u64::from(self.width) * u64::from(self.height);
        if width == 0 || columns.end > camera.width || !fits {
            return Err(Error::argument(
                "columns",
                format!(
                    "{columns:?} of a picture of {}x{} are empty or larger than the room for {}x{}",
                    camera.width, camera.height, self.width, self.height
                ),
            ));
        }
        let all = splats.view(view);
        let part = View {
            principal: [all.principal[0] - columns.start as f32, all.principal[1]],
            width,
            tiles_x: width.div_ceil(TILE),
            ..all
        };
        let tiles = tile_count(width, camera.height);
        let (drawn, bins) = (splats.projection(), &splats.bins);
        let whole = Chunk::whole(tiles, splats.len(), u32::MAX);
        let count = bins.count_ops(gpu, drawn, &TileChunk::new(gpu, whole));
        let mut first = gpu.device.create_command_encoder(&Default::default());
        splats.record_view(gpu, &mut first, &part, [project, sort]);
        Gpu::record_pass(&mut first, &count, None);
        let bytes = size_of::<ChunkCount>() as u64;
        let head = size_of::<StatusHead>() as u64;
        first.copy_buffer_to_buffer(&bins.status, head, &self.counted, 0, bytes);
        gpu.queue.submit([first.finish()]);
        let data = gpu.read(&[(&self.counted, bytes)])?;
        let ChunkCount { total, .. } = bytemuck::pod_read_unaligned(&data[0]);

        let is_whole = total <= pair_limit(gpu, 1);
        let (runs, most) = if is_whole {
            (std::iter::once(0..tiles).collect(), total)
        } else {
            bins.plan(gpu, drawn, tiles, 1)?
        };
        if most > self.capacity {
            // Some more than this frame needs, so that not every frame of an approach makes room.
            let room = (most.saturating_add(most / 4)).min(pair_limit(gpu, 1));
            self.pairs = PairBins::new(gpu, room, tile_count(self.width, self.height))?;
            self.capacity = room;
        }
        let whole = Chunk { capacity: self.capacity, ..whole };
        for chunk in whole.parts(&runs) {
            let chunk = TileChunk::new(gpu, chunk);
            // The whole picture's pairs are counted already.
            let mut ops = if is_whole { Vec::new() } else { bins.count_ops(gpu, drawn, &chunk) };
            ops.extend(bins.pair_ops(gpu, drawn, &chunk, &self.pairs));
            Gpu::record_pass(encoder, &ops, bin.take());
            let ops = rasterize_ops(gpu, drawn, &chunk, &self.pairs, &self.buffers);
            let stamps = if chunk.chunk.is_last == 1 { rasterize.take() } else { None };
            Gpu::record_pass(encoder, &ops, stamps);
        }
        gpu.check()
    }
}
