//! rasterize: 2D splats to a picture.

use super::bin::{PairBins, SplatBins, TileChunk, tile_count};
use super::device::{Gpu, Op};
use super::layout::{Chunk, GRADIENT, Splat2d, View};
use super::project::count;
use super::shaders::Kernel;
use crate::error::Result;
use crate::stages::{Image, Projected};

/// 2D splats as the kernels read them.
pub(super) fn splats2d(projected: &Projected<f32>) -> Vec<Splat2d> {
    (0..projected.len())
        .map(|i| {
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

/// Binned 2D splats: what both directions of the stage begin with.
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
    /// Uploads the splats, sorts them by depth and cuts the tiles into chunks that fit, also with
    /// so many floats per pair.
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
        let all = Chunk {
            tile_begin: 0,
            tile_end: tiles,
            capacity: u32::MAX,
            splats,
            index: 0,
            is_first: 1,
            is_last: 1,
            list_begin: 0,
            list_end: u32::MAX,
        };
        gpu.submit(&[&bins.depth_ops(gpu, &view, &TileChunk::new(gpu, all), &splats2d)])?;
        let (ranges, capacity) = bins.plan(gpu, &view, &splats2d, tiles, slot_floats)?;
        let pairs = PairBins::new(gpu, capacity, tiles)?;
        let last = ranges.len() - 1;
        let chunks = ranges
            .iter()
            .enumerate()
            .map(|(i, range)| {
                let chunk = Chunk {
                    tile_begin: range.start,
                    tile_end: range.end,
                    capacity,
                    is_first: u32::from(i == 0),
                    is_last: u32::from(i == last),
                    ..all
                };
                TileChunk::new(gpu, chunk)
            })
            .collect();
        Ok(Self { view, splats2d, splats, bins, pairs, chunks, capacity })
    }

    /// Fills the pair lists for a chunk.
    pub fn chunk_ops(&self, gpu: &Gpu, chunk: &TileChunk) -> Vec<Op> {
        let mut ops = self.bins.count_ops(gpu, &self.view, chunk, &self.splats2d);
        ops.extend(self.bins.pair_ops(gpu, &self.view, chunk, &self.splats2d, &self.pairs));
        ops
    }
}

/// Rasterizes a chunk's tiles.
pub(super) fn rasterize_ops(
    gpu: &Gpu,
    view: &wgpu::Buffer,
    chunk: &TileChunk,
    splats2d: &wgpu::Buffer,
    pairs: &PairBins,
    picture: &wgpu::Buffer,
    depths: &wgpu::Buffer,
) -> Vec<Op> {
    let op = |pass: &wgpu::Buffer| {
        gpu.op(
            Kernel::Rasterize,
            &[
                view.into(),
                pass.into(),
                splats2d.into(),
                (&pairs.tile_begin).into(),
                pairs.splat_from_pair(chunk.tiles()).into(),
                picture.into(),
                depths.into(),
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
    let picture = gpu.bindable("picture", 16 * pixels)?;
    let depths = gpu.bindable("depths", 4 * pixels)?;
    let binned = Binned::new(gpu, projected, background, GRADIENT)?;
    let mut ops = Vec::new();
    for chunk in &binned.chunks {
        ops.extend(binned.chunk_ops(gpu, chunk));
        ops.extend(rasterize_ops(
            gpu,
            &binned.view,
            chunk,
            &binned.splats2d,
            &binned.pairs,
            &picture,
            &depths,
        ));
    }
    let data = gpu.download(&ops, &[(&picture, 16 * pixels), (&depths, 4 * pixels)])?;
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
