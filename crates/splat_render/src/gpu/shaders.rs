//! The WGSL sources with their bindings, and the constants that are written into them.

use std::fmt::Write;

use super::layout::{
    CAMERA, DEPTH_GROUPS, EXPOSURE_GROUPS, GEOMETRY, GRADIENT, GRADIENT_ABSOLUTE, NOTE_COLOR,
    NOTE_DIRECTION, NOTE_PULL, NOTE_SEEN, NOTE_WAITS, NOTES,
};
use crate::constants::{
    ADAM, ALPHA_MAX, ALPHA_MIN, DEPTH_ALPHA, QUAT_NORM2_MIN, SH_COEFFS_MAX, SSIM_C, SSIM_WINDOW,
    TILE, TRANSMITTANCE_MIN,
};
use crate::fit_device::{
    BINS, BINS_PER_LOGIT, CELLS, COLOR_WAIT, INVERSE_GUESS, KEPT_BITS_MIN, LOG_SPLIT_SHRINK,
    LOGIT_DEAD, LOGIT_FIRST, LOGIT_FOG, LOGIT_RESET, PULL_GROW, PULL_SUM_MAX, PULL_UNITS,
    SHARES_MAX,
};
use crate::sh;

/// What a binding is to a shader.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Access {
    Uniform,
    Read,
    Write,
}

use Access::{Read, Uniform, Write as ReadWrite};

/// What the shaders are built for.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) struct Build {
    /// Rows of pixels that a thread of the rasterize kernels owns: few on real GPUs, many on software
    /// ones, where reading a splat costs more than blending it and a tile's eight threads are one
    /// subgroup.
    pub rows: u32,
    /// Whether a tile's threads are one subgroup and may share through it.
    pub subgroups: bool,
    /// Bits that one pass of the radix sort takes.
    pub digit_bits: u32,
    /// Whether the loss goes along whole rows and columns, a thread each.
    pub loss_by_lines: bool,
    /// Workgroups that scans and sorts are cut into: a few per core keep a CPU busy; a GPU needs many.
    pub segments: u32,
}

impl Build {
    /// For GPUs, for software adapters with subgroups of a tile's threads, and for others.
    pub const ALL: [Self; 3] = [
        Self { rows: 2, subgroups: false, digit_bits: 8, loss_by_lines: false, segments: 256 },
        Self { rows: 8, subgroups: true, digit_bits: 4, loss_by_lines: true, segments: 16 },
        Self { rows: 8, subgroups: false, digit_bits: 4, loss_by_lines: true, segments: 16 },
    ];

    /// Threads of a tile.
    pub const fn threads(self) -> u32 {
        TILE * TILE / 4 / self.rows
    }
}

/// A WGSL file: its text and the kinds of its bindings, in the order of their numbers.
#[derive(Debug)]
pub(super) struct Source {
    pub name: &'static str,
    pub parts: &'static [&'static str],
    pub bindings: &'static [Access],
    /// Where a tile's threads work together: the texts for any device and for one whose tiles are
    /// one subgroup each.
    pub shared_work: Option<[&'static str; 2]>,
    /// Whether the file has the override `SEGMENTS`.
    pub segmented: bool,
}

const SHARED: &str = include_str!("shaders/shared.wgsl");
const GEOMETRY_WGSL: &str = include_str!("shaders/geometry.wgsl");
/// Declared before [`GEOMETRY_WGSL`], by what a kernel does with it.
const GEOMETRY_READ: &str = "@group(0) @binding(2) var<storage, read> geometry: array<f32>;\n";
const GEOMETRY_UPDATED: &str =
    "@group(0) @binding(2) var<storage, read_write> geometry: array<f32>;\n";
const COLORS_READ: &str = "@group(0) @binding(3) var<storage, read> colors: array<f32>;\n";
const COLORS_UPDATED: &str = "@group(0) @binding(3) var<storage, read_write> colors: array<f32>;\n";
const PROJECT: &str = include_str!("shaders/project.wgsl");
/// Before [`PROJECT`] where colours are up to date.
const NONE_WAIT: &str = "fn catch_up(i: u32) {}\n";
const SPLAT_BACKWARD: &str = include_str!("shaders/splat_backward.wgsl");
const ADAM_STEP: &str = include_str!("shaders/adam_step.wgsl");
const ADAM_UPDATE: &str = include_str!("shaders/adam_update.wgsl");
const ADAM_GEOMETRY: &str = include_str!("shaders/adam_geometry.wgsl");
const MCMC_RUN: &str = include_str!("shaders/mcmc_run.wgsl");
const ORIGINAL_RUN: &str = include_str!("shaders/original_run.wgsl");
const SORT_KEYS: &str = include_str!("shaders/bin_sort_keys.wgsl");
const SORT_BINDINGS: [Access; 7] =
    [Uniform, ReadWrite, Read, Read, ReadWrite, ReadWrite, ReadWrite];
const BIN_TILES: &str = include_str!("shaders/bin_tiles.wgsl");
const BACKWARD: &str = include_str!("shaders/rasterize_backward.wgsl");
const BACKWARD_BINDINGS: [Access; 10] =
    [Uniform, Uniform, Read, Read, Read, Read, Read, ReadWrite, ReadWrite, ReadWrite];
const BACKWARD_SUM: &str = include_str!("shaders/rasterize_backward_sum.wgsl");
const BACKWARD_SUM_BINDINGS: [Access; 7] = [Uniform, Read, Read, Read, Read, Read, ReadWrite];
const LOSS_PIXELS: &str = include_str!("shaders/loss_pixels.wgsl");
const LOSS_BINDINGS: [Access; 9] =
    [Uniform, Uniform, Read, Read, Read, ReadWrite, ReadWrite, ReadWrite, ReadWrite];
const TILE_WORK: [&str; 2] =
    [include_str!("shaders/tile_memory.wgsl"), include_str!("shaders/tile_subgroup.wgsl")];
const TILE_SUMS: [&str; 2] = [
    concat!(
        include_str!("shaders/tile_memory.wgsl"),
        include_str!("shaders/tile_sums_memory.wgsl")
    ),
    concat!(
        include_str!("shaders/tile_subgroup.wgsl"),
        include_str!("shaders/tile_sums_subgroup.wgsl")
    ),
];
// The backward kernels once without and once with sums of absolute gradients, so that callers that
// do not ask for those do not pay for them.
const SIGNED: &str = "const SUMS = GRADIENT;\n";
const ABSOLUTE: &str = "const SUMS = GRADIENT_ABSOLUTE;\n";

/// All shader files.
pub(super) static SOURCES: [Source; 29] = [
    Source {
        name: "project",
        shared_work: None,
        parts: &[SHARED, GEOMETRY_READ, COLORS_READ, GEOMETRY_WGSL, NONE_WAIT, PROJECT],
        bindings: &[Uniform, Uniform, Read, Read, ReadWrite, ReadWrite],
        segmented: false,
    },
    Source {
        name: "fit_project",
        shared_work: None,
        parts: &[
            SHARED,
            GEOMETRY_READ,
            COLORS_UPDATED,
            GEOMETRY_WGSL,
            ADAM_STEP,
            include_str!("shaders/waiting_colors.wgsl"),
            PROJECT,
        ],
        bindings: &[
            Uniform, Uniform, Read, ReadWrite, ReadWrite, ReadWrite, ReadWrite, ReadWrite,
            ReadWrite, Read, Uniform,
        ],
        segmented: false,
    },
    Source {
        name: "project_backward",
        shared_work: None,
        parts: &[
            SHARED,
            GEOMETRY_READ,
            COLORS_READ,
            GEOMETRY_WGSL,
            SPLAT_BACKWARD,
            include_str!("shaders/project_backward.wgsl"),
        ],
        bindings: &[Uniform, Uniform, Read, Read, Read, Read, ReadWrite, ReadWrite, ReadWrite],
        segmented: false,
    },
    Source {
        name: "fit_geometry",
        shared_work: None,
        parts: &[
            SHARED,
            GEOMETRY_UPDATED,
            COLORS_READ,
            GEOMETRY_WGSL,
            SPLAT_BACKWARD,
            ADAM_STEP,
            ADAM_UPDATE,
            ADAM_GEOMETRY,
            include_str!("shaders/fit_geometry.wgsl"),
        ],
        bindings: &[
            Uniform, Uniform, ReadWrite, Read, Read, Read, ReadWrite, ReadWrite, ReadWrite,
            ReadWrite, Uniform,
        ],
        segmented: false,
    },
    Source {
        name: "density_scan",
        shared_work: None,
        parts: &[SHARED, include_str!("shaders/density_scan.wgsl")],
        bindings: &[Uniform, ReadWrite, ReadWrite, ReadWrite, ReadWrite],
        segmented: false,
    },
    Source {
        name: "mcmc_weigh",
        shared_work: None,
        parts: &[SHARED, MCMC_RUN, include_str!("shaders/mcmc_weigh.wgsl")],
        bindings: &[Uniform, ReadWrite, Read, Read, Read, ReadWrite],
        segmented: false,
    },
    Source {
        name: "mcmc_spread",
        shared_work: None,
        parts: &[SHARED, MCMC_RUN, include_str!("shaders/mcmc_spread.wgsl")],
        bindings: &[Uniform, ReadWrite, Read, Read, Read, ReadWrite, ReadWrite, ReadWrite, Read],
        segmented: false,
    },
    Source {
        name: "density_order",
        shared_work: None,
        parts: &[SHARED, include_str!("shaders/density_order.wgsl")],
        bindings: &[Uniform, Read, Read, ReadWrite],
        segmented: false,
    },
    Source {
        name: "density_rows",
        shared_work: None,
        parts: &[SHARED, include_str!("shaders/density_rows.wgsl")],
        bindings: &[Uniform, Read, Read, Read, ReadWrite],
        segmented: false,
    },
    Source {
        name: "original_choose",
        shared_work: None,
        parts: &[SHARED, ORIGINAL_RUN, include_str!("shaders/original_choose.wgsl")],
        bindings: &[Uniform, Read, Read, Read, ReadWrite, Read, Read, ReadWrite, ReadWrite],
        segmented: false,
    },
    Source {
        name: "original_draw",
        shared_work: None,
        parts: &[SHARED, ORIGINAL_RUN, include_str!("shaders/original_draw.wgsl")],
        bindings: &[Uniform, Read, Read, Read, Read, Read, ReadWrite, ReadWrite],
        segmented: false,
    },
    Source {
        name: "original_reset",
        shared_work: None,
        parts: &[SHARED, include_str!("shaders/original_reset.wgsl")],
        bindings: &[Uniform, ReadWrite, ReadWrite, ReadWrite],
        segmented: false,
    },
    Source {
        name: "bin_count",
        shared_work: None,
        parts: &[SHARED, BIN_TILES, include_str!("shaders/bin_count.wgsl")],
        bindings: &[Uniform, Uniform, Read, Read, Read, ReadWrite],
        segmented: false,
    },
    Source {
        name: "bin_scan",
        shared_work: None,
        parts: &[SHARED, include_str!("shaders/bin_scan.wgsl")],
        bindings: &[Uniform, ReadWrite, ReadWrite, ReadWrite, ReadWrite],
        segmented: true,
    },
    Source {
        name: "bin_emit",
        shared_work: None,
        parts: &[SHARED, BIN_TILES, include_str!("shaders/bin_emit.wgsl")],
        bindings: &[Uniform, Uniform, Read, Read, Read, Read, ReadWrite, ReadWrite, ReadWrite],
        segmented: false,
    },
    Source {
        name: "bin_sort",
        shared_work: None,
        parts: &[SHARED, SORT_KEYS, include_str!("shaders/bin_sort.wgsl")],
        bindings: &SORT_BINDINGS,
        segmented: true,
    },
    Source {
        name: "bin_sort_wide",
        shared_work: None,
        parts: &[SHARED, SORT_KEYS, include_str!("shaders/bin_sort_wide.wgsl")],
        bindings: &SORT_BINDINGS,
        segmented: true,
    },
    Source {
        name: "bin_ranges",
        shared_work: None,
        parts: &[SHARED, include_str!("shaders/bin_ranges.wgsl")],
        bindings: &[Uniform, Read, Read, Read, Read, ReadWrite, ReadWrite],
        segmented: false,
    },
    Source {
        name: "rasterize",
        shared_work: Some(TILE_WORK),
        parts: &[SHARED, include_str!("shaders/rasterize.wgsl")],
        bindings: &[Uniform, Uniform, Read, Read, Read, ReadWrite, ReadWrite],
        segmented: false,
    },
    Source {
        name: "rasterize_backward",
        shared_work: Some(TILE_SUMS),
        parts: &[SHARED, SIGNED, BACKWARD],
        bindings: &BACKWARD_BINDINGS,
        segmented: false,
    },
    Source {
        name: "rasterize_backward_absolute",
        shared_work: Some(TILE_SUMS),
        parts: &[SHARED, ABSOLUTE, BACKWARD],
        bindings: &BACKWARD_BINDINGS,
        segmented: false,
    },
    Source {
        name: "rasterize_backward_sum",
        shared_work: None,
        parts: &[SHARED, SIGNED, BACKWARD_SUM],
        bindings: &BACKWARD_SUM_BINDINGS,
        segmented: false,
    },
    Source {
        name: "rasterize_backward_sum_absolute",
        shared_work: None,
        parts: &[SHARED, ABSOLUTE, BACKWARD_SUM],
        bindings: &BACKWARD_SUM_BINDINGS,
        segmented: false,
    },
    Source {
        name: "exposure",
        shared_work: None,
        parts: &[SHARED, include_str!("shaders/exposure.wgsl")],
        bindings: &[Uniform, Uniform, Read, ReadWrite, ReadWrite, ReadWrite, ReadWrite],
        segmented: false,
    },
    Source {
        name: "depth_loss",
        shared_work: None,
        parts: &[SHARED, include_str!("shaders/depth_loss.wgsl")],
        bindings: &[Uniform, Uniform, Read, Read, Read, ReadWrite, ReadWrite, ReadWrite],
        segmented: false,
    },
    Source {
        name: "loss",
        shared_work: None,
        parts: &[SHARED, LOSS_PIXELS, include_str!("shaders/loss.wgsl")],
        bindings: &LOSS_BINDINGS,
        segmented: false,
    },
    Source {
        name: "loss_lines",
        shared_work: None,
        parts: &[SHARED, LOSS_PIXELS, include_str!("shaders/loss_lines.wgsl")],
        bindings: &LOSS_BINDINGS,
        segmented: false,
    },
    Source {
        name: "adam_geometry",
        shared_work: None,
        parts: &[
            SHARED,
            ADAM_STEP,
            ADAM_UPDATE,
            ADAM_GEOMETRY,
            include_str!("shaders/adam_plain.wgsl"),
        ],
        bindings: &[Uniform, Uniform, ReadWrite, Read, ReadWrite, ReadWrite],
        segmented: false,
    },
    Source {
        name: "adam_colors",
        shared_work: None,
        parts: &[SHARED, ADAM_STEP, ADAM_UPDATE, include_str!("shaders/adam_colors.wgsl")],
        bindings: &[Uniform, Uniform, Uniform, ReadWrite, Read, ReadWrite, ReadWrite],
        segmented: false,
    },
];

/// The kernels: entry points of [`SOURCES`].
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Kernel {
    Project,
    FitProject,
    CatchUpAll,
    ProjectBackward,
    FitGeometry,
    DepthKeys,
    TileCounts,
    ScanSums,
    ScanApply,
    Emit,
    SortHistogram,
    SortScan,
    SortScatter,
    SortCount,
    SortPlace,
    Ranges,
    Rasterize,
    RasterizeBackward,
    RasterizeBackwardSum,
    RasterizeBackwardAbsolute,
    RasterizeBackwardSumAbsolute,
    Exposure,
    ExposureBackward,
    LossSlopes,
    LossGradient,
    LossColumns,
    LossRows,
    LossColumnsGradient,
    DepthLoss,
    AdamGeometry,
    AdamColors,
    McmcSample,
    McmcWeigh,
    DensitySums,
    DensityPrefix,
    McmcStart,
    McmcDraw,
    McmcShare,
    McmcCopy,
    DensityBounds,
    DensityCodes,
    DensityRows,
    OriginalPull,
    OriginalGrow,
    OriginalKeep,
    OriginalDraw,
    OriginalReset,
}

impl Kernel {
    /// Every kernel, in the order of their numbers.
    pub const ALL: [Self; 47] = [
        Self::Project,
        Self::FitProject,
        Self::CatchUpAll,
        Self::ProjectBackward,
        Self::FitGeometry,
        Self::DepthKeys,
        Self::TileCounts,
        Self::ScanSums,
        Self::ScanApply,
        Self::Emit,
        Self::SortHistogram,
        Self::SortScan,
        Self::SortScatter,
        Self::SortCount,
        Self::SortPlace,
        Self::Ranges,
        Self::Rasterize,
        Self::RasterizeBackward,
        Self::RasterizeBackwardSum,
        Self::RasterizeBackwardAbsolute,
        Self::RasterizeBackwardSumAbsolute,
        Self::Exposure,
        Self::ExposureBackward,
        Self::LossSlopes,
        Self::LossGradient,
        Self::LossColumns,
        Self::LossRows,
        Self::LossColumnsGradient,
        Self::DepthLoss,
        Self::AdamGeometry,
        Self::AdamColors,
        Self::McmcSample,
        Self::McmcWeigh,
        Self::DensitySums,
        Self::DensityPrefix,
        Self::McmcStart,
        Self::McmcDraw,
        Self::McmcShare,
        Self::McmcCopy,
        Self::DensityBounds,
        Self::DensityCodes,
        Self::DensityRows,
        Self::OriginalPull,
        Self::OriginalGrow,
        Self::OriginalKeep,
        Self::OriginalDraw,
        Self::OriginalReset,
    ];

    /// (file, entry point)
    pub fn entry(self) -> (&'static str, &'static str) {
        match self {
            Self::Project => ("project", "project"),
            Self::FitProject => ("fit_project", "project"),
            Self::CatchUpAll => ("fit_project", "catch_up_all"),
            Self::ProjectBackward => ("project_backward", "project_backward"),
            Self::FitGeometry => ("fit_geometry", "fit_geometry"),
            Self::DepthKeys => ("bin_count", "depth_keys"),
            Self::TileCounts => ("bin_count", "tile_counts"),
            Self::ScanSums => ("bin_scan", "scan_sums"),
            Self::ScanApply => ("bin_scan", "scan_apply"),
            Self::Emit => ("bin_emit", "emit"),
            Self::SortHistogram => ("bin_sort", "sort_histogram"),
            Self::SortScan => ("bin_sort", "sort_scan"),
            Self::SortScatter => ("bin_sort", "sort_scatter"),
            Self::SortCount => ("bin_sort_wide", "sort_count"),
            Self::SortPlace => ("bin_sort_wide", "sort_place"),
            Self::Ranges => ("bin_ranges", "ranges"),
            Self::Rasterize => ("rasterize", "rasterize"),
            Self::RasterizeBackward => ("rasterize_backward", "rasterize_backward"),
            Self::RasterizeBackwardSum => ("rasterize_backward_sum", "rasterize_backward_sum"),
            Self::RasterizeBackwardAbsolute => {
                ("rasterize_backward_absolute", "rasterize_backward")
            }
            Self::RasterizeBackwardSumAbsolute => {
                ("rasterize_backward_sum_absolute", "rasterize_backward_sum")
            }
            Self::Exposure => ("exposure", "exposure"),
            Self::ExposureBackward => ("exposure", "exposure_backward"),
            Self::LossSlopes => ("loss", "loss_slopes"),
            Self::LossGradient => ("loss", "loss_gradient"),
            Self::LossColumns => ("loss_lines", "loss_columns"),
            Self::LossRows => ("loss_lines", "loss_rows"),
            Self::LossColumnsGradient => ("loss_lines", "loss_columns_gradient"),
            Self::DepthLoss => ("depth_loss", "depth_loss"),
            Self::AdamGeometry => ("adam_geometry", "adam_geometry"),
            Self::AdamColors => ("adam_colors", "adam_colors"),
            Self::McmcSample => ("mcmc_weigh", "mcmc_sample"),
            Self::McmcWeigh => ("mcmc_weigh", "mcmc_weigh"),
            Self::DensitySums => ("density_scan", "density_sums"),
            Self::DensityPrefix => ("density_scan", "density_prefix"),
            Self::McmcStart => ("mcmc_spread", "mcmc_start"),
            Self::McmcDraw => ("mcmc_spread", "mcmc_draw"),
            Self::McmcShare => ("mcmc_spread", "mcmc_share"),
            Self::McmcCopy => ("mcmc_spread", "mcmc_copy"),
            Self::DensityBounds => ("density_order", "density_bounds"),
            Self::DensityCodes => ("density_order", "density_codes"),
            Self::DensityRows => ("density_rows", "density_rows"),
            Self::OriginalPull => ("original_choose", "original_pull"),
            Self::OriginalGrow => ("original_choose", "original_grow"),
            Self::OriginalKeep => ("original_choose", "original_keep"),
            Self::OriginalDraw => ("original_draw", "original_draw"),
            Self::OriginalReset => ("original_reset", "original_reset"),
        }
    }
}

/// Constants of the crate as WGSL, so that no shader repeats a value by hand.
fn constants(rows: u32) -> String {
    let mut out = String::new();
    let _ = writeln!(out, "const ROWS = {rows}u;");
    for (name, value) in [("TILE", TILE), ("GEOMETRY", GEOMETRY as u32)].into_iter().chain([
        ("GRADIENT", GRADIENT as u32),
        ("GRADIENT_ABSOLUTE", GRADIENT_ABSOLUTE as u32),
        ("CAMERA", CAMERA as u32),
        ("NOTES", NOTES as u32),
        ("NOTE_PULL", NOTE_PULL as u32),
        ("NOTE_SEEN", NOTE_SEEN as u32),
        ("NOTE_WAITS", NOTE_WAITS as u32),
        ("NOTE_COLOR", NOTE_COLOR as u32),
        ("NOTE_DIRECTION", NOTE_DIRECTION as u32),
        ("COLOR_WAIT", COLOR_WAIT as u32),
        ("EXPOSURE_GROUPS", EXPOSURE_GROUPS),
        ("DEPTH_GROUPS", DEPTH_GROUPS),
        ("SH_COEFFS_MAX", SH_COEFFS_MAX as u32),
        ("BINS", BINS as u32),
        ("SHARES_MAX", SHARES_MAX as u32),
        ("CELLS", CELLS),
        ("PULL_GROW", PULL_GROW),
        ("KEPT_BITS_MIN", KEPT_BITS_MIN),
        ("INVERSE_GUESS", INVERSE_GUESS),
    ]) {
        let _ = writeln!(out, "const {name} = {value}u;");
    }
    let floats = [
        ("ALPHA_MIN", ALPHA_MIN),
        ("DEPTH_ALPHA", DEPTH_ALPHA),
        ("ALPHA_MAX", ALPHA_MAX),
        ("TRANSMITTANCE_MIN", TRANSMITTANCE_MIN),
        ("QUAT_NORM2_MIN", QUAT_NORM2_MIN),
        ("SH_C0", sh::C0 as f32),
        ("SH_C1", sh::C1 as f32),
        ("SH_C4_HALF", sh::C4_HALF as f32),
        ("ADAM_BETA1", ADAM.0),
        ("ADAM_BETA2", ADAM.1),
        ("ADAM_EPSILON", ADAM.2),
        ("LOGIT_DEAD", LOGIT_DEAD),
        ("LOGIT_FOG", LOGIT_FOG),
        ("LOGIT_RESET", LOGIT_RESET),
        ("LOG_SPLIT_SHRINK", LOG_SPLIT_SHRINK),
        ("PULL_UNITS", PULL_UNITS),
        ("PULL_SUM_MAX", PULL_SUM_MAX),
        ("LOGIT_FIRST", LOGIT_FIRST),
        ("BINS_PER_LOGIT", BINS_PER_LOGIT),
        ("SSIM_C1", SSIM_C.0),
        ("SSIM_C2", SSIM_C.1),
    ];
    for (name, value) in floats {
        // `{:e}` prints the shortest decimal that reads back as the same f32.
        let _ = writeln!(out, "const {name} = {value:e}f;");
    }
    let tables = [("SH_C2", &sh::C2[..]), ("SH_C3", &sh::C3[..]), ("SH_C4", &sh::C4[..])];
    for (name, values) in tables {
        for (i, value) in values.iter().enumerate() {
            let _ = writeln!(out, "const {name}_{i} = {:e}f;", *value as f32);
        }
    }
    // SSIM's window is symmetric.
    for (i, tap) in SSIM_WINDOW.iter().take(SSIM_WINDOW.len() / 2 + 1).enumerate() {
        let _ = writeln!(out, "const SSIM_TAP_{i} = {tap:e}f;");
    }
    // Weights of each of the 14 values that four neighbouring outputs of SSIM's filter need.
    let tap = |k: usize, output: usize| {
        let weight = k.checked_sub(output).and_then(|k| SSIM_WINDOW.get(k)).unwrap_or(&0.0);
        format!("{weight:e}f")
    };
    let rows: Vec<String> = (0..SSIM_WINDOW.len() + 3)
        .map(|k| format!("vec4({})", [0, 1, 2, 3].map(|output| tap(k, output)).join(", ")))
        .collect();
    let _ = writeln!(out, "const SSIM_FOUR = array({});", rows.join(", "));
    out
}

/// The structs, constants and functions that all shaders share, for callers that draw from the
/// kernels' buffers: `Splat2d` above all.
pub fn shared_wgsl() -> String {
    constants(1) + SHARED
}

/// A shader as one kind of adapter compiles it.
#[derive(Debug, Clone)]
pub struct ShaderVariant {
    /// File, and what sets the variant apart.
    pub name: String,
    /// The WGSL.
    pub text: String,
    /// Whether it needs subgroup operations.
    pub subgroups: bool,
    /// Values of its pipeline-overridable constants.
    pub constants: Vec<(&'static str, f64)>,
}

/// Every shader in every variant that some adapter compiles. Tests write them in the languages of
/// all drivers, few of which are at hand.
pub fn shader_variants() -> impl Iterator<Item = ShaderVariant> {
    Build::ALL.into_iter().flat_map(|build| {
        SOURCES.iter().map(move |source| ShaderVariant {
            name: format!(
                "{}, {} rows{}",
                source.name,
                build.rows,
                if build.subgroups { ", subgroups" } else { "" }
            ),
            text: source.text(build),
            subgroups: build.subgroups,
            constants: source.constants(build),
        })
    })
}

/// The text with every line that has `{row}` in it repeated, once for each of so many rows of pixels.
fn repeat_rows(text: &str, rows: u32) -> String {
    let mut out = String::with_capacity(2 * text.len());
    for line in text.split_inclusive('\n') {
        if line.contains("{row}") && !line.trim_start().starts_with("//") {
            (0..rows).for_each(|row| out.push_str(&line.replace("{row}", &row.to_string())));
        } else {
            out.push_str(line);
        }
    }
    out
}

impl Source {
    /// The whole text that is compiled.
    pub fn text(&self, build: Build) -> String {
        let mut text = constants(build.rows);
        if let Some(texts) = self.shared_work {
            text.push_str(texts[usize::from(build.subgroups)]);
        }
        for part in self.parts {
            text.push_str(&repeat_rows(part, build.rows));
        }
        text
    }

    /// Values of the overrides.
    pub fn constants(&self, build: Build) -> Vec<(&'static str, f64)> {
        if self.segmented { vec![("SEGMENTS", f64::from(build.segments))] } else { Vec::new() }
    }

    /// The file of that name.
    pub fn named(name: &str) -> &'static Self {
        SOURCES.iter().find(|source| source.name == name).unwrap_or(&SOURCES[0])
    }
}

#[cfg(test)]
mod tests {
    use std::mem::offset_of;

    use super::*;
    use crate::fit_device::FogCamera;
    use crate::gpu::drawn::{CellsUniform, Rows, Scan};
    use crate::gpu::layout::{
        Chunk, ChunkCount, ColorSteps, DepthStep, ExposureUniform, SortPass, Splat2d, StatusHead,
        Step, View, Window,
    };
    use crate::gpu::mcmc::Run;
    use crate::gpu::original::RunUniform;

    fn parse(source: &Source) -> naga::Module {
        let text = source.text(Build::ALL[0]);
        naga::front::wgsl::parse_str(&text)
            .unwrap_or_else(|e| panic!("{}: {}", source.name, e.emit_to_string(&text)))
    }

    #[test]
    fn kernels_name_entry_points_of_their_files() {
        for kernel in Kernel::ALL {
            let (file, entry) = kernel.entry();
            let source = Source::named(file);
            assert_eq!(source.name, file);
            let module = parse(source);
            assert!(module.entry_points.iter().any(|e| e.name == entry), "{file} has no {entry}");
        }
        for source in &SOURCES {
            let storage = source.bindings.iter().filter(|&&b| b != Uniform).count();
            assert!(storage <= 8, "{} binds {storage} storage buffers", source.name);
        }
    }

    #[test]
    fn bindings_are_declared_as_bound() {
        for source in &SOURCES {
            let module = parse(source);
            let mut declared = vec![None; source.bindings.len()];
            for (_, variable) in module.global_variables.iter() {
                let Some(binding) = &variable.binding else { continue };
                declared[binding.binding as usize] = Some(match variable.space {
                    naga::AddressSpace::Uniform => Uniform,
                    naga::AddressSpace::Storage { access }
                        if access.contains(naga::StorageAccess::STORE) =>
                    {
                        ReadWrite
                    }
                    _ => Read,
                });
            }
            let expected: Vec<_> = source.bindings.iter().copied().map(Some).collect();
            assert_eq!(declared, expected, "{}", source.name);
        }
    }

    /// Asserts a struct's members and size against naga's layout of the WGSL struct.
    fn assert_layout(file: &str, name: &str, size: usize, members: &[(&str, usize)]) {
        let module = parse(Source::named(file));
        let (_, ty) = module
            .types
            .iter()
            .find(|(_, t)| t.name.as_deref() == Some(name))
            .unwrap_or_else(|| panic!("{file} has no struct {name}"));
        let naga::TypeInner::Struct { members: found, span } = &ty.inner else {
            panic!("{name} is no struct")
        };
        let found: Vec<_> = found
            .iter()
            .map(|m| (m.name.as_deref().unwrap_or_default(), m.offset as usize))
            .collect();
        assert_eq!(found, members, "{name}");
        assert_eq!(*span as usize, size, "{name}");
    }

    macro_rules! layout {
        ($file:literal, $type:ident, $($member:ident),+) => {
            assert_layout(
                $file,
                stringify!($type),
                size_of::<$type>(),
                &[$((stringify!($member), offset_of!($type, $member))),+],
            )
        };
    }

    #[test]
    fn rust_and_wgsl_agree_on_layouts() {
        layout!(
            "project",
            View,
            world_to_camera,
            jacobian_limits,
            focal,
            principal,
            background,
            near,
            far,
            blur,
            width,
            height,
            tiles_x,
            sh_degree,
            sh_stride,
            raw,
            antialiased,
            dropout_threshold,
            dropout_seed,
            compensation
        );
        layout!("project", Window, first, count, groups_max);
        layout!("mcmc_weigh", Run, splats, fresh, seed, round, cameras, every, color_floats, zero);
        assert_layout(
            "original_choose",
            "OriginalRun",
            size_of::<RunUniform>(),
            &[
                ("splats", offset_of!(RunUniform, splats)),
                ("color_floats", offset_of!(RunUniform, color_floats)),
                ("room", offset_of!(RunUniform, room)),
                ("seed", offset_of!(RunUniform, seed)),
                ("log_split", offset_of!(RunUniform, log_split)),
                ("log_huge", offset_of!(RunUniform, log_huge)),
                ("keeps_all", offset_of!(RunUniform, keeps_all)),
                ("zero", offset_of!(RunUniform, zero)),
            ],
        );
        layout!("density_scan", Scan, splats, round);
        layout!("density_rows", Rows, splats, floats, kind, unused);
        layout!("mcmc_weigh", FogCamera, rows, focal, principal, size, nearest, unused);
        assert_layout(
            "density_order",
            "Cells",
            size_of::<CellsUniform>(),
            &[
                ("low", offset_of!(CellsUniform, low)),
                ("splats", offset_of!(CellsUniform, splats)),
                ("scale", offset_of!(CellsUniform, scale)),
                ("upper", offset_of!(CellsUniform, upper)),
            ],
        );
        layout!("depth_loss", DepthStep, scale);
        assert_layout(
            "exposure",
            "Exposure",
            size_of::<ExposureUniform>(),
            &[
                ("gain", offset_of!(ExposureUniform, gain)),
                ("offset", offset_of!(ExposureUniform, offset)),
                ("behind", offset_of!(ExposureUniform, behind)),
                ("background", offset_of!(ExposureUniform, background)),
            ],
        );
        layout!(
            "bin_count",
            Chunk,
            tile_begin,
            tile_end,
            capacity,
            splats,
            index,
            is_first,
            is_last,
            list_begin,
            list_end,
            groups_max
        );
        layout!("bin_sort", SortPass, shift, chunk, is_first, keeps_culled);
        // Without what fills it up to the steps.
        assert_layout(
            "fit_project",
            "ColorSteps",
            size_of::<ColorSteps>(),
            &[
                ("count", offset_of!(ColorSteps, count)),
                ("moving", offset_of!(ColorSteps, moving)),
                ("steps", offset_of!(ColorSteps, steps)),
            ],
        );
        layout!("project", Splat2d, mean, pq, color, r, depth, opacity, radii);
        layout!("bin_scan", ChunkCount, pairs, total);
        layout!(
            "adam_colors",
            Step,
            means,
            quats,
            scales,
            opacities,
            sh0,
            sh_rest,
            bias_first,
            bias_second,
            opacity_pull,
            scale_pull,
            noise,
            noise_seed,
            l1,
            ssim,
            has_weights,
            frozen,
            moving
        );
        assert_layout(
            "bin_scan",
            "Status",
            // A trailing runtime array counts as one element.
            size_of::<StatusHead>() + size_of::<ChunkCount>(),
            &[
                ("splats", offset_of!(StatusHead, splats)),
                ("step", offset_of!(StatusHead, step)),
                ("overflow", offset_of!(StatusHead, overflow)),
                ("visible", offset_of!(StatusHead, visible)),
                ("chunks", size_of::<StatusHead>()),
            ],
        );
    }
}
