//! Splats that stay on the device and are projected and sorted for one camera after another, to be
//! drawn by the caller's graphics pipeline or to a `ResidentPicture`.

use super::bin::SplatBins;
use super::device::{Gpu, Op};
use super::layout::{Splat2d, StatusHead, View};
use super::project::{Projection, SplatBuffers, project_ops};
use crate::camera::Camera;
use crate::error::Result;
use crate::stages::{Colors, ProjectOptions, SplatParams};

/// A camera and how it sees resident splats.
#[derive(Debug, Clone, Copy)]
pub struct ResidentView<'a> {
    /// The camera.
    pub camera: &'a Camera,
    /// Settings of the project stage.
    pub options: &'a ProjectOptions,
    /// Highest SH degree to evaluate, capped at the stored one.
    pub sh_degree: u32,
}

impl ResidentView<'_> {
    pub(super) fn validate(&self) -> Result<()> {
        self.camera.validate()?;
        self.options.validate()
    }
}

/// Splats on the device, with the commands that project and sort them.
#[derive(Debug)]
pub struct ResidentSplats {
    splats: SplatBuffers,
    sh_degree: u32,
    sh_stride: u32,
    raw: bool,
    view: wgpu::Buffer,
    splats2d: wgpu::Buffer,
    pub(super) bins: SplatBins,
    quads: wgpu::Buffer,
    project: Vec<Op>,
    sort: Vec<Op>,
}

impl ResidentSplats {
    /// Copies splats to the device.
    pub fn new(gpu: &Gpu, splats: &SplatParams<'_, f32>) -> Result<Self> {
        splats.validate()?;
        let buffers = SplatBuffers::upload(gpu, splats)?;
        let count = buffers.splats;
        let view = gpu.uniform(&View::of_picture(1, 1, [0.0; 3]));
        let splats2d = gpu.bindable("splats2d", u64::from(count) * size_of::<Splat2d>() as u64)?;
        let bins = SplatBins::new(gpu, count, 1)?;
        let drawn = Projection { view: &view, splats2d: &splats2d };
        let (sh_degree, sh_stride) = match splats.colors {
            Colors::Direct(_) => (0, 0),
            Colors::Sh { degree, stride, .. } => (degree, stride as u32),
        };
        Ok(Self {
            project: project_ops(gpu, drawn, &buffers, bins.keys()),
            sort: bins.depth_ops(gpu),
            quads: gpu.upload("quads", &[4u32, 0, 0, 0])?,
            sh_degree,
            sh_stride,
            raw: splats.raw,
            splats: buffers,
            view,
            splats2d,
            bins,
        })
    }

    /// Number of splats.
    pub fn len(&self) -> u32 {
        self.splats.splats
    }

    /// Whether there are none.
    pub fn is_empty(&self) -> bool {
        self.len() == 0
    }

    /// Records project and sort, a pass with timestamps each. Only one view per submission.
    pub fn record(
        &self,
        gpu: &Gpu,
        encoder: &mut wgpu::CommandEncoder,
        view: &ResidentView<'_>,
        [project, sort]: [Option<wgpu::ComputePassTimestampWrites<'_>>; 2],
    ) -> Result<()> {
        view.validate()?;
        self.record_view(gpu, encoder, &self.view(view), [project, sort]);
        Ok(())
    }

    /// The last camera and its 2D splats.
    pub(super) fn projection(&self) -> Projection<'_> {
        Projection { view: &self.view, splats2d: &self.splats2d }
    }

    /// Uniforms of a view.
    pub(super) fn view(&self, view: &ResidentView<'_>) -> View {
        View {
            sh_degree: view.sh_degree.min(self.sh_degree),
            sh_stride: self.sh_stride,
            raw: u32::from(self.raw),
            ..View::of_view(view.camera, view.options, [0.0; 3])
        }
    }

    /// [`Self::record`] with given uniforms.
    pub(super) fn record_view(
        &self,
        gpu: &Gpu,
        encoder: &mut wgpu::CommandEncoder,
        view: &View,
        [project, sort]: [Option<wgpu::ComputePassTimestampWrites<'_>>; 2],
    ) {
        gpu.queue.write_buffer(&self.view, 0, bytemuck::bytes_of(view));
        Gpu::record_pass(encoder, &self.project, project);
        Gpu::record_pass(encoder, &self.sort, sort);
        let visible = std::mem::offset_of!(StatusHead, visible) as u64;
        encoder.copy_buffer_to_buffer(&self.bins.status, visible, &self.quads, 4, 4);
    }

    /// `[N]` of `Splat2d`, as the last [`Self::record`] leaves them.
    pub fn splats2d(&self) -> &wgpu::Buffer {
        &self.splats2d
    }

    /// Splats from front to back, without culled ones.
    pub fn order(&self) -> &wgpu::Buffer {
        self.bins.order()
    }

    /// Arguments of an indirect draw of four vertices for each splat of [`Self::order`].
    pub fn quads(&self) -> &wgpu::Buffer {
        &self.quads
    }

    /// `[N * GEOMETRY]` mean, scales, quaternion wxyz, opacity, as they were given.
    pub fn geometry(&self) -> &wgpu::Buffer {
        &self.splats.geometry
    }
}
