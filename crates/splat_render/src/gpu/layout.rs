//! Structs shared with WGSL, and the row lengths of flat buffers. A test checks them with naga.

use std::ops::Range;

use bytemuck::{Pod, Zeroable};

use crate::camera::Camera;
use crate::constants::TILE;
use crate::fit_device::{COLOR_WAIT, ColorStep};
use crate::stages::{AdamStep, Colors, Exposure, ProjectOptions, Rates, SplatParams};
use crate::target::Weight;

/// Floats per splat in the geometry buffer: mean 3, scales 3, quaternion 4 (wxyz), opacity 1.
pub(super) const GEOMETRY: usize = 11;

/// Floats per splat or slot in a buffer of 2D gradients: mean 2 (moments of order 1 in a slot),
/// factor 3 (order 2), depth, color 3, opacity.
pub(super) const GRADIENT: usize = 10;

/// The same with the absolute gradient of the mean, 2 floats, behind it.
pub(super) const GRADIENT_ABSOLUTE: usize = GRADIENT + 2;

/// Floats of a camera's gradient: rows of the 3x4 viewmat, fx, fy, cx, cy.
pub(super) const CAMERA: usize = 16;

/// Words per splat of a fit's notes, with their offsets: gradient sum and steps seen (floats), for
/// density control; twice the first step that colors wait for, plus 1 if it has a gradient; that gradient
/// of the color and its viewing direction (3 floats each).
pub(super) const NOTES: usize = 9;
pub(super) const NOTE_PULL: usize = 0;
pub(super) const NOTE_SEEN: usize = 1;
pub(super) const NOTE_WAITS: usize = 2;
pub(super) const NOTE_COLOR: usize = 3;
pub(super) const NOTE_DIRECTION: usize = 6;

/// Splats per workgroup and unit of windows, which keeps buffer offsets multiples of 256 bytes.
pub(super) const SPLATS_PER_GROUP: u32 = 64;

/// Workgroups of the exposure kernels; each has separate sums.
pub(super) const EXPOSURE_GROUPS: u32 = 64;

/// Workgroups of the depth loss; each has a separate sum.
pub(super) const DEPTH_GROUPS: u32 = 64;

/// Camera, background and how colors and parameters are stored.
#[repr(C)]
#[derive(Debug, Clone, Copy, PartialEq, Pod, Zeroable)]
pub(super) struct View {
    pub world_to_camera: [[f32; 4]; 3],
    pub jacobian_limits: [f32; 4],
    pub focal: [f32; 2],
    pub principal: [f32; 2],
    pub background: [f32; 3],
    pub near: f32,
    pub far: f32,
    pub blur: f32,
    pub width: u32,
    pub height: u32,
    pub tiles_x: u32,
    pub sh_degree: u32,
    pub sh_stride: u32,
    pub raw: u32,
    pub antialiased: u32,
    pub dropout_threshold: u32,
    pub dropout_seed: u32,
    pub compensation: f32,
}

impl View {
    /// The fields that the rasterize stages read.
    pub fn of_picture(width: u32, height: u32, background: [f32; 3]) -> Self {
        Self { background, width, height, tiles_x: width.div_ceil(TILE), ..Self::zeroed() }
    }

    /// The fields that the project stages read.
    pub fn of_camera(
        camera: &Camera,
        options: &ProjectOptions,
        splats: &SplatParams<'_, f32>,
    ) -> Self {
        let (sh_degree, sh_stride) = match splats.colors {
            Colors::Direct(_) => (0, 0),
            Colors::Sh { degree, stride, .. } => (degree, stride as u32),
        };
        Self {
            sh_degree,
            sh_stride,
            raw: u32::from(splats.raw),
            ..Self::of_view(camera, options, [0.0; 3])
        }
    }

    pub fn of_view(camera: &Camera, options: &ProjectOptions, background: [f32; 3]) -> Self {
        let row = |i: usize| camera.viewmat.row(i).to_array().map(|v| v as f32);
        Self {
            world_to_camera: [row(0), row(1), row(2)],
            jacobian_limits: camera.jacobian_limits().map(|v| v as f32),
            focal: [camera.fx as f32, camera.fy as f32],
            principal: [camera.cx as f32, camera.cy as f32],
            near: options.nearest(),
            far: options.far,
            blur: options.blur,
            antialiased: u32::from(options.antialiased),
            compensation: 1.0,
            ..Self::of_picture(camera.width, camera.height, background)
        }
    }
}

#[repr(C)]
#[derive(Debug, Clone, Copy, PartialEq, Eq, Pod, Zeroable)]
pub(super) struct Window {
    pub first: u32,
    pub count: u32,
    pub groups_max: u32,
}

/// The tiles of one dispatch and the index of their counts.
#[repr(C)]
#[derive(Debug, Clone, Copy, PartialEq, Eq, Pod, Zeroable)]
pub(super) struct Chunk {
    pub tile_begin: u32,
    pub tile_end: u32,
    pub capacity: u32,
    pub splats: u32,
    pub index: u32,
    pub is_first: u32,
    pub is_last: u32,
    pub list_begin: u32,
    pub list_end: u32,
    pub groups_max: u32,
}

impl Chunk {
    /// All `tiles` of a picture at once, for `splats` splats and room for `capacity` pairs.
    pub fn whole(tiles: u32, splats: u32, capacity: u32) -> Self {
        Self {
            tile_begin: 0,
            tile_end: tiles,
            capacity,
            splats,
            index: 0,
            is_first: 1,
            is_last: 1,
            list_begin: 0,
            list_end: u32::MAX,
            groups_max: u32::MAX,
        }
    }

    /// The same picture, cut into these runs of tiles.
    pub fn parts(self, runs: &[Range<u32>]) -> impl Iterator<Item = Self> {
        let last = runs.len().saturating_sub(1);
        runs.iter().enumerate().map(move |(i, run)| Self {
            tile_begin: run.start,
            tile_end: run.end,
            is_first: u32::from(i == 0),
            is_last: u32::from(i == last),
            ..self
        })
    }
}

#[repr(C)]
#[derive(Debug, Clone, Copy, PartialEq, Eq, Pod, Zeroable)]
pub(super) struct SortPass {
    pub shift: u32,
    pub chunk: u32,
    pub is_first: u32,
    pub sum_set: u32,
}

/// Rows of one set of sums in bin_sort_wide.wgsl: of 8 segments and of 64.
pub(super) const SUM_ROWS: u32 = 256 / 8 + 256 / 64;
/// Sets of them.
pub(super) const SUM_SETS: u32 = 3;

/// `SortPass::chunk` for the sort of all splats by depth.
pub(super) const ALL_SPLATS: u32 = u32::MAX;

/// A projected splat as the rasterize kernels read it.
#[repr(C)]
#[derive(Debug, Clone, Copy, PartialEq, Pod, Zeroable)]
pub(super) struct Splat2d {
    pub mean: [f32; 2],
    pub pq: [f32; 2],
    pub color: [f32; 3],
    pub r: f32,
    pub depth: f32,
    pub opacity: f32,
    pub radii: [f32; 2],
}

/// Pairs of one chunk, as counted on the device.
#[repr(C)]
#[derive(Debug, Clone, Copy, PartialEq, Eq, Pod, Zeroable)]
pub(super) struct ChunkCount {
    pub pairs: u32,
    pub total: u32,
}

/// Start of the status buffer, before the counts of chunks.
#[repr(C)]
#[derive(Debug, Clone, Copy, PartialEq, Eq, Pod, Zeroable)]
pub(super) struct StatusHead {
    pub splats: u32,
    pub step: u32,
    pub overflow: u32,
    pub visible: u32,
}

/// Weight of one depth of the photo in a step.
#[repr(C)]
#[derive(Debug, Clone, Copy, PartialEq, Pod, Zeroable)]
pub(super) struct DepthStep {
    pub scale: f32,
}

#[repr(C)]
#[derive(Debug, Clone, Copy, PartialEq, Pod, Zeroable)]
pub(super) struct ExposureUniform {
    pub gain: [f32; 4],
    pub offset: [f32; 4],
    pub behind: [f32; 4],
    pub background: [f32; 4],
}

impl From<&Exposure<f32>> for ExposureUniform {
    fn from(exposure: &Exposure<f32>) -> Self {
        let row = |[r, g, b]: [f32; 3], w: f32| [r, g, b, w];
        Self {
            gain: row(exposure.gain, 0.0),
            offset: row(exposure.offset, 0.0),
            behind: row(exposure.behind(), 0.0),
            background: exposure.background.map_or([0.0; 4], |color| row(color, 1.0)),
        }
    }
}

/// The steps that colors may wait for.
#[repr(C)]
#[derive(Debug, Clone, Copy, PartialEq, Pod, Zeroable)]
pub(super) struct ColorSteps {
    pub count: u32,
    pub moving: u32,
    pub unused: [u32; 2],
    pub steps: [[f32; 4]; COLOR_WAIT],
}

impl ColorSteps {
    /// Offset and value of step `at`.
    pub fn entry(at: usize, step: &ColorStep) -> (u64, [f32; 4]) {
        let offset = std::mem::offset_of!(Self, steps) + 16 * at;
        let [bias_first, bias_second] = step.bias;
        (offset as u64, [step.sh0, step.sh_rest, bias_first, bias_second])
    }
}

/// Settings of one step of a fit.
#[repr(C)]
#[derive(Debug, Clone, Copy, PartialEq, Pod, Zeroable)]
pub(super) struct Step {
    pub means: f32,
    pub quats: f32,
    pub scales: f32,
    pub opacities: f32,
    pub sh0: f32,
    pub sh_rest: f32,
    pub bias_first: f32,
    pub bias_second: f32,
    pub opacity_pull: f32,
    pub scale_pull: f32,
    pub noise: f32,
    pub noise_seed: u32,
    pub l1: f32,
    pub ssim: f32,
    pub has_weights: u32,
    pub frozen: u32,
    pub moving: u32,
}

impl Step {
    /// An adam step of the first `moving` splats.
    pub fn of_adam(step: &AdamStep, moving: u32) -> Self {
        let n = f64::from(moving.max(1));
        let Rates { means, quats, scales, opacities, sh0, sh_rest } = step.rates;
        let [bias_first, bias_second] = step.bias().map(|bias| bias as f32);
        Self {
            means,
            quats,
            scales,
            opacities,
            sh0,
            sh_rest,
            bias_first,
            bias_second,
            opacity_pull: (f64::from(step.opacity_regularizer) / n) as f32,
            scale_pull: (f64::from(step.scale_regularizer) / (3.0 * n)) as f32,
            noise: step.noise,
            noise_seed: step.noise_seed,
            frozen: u32::from(step.is_frozen()),
            moving,
            ..Self::zeroed()
        }
    }

    /// Adds the settings of the loss.
    pub fn with_loss(self, ssim_weight: f32, weight: Weight, has_weights: bool) -> Self {
        let (ssim, scale) = (f64::from(ssim_weight), weight.scale());
        Self {
            l1: ((1.0 - ssim) * scale) as f32,
            ssim: (ssim * scale) as f32,
            has_weights: u32::from(has_weights),
            ..self
        }
    }
}
