//! MCMC's density control on the device, with the bits of `fit_device::mcmc`. The host reads the centers
//! of a sample, the sum of the weights, and the bounding box.

use bytemuck::{Pod, Zeroable};
use rayon::prelude::*;

use super::device::{Bound, Gpu, Op};
use super::drawn::{Bounds, Drawn, Scans, words};
use super::kernels::Kernel;
use super::layout::GEOMETRY;
use crate::error::Result;
use crate::fit_device::{FogCamera, McmcRun, sampled_every, share_table, weight_table};

#[repr(C)]
#[derive(Debug, Clone, Copy, PartialEq, Pod, Zeroable)]
pub(super) struct Run {
    pub splats: u32,
    pub fresh: u32,
    pub seed: u32,
    pub round: u32,
    pub cameras: u32,
    pub every: u32,
    pub color_floats: u32,
    /// Always 0 (`rounded` in shared.wgsl).
    pub zero: u32,
}

/// The table of shares on the device, made once.
pub(super) fn shares(gpu: &Gpu) -> Result<wgpu::Buffer> {
    gpu.upload("shares", share_table())
}

/// Makes the moved and added splats of `run`; `geometry` and `colors` of `n` splats are only read.
pub(super) fn draw(
    gpu: &Gpu,
    (geometry, colors): (&wgpu::Buffer, &wgpu::Buffer),
    (n, color_floats): (u32, u32),
    run: &McmcRun,
    shares: &wgpu::Buffer,
) -> Result<Drawn> {
    let fresh = (run.target as u64).saturating_sub(u64::from(n)) as u32;
    let words = |label, count| words(gpu, label, count);
    let row_bytes = GEOMETRY as u64 * 4;
    let drawn = gpu.bindable("geometry", u64::from(n + fresh) * row_bytes)?;
    let copy = Op::copy(geometry, &drawn, 0, u64::from(n) * row_bytes);
    let every = sampled_every(n as usize) as u32;
    let first = Run {
        splats: n,
        fresh,
        seed: run.seed,
        round: 0,
        cameras: run.cameras.len() as u32,
        every,
        color_floats,
        zero: 0,
    };
    let rounds = [first, Run { round: 1, cameras: 0, ..first }].map(|run| gpu.uniform(&run));
    let table = gpu.upload("weights by opacity", &weight_table((n + fresh) as usize))?;
    let weights = words("weights", n)?;
    let dead = words("dead splats", n)?;
    let scans = Scans::new(gpu, n)?;
    let weigh = |kernel, run, cameras: &wgpu::Buffer, words: &wgpu::Buffer, groups| {
        let bindings: [Bound<'_>; 6] =
            [run, (&drawn).into(), colors.into(), cameras.into(), (&table).into(), words.into()];
        gpu.op(kernel, &bindings, groups)
    };
    let samples = n.div_ceil(every);
    let sample = words("sample", 3 * samples)?;
    // Bound, but not read if only centers are requested.
    let none = gpu.buffer("cameras", size_of::<FogCamera>() as u64)?;
    let centers: Vec<[f32; 3]> = if run.cameras.is_empty() {
        gpu.submit(&[&[copy]])?;
        Vec::new()
    } else {
        let of = gpu.groups(samples, 64);
        let op = weigh(Kernel::McmcSample, (&rounds[0]).into(), &none, &sample, of);
        let data = gpu.download(&[copy, op], &[(&sample, 12 * u64::from(samples))])?;
        bytemuck::pod_collect_to_vec(&data[0])
    };
    let fog: Vec<FogCamera> =
        run.cameras.par_iter().map(|camera| FogCamera::new(camera, &centers)).collect();
    let cameras = if fog.is_empty() { none } else { gpu.upload("cameras", &fog)? };

    let copies = words("copies", n + fresh)?;
    let sources = words("sources", n.max(fresh))?;
    let rows = words("rows", n + fresh)?;
    let spread = |kernel, round: usize, count: u32| {
        let bindings = [
            (&rounds[round]).into(),
            (&drawn).into(),
            (&weights).into(),
            (&dead).into(),
            (&scans.totals).into(),
            (&copies).into(),
            (&sources).into(),
            (&rows).into(),
            shares.into(),
        ];
        gpu.op(kernel, &bindings, gpu.groups(count, 64))
    };
    let mut ops = vec![spread(Kernel::McmcStart, 0, n + fresh)];
    for (round, targets) in [n, fresh].into_iter().enumerate() {
        let weigh = weigh(
            Kernel::McmcWeigh,
            (&rounds[round]).into(),
            &cameras,
            &weights,
            gpu.groups(n, 64),
        );
        ops.push(weigh);
        ops.extend(scans.ops(gpu, round as u32, &weights, &dead));
        ops.extend([
            spread(Kernel::McmcDraw, round, targets),
            spread(Kernel::McmcShare, round, n),
            spread(Kernel::McmcCopy, round, targets),
        ]);
    }
    // Added splats have their sources' centers.
    let Bounds { corners, op } = Bounds::new(gpu, &drawn, n, &rows)?;
    ops.push(op);
    let data =
        gpu.download(&ops, &[(&scans.totals, Scans::TOTAL_BYTES), (&corners, Bounds::BYTES)])?;
    let totals: [u32; 4] = bytemuck::pod_read_unaligned(&data[0]);
    Ok(Drawn {
        geometry: drawn,
        rows,
        // Nothing grows of dead splats alone.
        splats: if totals[2] == 0 { n } else { n + fresh },
        cells: Bounds::cells(&data[1]),
    })
}
