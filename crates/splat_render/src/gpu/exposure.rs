//! exposure and exposure_backward: a picture's colors as a photo of some gain and offset has them.

use super::device::{Gpu, Op};
use super::kernels::Kernel;
use super::layout::{EXPOSURE_GROUPS, ExposureUniform, View};
use crate::error::Result;
use crate::stages::{Exposure, ExposureGradients, Image};

/// Sums per workgroup: the gradients of gain and offset.
const SUMS: usize = 6;

/// Outputs of the kernels, for pictures of one size.
#[derive(Debug)]
pub(super) struct ExposureBuffers {
    /// `[H * W]` corrected color and transmittance.
    pub corrected: wgpu::Buffer,
    /// `[EXPOSURE_GROUPS * SUMS]`
    pub sums: wgpu::Buffer,
}

/// Inputs of the kernels and buffers that they update.
#[derive(Debug, Clone, Copy)]
pub(super) struct Exposed<'a> {
    /// A [`View`].
    pub view: &'a wgpu::Buffer,
    /// An [`ExposureUniform`].
    pub uniform: &'a wgpu::Buffer,
    /// `[H * W]` color and transmittance.
    pub picture: &'a wgpu::Buffer,
    /// `[H * W]` gradients of the corrected colors, then of the picture's.
    pub v_picture: &'a wgpu::Buffer,
    /// `[H * W]` as rasterize_backward reads them.
    pub totals: &'a wgpu::Buffer,
}

impl ExposureBuffers {
    pub const SUM_BYTES: u64 = EXPOSURE_GROUPS as u64 * SUMS as u64 * 4;

    pub fn new(gpu: &Gpu, pixels: u64) -> Result<Self> {
        Ok(Self {
            corrected: gpu.bindable("corrected picture", 16 * pixels)?,
            sums: gpu.bindable("exposure sums", Self::SUM_BYTES)?,
        })
    }

    fn op(&self, gpu: &Gpu, kernel: Kernel, of: Exposed<'_>) -> Op {
        let bindings = [
            of.view.into(),
            of.uniform.into(),
            of.picture.into(),
            (&self.corrected).into(),
            of.v_picture.into(),
            of.totals.into(),
            (&self.sums).into(),
        ];
        gpu.op(kernel, &bindings, [EXPOSURE_GROUPS, 1])
    }

    pub fn forward(&self, gpu: &Gpu, of: Exposed<'_>) -> Op {
        self.op(gpu, Kernel::Exposure, of)
    }

    /// Computes the picture's gradients, and sums those for gain and offset.
    pub fn backward(&self, gpu: &Gpu, of: Exposed<'_>) -> Op {
        self.op(gpu, Kernel::ExposureBackward, of)
    }

    /// Gradients of gain and offset from [`Self::sums`].
    pub fn gradients(bytes: &[u8]) -> [[f64; 3]; 2] {
        let mut total = [[0.0; 3]; 2];
        for group in bytes.chunks_exact(SUMS * 4) {
            let group: [f32; SUMS] = bytemuck::pod_read_unaligned(group);
            for (k, sum) in group.into_iter().enumerate() {
                total[k / 3][k % 3] += f64::from(sum);
            }
        }
        total
    }
}

/// Buffers of a picture that is on the host.
struct Uploaded {
    view: wgpu::Buffer,
    uniform: wgpu::Buffer,
    picture: wgpu::Buffer,
    v_picture: wgpu::Buffer,
    totals: wgpu::Buffer,
    buffers: ExposureBuffers,
}

impl Uploaded {
    fn new(
        gpu: &Gpu,
        image: &Image<f32>,
        exposure: &Exposure<f32>,
        v_corrected: &[[f32; 3]],
    ) -> Result<Self> {
        let pixels = image.color.len() as u64;
        gpu.bindable_bytes("picture", 16 * pixels)?;
        let with = |(&[r, g, b], w): (&[f32; 3], f32)| [r, g, b, w];
        let transmittances = image.transmittance.iter().copied();
        let picture: Vec<[f32; 4]> = image.color.iter().zip(transmittances).map(with).collect();
        let v_picture: Vec<[f32; 4]> = v_corrected.iter().map(|v| with((v, 0.0))).collect();
        Ok(Self {
            view: gpu.uniform(&View::of_picture(image.width, image.height, [0.0; 3])),
            uniform: gpu.uniform(&ExposureUniform::from(exposure)),
            picture: gpu.upload("picture", &picture)?,
            v_picture: gpu.upload("v_picture", &v_picture)?,
            totals: gpu.bindable("totals", 4 * pixels)?,
            buffers: ExposureBuffers::new(gpu, pixels)?,
        })
    }

    fn exposed(&self) -> Exposed<'_> {
        Exposed {
            view: &self.view,
            uniform: &self.uniform,
            picture: &self.picture,
            v_picture: &self.v_picture,
            totals: &self.totals,
        }
    }
}

pub(super) fn exposure(
    gpu: &Gpu,
    image: &Image<f32>,
    exposure: &Exposure<f32>,
) -> Result<Vec<[f32; 3]>> {
    let uploaded = Uploaded::new(gpu, image, exposure, &image.color)?;
    let op = uploaded.buffers.forward(gpu, uploaded.exposed());
    let bytes = 16 * image.color.len() as u64;
    let data = gpu.download(&[op], &[(&uploaded.buffers.corrected, bytes)])?;
    let corrected: Vec<[f32; 4]> = bytemuck::pod_collect_to_vec(&data[0]);
    Ok(corrected.iter().map(|c| [c[0], c[1], c[2]]).collect())
}

pub(super) fn exposure_backward(
    gpu: &Gpu,
    image: &Image<f32>,
    exposure: &Exposure<f32>,
    v_corrected: &[[f32; 3]],
) -> Result<ExposureGradients<f32>> {
    let uploaded = Uploaded::new(gpu, image, exposure, v_corrected)?;
    let op = uploaded.buffers.backward(gpu, uploaded.exposed());
    let bytes = 16 * image.color.len() as u64;
    let buffers = &uploaded.buffers;
    let wanted = [
        (&uploaded.v_picture, bytes),
        (&buffers.sums, ExposureBuffers::SUM_BYTES),
        (&buffers.corrected, bytes),
    ];
    let data = gpu.download(&[op], &wanted)?;
    let v_picture: Vec<[f32; 4]> = bytemuck::pod_collect_to_vec(&data[0]);
    let [v_gain, v_offset] = ExposureBuffers::gradients(&data[1]);
    let corrected: Vec<[f32; 4]> = bytemuck::pod_collect_to_vec(&data[2]);
    Ok(ExposureGradients {
        v_color: v_picture.iter().map(|v| [v[0], v[1], v[2]]).collect(),
        v_alpha: corrected.iter().map(|c| c[3]).collect(),
        v_gain,
        v_offset,
    })
}
