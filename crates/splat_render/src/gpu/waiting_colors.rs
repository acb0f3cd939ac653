//! Colors that wait (`fit_device::waiting`): in fits, project updates visible ones before use.

use std::ops::Range;

use super::adam::AdamBuffers;
use super::bin::SplatBins;
use super::device::{Gpu, Op};
use super::kernels::Kernel;
use super::layout::{GEOMETRY, NOTES, SPLATS_PER_GROUP};
use super::project::{Projection, SPLAT_2D, rows, window_uniform};

impl AdamBuffers {
    /// Projects all splats and updates visible colors; `steps` is a
    /// [`ColorSteps`](super::layout::ColorSteps).
    pub fn project_ops(
        &self,
        gpu: &Gpu,
        to: Projection<'_>,
        bins: &SplatBins,
        steps: &wgpu::Buffer,
    ) -> Vec<Op> {
        self.color_kernel(gpu, Kernel::FitProject, to, bins, steps)
    }

    /// Brings all colors up to date, in the SH degree of the view.
    pub fn catch_up_ops(
        &self,
        gpu: &Gpu,
        to: Projection<'_>,
        bins: &SplatBins,
        steps: &wgpu::Buffer,
    ) -> Vec<Op> {
        self.color_kernel(gpu, Kernel::CatchUpAll, to, bins, steps)
    }

    fn color_kernel(
        &self,
        gpu: &Gpu,
        kernel: Kernel,
        to: Projection<'_>,
        bins: &SplatBins,
        steps: &wgpu::Buffer,
    ) -> Vec<Op> {
        let Self { splats, first, second, notes, .. } = self;
        let colors = splats.color_floats;
        let op = |window: Range<u32>| {
            let uniform = window_uniform(gpu, &window);
            let bindings = [
                to.view.into(),
                (&uniform).into(),
                rows(&splats.geometry, &window, GEOMETRY as u64),
                rows(&splats.colors, &window, colors),
                rows(to.splats2d, &window, SPLAT_2D as u64),
                rows(bins.keys(), &window, 1),
                rows(&first.colors, &window, colors),
                rows(&second.colors, &window, colors),
                rows(notes, &window, NOTES as u64),
                (&bins.status).into(),
                steps.into(),
            ];
            gpu.op(kernel, &bindings, gpu.groups(window.len() as u32, SPLATS_PER_GROUP))
        };
        splats.windows(gpu).into_iter().map(op).collect()
    }
}
