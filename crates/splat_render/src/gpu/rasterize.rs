//! rasterize: 2D splats to a picture.

use bytemuck::Zeroable;

use super::bin::{PairBins, SplatBins, TileChunk, tile_count};
use super::device::{Gpu, Op};
use super::kernels::Kernel;
use super::layout::{Chunk, GRADIENT, Splat2d, View};
use super::project::{Projection, count};
use crate::error::Result;
use crate::stages::{Image, Projected};

/// 2D splats in the kernels' layout; splats that are not drawn become culled ones.
pub(super) fn splats2d(projected: &Projected<f32>) -> Vec<Splat2d> {
    (0..projected.len())
        .map(|i| {
            if !projected.is_drawn(i) {
                return Splat2d::zeroed();
            }
            let [p, q, r] = projected.factors[i];
            Splat2d {
                mean: projected.means2d[i],
                pq: [p, q],
                color: projected.colors[i],
                r,
                depth: projected.depths[i],
                opacity: projected.opacities[i],
                radii: projected.radii[i],
            }
        })
        .collect()
}

/// Binned 2D splats, input of both directions of the stage.
pub(super) struct Binned {
    pub view: wgpu::Buffer,
    pub splats2d: wgpu::Buffer,
    pub splats: u32,
    pub bins: SplatBins,
    pub pairs: PairBins,
    pub chunks: Vec<TileChunk>,
    pub capacity: u32,
}

impl Binned {
    /// Uploads and sorts the splats and cuts the tiles into chunks, at `slot_floats` floats per pair.
    pub fn new(
        gpu: &Gpu,
        projected: &Projected<f32>,
        background: [f32; 3],
        slot_floats: usize,
    ) -> Result<Self> {
        let splats = count(projected.len())?;
        let view = gpu.uniform(&View::of_picture(projected.width, projected.height, background));
        gpu.bindable_bytes("splats2d", u64::from(splats) * size_of::<Splat2d>() as u64)?;
        let splats2d = gpu.upload("splats2d", &splats2d(projected))?;
        let bins = SplatBins::new(gpu, splats, 1)?;
        let tiles = tile_count(projected.width, projected.height);
        let drawn = Projection { view: &view, splats2d: &splats2d };
        let all = TileChunk::new(gpu, Chunk::whole(tiles, splats, u32::MAX));
        gpu.submit(&[&[bins.key_op(gpu, drawn, &all)], &bins.depth_ops(gpu)])?;
        let (runs, capacity) = bins.plan(gpu, drawn, tiles, slot_floats)?;
        let pairs = PairBins::new(gpu, capacity, tiles)?;
        let parts = Chunk::whole(tiles, splats, capacity).parts(&runs);
        let chunks = parts.map(|chunk| TileChunk::new(gpu, chunk)).collect();
        Ok(Self { view, splats2d, splats, bins, pairs, chunks, capacity })
    }

    /// The camera and its 2D splats.
    pub fn projection(&self) -> Projection<'_> {
        Projection { view: &self.view, splats2d: &self.splats2d }
    }

    pub fn chunk_ops(&self, gpu: &Gpu, chunk: &TileChunk) -> Vec<Op> {
        let mut ops = self.bins.count_ops(gpu, self.projection(), chunk);
        ops.extend(self.bins.pair_ops(gpu, self.projection(), chunk, &self.pairs));
        ops
    }
}

#[derive(Debug)]
pub(super) struct PictureBuffers {
    /// `[H * W]` color and final transmittance.
    pub picture: wgpu::Buffer,
    /// `[H * W]` accumulated depths.
    pub depths: wgpu::Buffer,
}

impl PictureBuffers {
    pub fn new(gpu: &Gpu, pixels: u64) -> Result<Self> {
        Ok(Self {
            picture: gpu.bindable("picture", 16 * pixels)?,
            depths: gpu.bindable("depths", 4 * pixels)?,
        })
    }
}

/// Rasterizes a chunk's tiles, whose pair lists are filled.
pub(super) fn rasterize_ops(
    gpu: &Gpu,
    drawn: Projection<'_>,
    chunk: &TileChunk,
    pairs: &PairBins,
    to: &PictureBuffers,
) -> Vec<Op> {
    let op = |pass: &wgpu::Buffer| {
        gpu.op(
            Kernel::Rasterize,
            &[
                drawn.view.into(),
                pass.into(),
                drawn.splats2d.into(),
                (&pairs.tile_begin).into(),
                pairs.splat_from_pair(chunk.tiles()).into(),
                (&to.picture).into(),
                (&to.depths).into(),
            ],
            gpu.groups(chunk.tiles(), 1),
        )
    };
    chunk.passes.iter().map(op).collect()
}

pub(super) fn rasterize(
    gpu: &Gpu,
    projected: &Projected<f32>,
    background: [f32; 3],
) -> Result<Image<f32>> {
    let (width, height) = (projected.width, projected.height);
    let pixels = u64::from(width) * u64::from(height);
    let to = PictureBuffers::new(gpu, pixels)?;
    let binned = Binned::new(gpu, projected, background, GRADIENT)?;
    let mut ops = Vec::new();
    for chunk in &binned.chunks {
        ops.extend(binned.chunk_ops(gpu, chunk));
        ops.extend(rasterize_ops(gpu, binned.projection(), chunk, &binned.pairs, &to));
    }
    let data = gpu.download(&ops, &[(&to.picture, 16 * pixels), (&to.depths, 4 * pixels)])?;
    let picture: Vec<[f32; 4]> = bytemuck::pod_collect_to_vec(&data[0]);
    Ok(Image {
        width,
        height,
        color: picture.iter().map(|p| [p[0], p[1], p[2]]).collect(),
        alpha: picture.iter().map(|p| 1.0 - p[3]).collect(),
        depth: bytemuck::pod_collect_to_vec(&data[1]),
        transmittance: picture.iter().map(|p| p[3]).collect(),
    })
}
