//! A fit's buffers for pictures of one size, and the commands of a step.

use std::ops::Range;

use super::scene::Scene;
use crate::error::Result;
use crate::gpu::adam::AdamInput;
use crate::gpu::bin::{TileChunk, tile_count};
use crate::gpu::depth_loss::{Compared, DepthBuffers};
use crate::gpu::device::{Gpu, Op};
use crate::gpu::exposure::{Exposed, ExposureBuffers};
use crate::gpu::layout::Chunk;
use crate::gpu::loss::LossBuffers;
use crate::gpu::project::Projection;
use crate::gpu::rasterize::{PictureBuffers, rasterize_ops};
use crate::gpu::rasterize_backward::{BackwardBuffers, rasterize_backward_ops};

/// Buffers for pictures of one size, and the commands of a step with them.
#[derive(Debug)]
pub(super) struct Frame {
    pub width: u32,
    pub height: u32,
    pub picture: PictureBuffers,
    pub transmittances: wgpu::Buffer,
    pub loss: LossBuffers,
    /// Made for the first step that has an exposure.
    pub exposure: Option<ExposureBuffers>,
    /// Made for the first step whose photo has a depth.
    pub depth: Option<DepthBuffers>,
    /// Tiles of each chunk; more than one chunk only if the pairs of all tiles do not fit one binding.
    pub chunks: Vec<Range<u32>>,
    /// Empty until needed, and again whenever a buffer was replaced.
    pub ops: Vec<Op>,
    /// Whether they correct the picture by an exposure, and whether they compare its depth.
    parts: [bool; 2],
}

/// The uniforms of every step.
#[derive(Debug, Clone, Copy)]
pub(super) struct Uniforms<'a> {
    /// A `View`.
    pub view: &'a wgpu::Buffer,
    /// A `Step`.
    pub step: &'a wgpu::Buffer,
    /// A `ColorSteps`.
    pub color_steps: &'a wgpu::Buffer,
}

/// Uniforms of optional parts of a step.
#[derive(Debug, Clone, Copy)]
pub(super) struct Parts<'a> {
    /// An `ExposureUniform`.
    pub exposure: Option<&'a wgpu::Buffer>,
    /// A `DepthStep`.
    pub depth: Option<&'a wgpu::Buffer>,
}

impl Frame {
    pub fn new(gpu: &Gpu, width: u32, height: u32) -> Result<Self> {
        let pixels = u64::from(width) * u64::from(height);
        Ok(Self {
            width,
            height,
            picture: PictureBuffers::new(gpu, pixels)?,
            transmittances: gpu.transmittances(pixels)?,
            loss: LossBuffers::new(gpu, width, height)?,
            exposure: None,
            depth: None,
            chunks: std::iter::once(0..tile_count(width, height)).collect(),
            ops: Vec::new(),
            parts: [false; 2],
        })
    }

    /// Copies a photo to the loss's input buffer.
    pub fn copy_photo(&self, rgba: &wgpu::Buffer) -> Op {
        let bytes = u64::from(self.width) * u64::from(self.height) * 4;
        Op::copy(rgba, &self.loss.photo, 0, bytes)
    }

    /// Makes the commands of a whole step, unless they are there already.
    pub fn prepare(
        &mut self,
        gpu: &Gpu,
        uniforms: Uniforms<'_>,
        parts: Parts<'_>,
        scene: &Scene,
    ) -> Result<()> {
        let wanted = [parts.exposure.is_some(), parts.depth.is_some()];
        if !self.ops.is_empty() && self.parts == wanted {
            return Ok(());
        }
        let pixels = u64::from(self.width) * u64::from(self.height);
        if parts.exposure.is_some() && self.exposure.is_none() {
            self.exposure = Some(ExposureBuffers::new(gpu, pixels)?);
        }
        if parts.depth.is_some() && self.depth.is_none() {
            self.depth = Some(DepthBuffers::new(gpu, pixels)?);
        }
        self.parts = wanted;
        self.ops = self.step_ops(gpu, uniforms, parts, scene);
        Ok(())
    }

    fn step_ops(
        &self,
        gpu: &Gpu,
        uniforms: Uniforms<'_>,
        parts: Parts<'_>,
        scene: &Scene,
    ) -> Vec<Op> {
        let Uniforms { view, step, color_steps } = uniforms;
        let n = scene.len();
        let whole = Chunk::whole(tile_count(self.width, self.height), n, scene.capacity);
        let numbered = whole.parts(&self.chunks).zip(0..);
        let chunks: Vec<TileChunk> =
            numbered.map(|(part, index)| TileChunk::new(gpu, Chunk { index, ..part })).collect();
        let (bins, pairs) = (&scene.bins, &scene.pairs);
        let drawn = Projection { view, splats2d: &scene.splats2d };
        let bin = |ops: &mut Vec<Op>, chunk: &TileChunk| {
            ops.extend(bins.count_ops(gpu, drawn, chunk));
            ops.extend(bins.pair_ops(gpu, drawn, chunk, pairs));
        };
        let backward = BackwardBuffers {
            v_picture: self.loss.v_picture.clone(),
            totals: self.loss.totals.clone(),
            transmittances: self.transmittances.clone(),
            slots: scene.slots.clone(),
            v_splats2d: scene.v_splats2d.clone(),
        };
        let mut ops = scene.adam.project_ops(gpu, drawn, bins, color_steps);
        ops.extend(bins.depth_ops(gpu));
        for chunk in &chunks {
            bin(&mut ops, chunk);
            ops.extend(rasterize_ops(gpu, drawn, chunk, pairs, &self.picture));
        }
        let exposed = parts.exposure.zip(self.exposure.as_ref()).map(|(uniform, buffers)| {
            let of = Exposed {
                view,
                uniform,
                picture: &self.picture.picture,
                v_picture: &self.loss.v_picture,
                totals: &self.loss.totals,
            };
            (buffers, of)
        });
        ops.extend(exposed.map(|(buffers, of)| buffers.forward(gpu, of)));
        let compared = exposed.map_or(&self.picture.picture, |(buffers, _)| &buffers.corrected);
        ops.extend(self.loss.ops(gpu, view, step, compared));
        ops.extend(exposed.map(|(buffers, of)| buffers.backward(gpu, of)));
        ops.extend(parts.depth.zip(self.depth.as_ref()).map(|(uniform, buffers)| {
            let of = Compared {
                view,
                uniform,
                picture: &self.picture.picture,
                depths: &self.picture.depths,
                v_picture: &self.loss.v_picture,
                totals: &self.loss.totals,
            };
            buffers.op(gpu, of)
        }));
        for chunk in &chunks {
            // Chunks share the pair buffers, so that the lists of all but one are gone by now.
            if chunks.len() > 1 {
                bin(&mut ops, chunk);
            }
            let lists = (bins, pairs);
            ops.extend(rasterize_backward_ops(gpu, drawn, chunk, lists, &backward, false));
        }
        let moved =
            AdamInput { drawn, step, v_camera: &scene.v_camera, v_splats2d: &scene.v_splats2d };
        ops.extend(scene.adam.fit_ops(gpu, &moved, bins));
        ops
    }
}
