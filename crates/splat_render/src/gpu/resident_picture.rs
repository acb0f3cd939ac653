//! Pictures on the device: resident splats, binned and rasterized for one camera after another. No frame
//! waits for the device: the number of (splat, tile) pairs comes back while later frames are drawn.

use std::ops::Range;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};

use super::bin::{PairBins, TileChunk, pair_limit, tile_count};
use super::device::{Gpu, Op};
use super::layout::{Chunk, ChunkCount, StatusHead, View};
use super::rasterize::{PictureBuffers, rasterize_ops};
use super::resident::{ResidentSplats, ResidentView};
use crate::constants::TILE;
use crate::error::{Error, Result};

/// Pairs per splat that there is room for at first, and the least number of pairs: 5 MB.
const PAIRS_PER_SPLAT: u32 = 4;
const LEAST_PAIRS: u32 = 1 << 18;

/// Pictures after which unused commands are dropped: two scenes side by side are drawn in turns.
const KEPT: u32 = 4;

/// A picture on the device, with the buffers of its stages.
#[derive(Debug)]
pub struct ResidentPicture {
    width: u32,
    height: u32,
    buffers: PictureBuffers,
    pairs: PairBins,
    /// Pairs that `pairs` has room for.
    capacity: u32,
    /// Most pairs of the pictures whose number has arrived.
    needed: u32,
    kept: Vec<Prepared>,
}

/// The commands for one scene and size.
#[derive(Debug)]
struct Prepared {
    splats2d: wgpu::Buffer,
    size: [u32; 2],
    bin: Vec<Op>,
    rasterize: Vec<Op>,
    count: Count,
    /// Pictures since it was used.
    age: u32,
}

/// The number of pairs, on its way back.
#[derive(Debug)]
struct Count {
    readable: wgpu::Buffer,
    state: CountState,
    is_mapped: Arc<AtomicBool>,
}

#[derive(Debug, PartialEq)]
enum CountState {
    Free,
    Recorded,
    Submitted,
}

impl Count {
    const BYTES: u64 = size_of::<ChunkCount>() as u64;

    fn new(gpu: &Gpu) -> Self {
        let readable = gpu.readable(Self::BYTES);
        Self { readable, state: CountState::Free, is_mapped: Arc::default() }
    }

    /// The number of an earlier frame, once, if it has arrived.
    fn arrived(&mut self) -> Option<u32> {
        if !self.is_mapped.swap(false, Ordering::Acquire) {
            return None;
        }
        let view = self.readable.get_mapped_range(..).ok();
        let count = view.map(|view| bytemuck::pod_read_unaligned::<ChunkCount>(&view));
        self.readable.unmap();
        self.state = CountState::Free;
        count.map(|count| count.total)
    }

    fn record(&mut self, encoder: &mut wgpu::CommandEncoder, status: &wgpu::Buffer) {
        if self.state == CountState::Free {
            let head = size_of::<StatusHead>() as u64;
            encoder.copy_buffer_to_buffer(status, head, &self.readable, 0, Self::BYTES);
            self.state = CountState::Recorded;
        }
    }

    fn submitted(&mut self) {
        if self.state == CountState::Recorded {
            let is_mapped = Arc::clone(&self.is_mapped);
            self.readable.map_async(wgpu::MapMode::Read, .., move |result| {
                is_mapped.store(result.is_ok(), Ordering::Release);
            });
            self.state = CountState::Submitted;
        }
    }
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
            needed: 0,
            kept: Vec::new(),
        })
    }

    /// `[H * W]` color without background, and final transmittance, row-major.
    pub fn picture(&self) -> &wgpu::Buffer {
        &self.buffers.picture
    }

    /// A buffer with the arguments of two indirect draws, and their offsets. If the pairs of the last
    /// frame fit, the first draws a triangle and the second nothing. Else the picture is empty, the first
    /// draws nothing and the second four vertices for each splat in order.
    pub fn draws(splats: &ResidentSplats) -> (&wgpu::Buffer, [u64; 2]) {
        (&splats.bins.dispatches, [40, 24])
    }

    /// Records the columns of a camera's picture; call [`Self::submitted`] once the encoder's commands
    /// have been submitted. Each stage gets the timestamps of its last pass.
    pub fn record(
        &mut self,
        gpu: &Gpu,
        encoder: &mut wgpu::CommandEncoder,
        splats: &ResidentSplats,
        view: &ResidentView<'_>,
        columns: Range<u32>,
        [project, sort, bin, rasterize]: [Option<wgpu::ComputePassTimestampWrites<'_>>; 4],
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
        self.make_room(gpu, splats.len())?;
        let prepared = self.prepared(gpu, splats, [width, camera.height]);
        splats.record_view(gpu, encoder, &part, [project, sort]);
        Gpu::record_pass(encoder, &prepared.bin, bin);
        Gpu::record_pass(encoder, &prepared.rasterize, rasterize);
        prepared.count.record(encoder, &splats.bins.status);
        gpu.check()
    }

    /// Starts to bring back the number of pairs of the frame just submitted.
    pub fn submitted(&mut self) {
        self.kept.iter_mut().for_each(|prepared| prepared.count.submitted());
    }

    /// Whether pairs did not fit in the last pictures whose number of pairs has arrived, and will in the
    /// next one. They never do if one binding cannot hold them.
    pub fn is_short(&mut self, gpu: &Gpu) -> bool {
        for prepared in &mut self.kept {
            self.needed = self.needed.max(prepared.count.arrived().unwrap_or(0));
        }
        self.needed > self.capacity && self.capacity < pair_limit(gpu, 1)
    }

    /// Makes room for the pairs of earlier frames, and some more, so that not every frame of an approach
    /// makes room.
    fn make_room(&mut self, gpu: &Gpu, splats: u32) -> Result<()> {
        if self.is_short(gpu) || self.capacity == 0 {
            let first = splats.saturating_mul(PAIRS_PER_SPLAT).max(LEAST_PAIRS);
            let some_more = self.needed.saturating_add(self.needed / 4);
            let room = some_more.max(first).min(pair_limit(gpu, 1));
            self.kept.clear();
            self.pairs = PairBins::new(gpu, room, tile_count(self.width, self.height))?;
            self.capacity = room;
        }
        Ok(())
    }

    fn prepared(&mut self, gpu: &Gpu, splats: &ResidentSplats, size: [u32; 2]) -> &mut Prepared {
        let drawn = splats.projection();
        self.kept.iter_mut().for_each(|kept| kept.age += 1);
        self.kept.retain(|kept| kept.age <= KEPT);
        let is_same = |kept: &Prepared| kept.size == size && kept.splats2d == *drawn.splats2d;
        let at = self.kept.iter().position(is_same).unwrap_or_else(|| {
            let tiles = tile_count(size[0], size[1]);
            let chunk = TileChunk::new(gpu, Chunk::whole(tiles, splats.len(), self.capacity));
            let mut bin = splats.bins.count_ops(gpu, drawn, &chunk);
            bin.extend(splats.bins.pair_ops(gpu, drawn, &chunk, &self.pairs));
            self.kept.push(Prepared {
                splats2d: drawn.splats2d.clone(),
                size,
                bin,
                rasterize: rasterize_ops(gpu, drawn, &chunk, &self.pairs, &self.buffers),
                count: Count::new(gpu),
                age: 0,
            });
            self.kept.len() - 1
        });
        self.kept[at].age = 0;
        &mut self.kept[at]
    }
}
