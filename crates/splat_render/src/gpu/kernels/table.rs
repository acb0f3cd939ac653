//! The table of kernels, and the WGSL files that they are compiled from.

use super::Access::{Read, Uniform, Write as ReadWrite};
use super::{Access, Source};

/// Declares [`Kernel`] from a table of (kernel, source, entry point).
macro_rules! kernels {
    ($($kernel:ident: $source:ident, $entry:literal;)*) => {
        /// The kernels: entry points of the sources.
        #[derive(Debug, Clone, Copy, PartialEq, Eq)]
        pub(in crate::gpu) enum Kernel {
            $($kernel),*
        }

        impl Kernel {
            /// All kernels; kernels of one source are adjacent.
            pub const ALL: &[Self] = &[$(Self::$kernel),*];

            pub fn source(self) -> &'static Source {
                match self {
                    $(Self::$kernel => &$source),*
                }
            }

            /// Name of the entry point in the source.
            pub fn entry(self) -> &'static str {
                match self {
                    $(Self::$kernel => $entry),*
                }
            }
        }
    };
}

kernels! {
    Project: PROJECT, "project";
    FitProject: FIT_PROJECT, "project";
    CatchUpAll: FIT_PROJECT, "catch_up_all";
    ProjectBackward: PROJECT_BACKWARD, "project_backward";
    FitGeometry: FIT_GEOMETRY, "fit_geometry";
    DepthKeys: BIN_COUNT, "depth_keys";
    TileCounts: BIN_COUNT, "tile_counts";
    ScanApply: BIN_SCAN, "scan_apply";
    Emit: BIN_EMIT, "emit";
    SortHistogram: BIN_SORT, "sort_histogram";
    SortScan: BIN_SORT, "sort_scan";
    SortScatter: BIN_SORT, "sort_scatter";
    SortCount: BIN_SORT_WIDE, "sort_count";
    SortPlace: BIN_SORT_WIDE, "sort_place";
    Ranges: BIN_RANGES, "ranges";
    Rasterize: RASTERIZE, "rasterize";
    RasterizeBackward: RASTERIZE_BACKWARD, "rasterize_backward";
    RasterizeBackwardSum: RASTERIZE_BACKWARD_SUM, "rasterize_backward_sum";
    RasterizeBackwardAbsolute: RASTERIZE_BACKWARD_ABSOLUTE, "rasterize_backward";
    RasterizeBackwardSumAbsolute: RASTERIZE_BACKWARD_SUM_ABSOLUTE, "rasterize_backward_sum";
    Exposure: EXPOSURE, "exposure";
    ExposureBackward: EXPOSURE, "exposure_backward";
    LossSlopes: LOSS, "loss_slopes";
    LossGradient: LOSS, "loss_gradient";
    LossColumns: LOSS_LINES, "loss_columns";
    LossRows: LOSS_LINES, "loss_rows";
    LossColumnsGradient: LOSS_LINES, "loss_columns_gradient";
    DepthLoss: DEPTH_LOSS, "depth_loss";
    AdamGeometry: ADAM_GEOMETRY, "adam_geometry";
    AdamColors: ADAM_COLORS, "adam_colors";
    McmcSample: MCMC_WEIGH, "mcmc_sample";
    McmcWeigh: MCMC_WEIGH, "mcmc_weigh";
    DensitySums: DENSITY_SCAN, "density_sums";
    DensityPrefix: DENSITY_SCAN, "density_prefix";
    McmcStart: MCMC_SPREAD, "mcmc_start";
    McmcDraw: MCMC_SPREAD, "mcmc_draw";
    McmcShare: MCMC_SPREAD, "mcmc_share";
    McmcCopy: MCMC_SPREAD, "mcmc_copy";
    DensityBounds: DENSITY_ORDER, "density_bounds";
    DensityCodes: DENSITY_ORDER, "density_codes";
    DensityRows: DENSITY_ROWS, "density_rows";
    OriginalPull: ORIGINAL_CHOOSE, "original_pull";
    OriginalGrow: ORIGINAL_CHOOSE, "original_grow";
    OriginalKeep: ORIGINAL_CHOOSE, "original_keep";
    OriginalDraw: ORIGINAL_DRAW, "original_draw";
    OriginalReset: ORIGINAL_RESET, "original_reset";
}

const GEOMETRY_WGSL: &str = include_str!("../shaders/geometry.wgsl");
/// Declarations before [`GEOMETRY_WGSL`]: a kernel either reads or updates the buffers.
const GEOMETRY_READ: &str = "@group(0) @binding(2) var<storage, read> geometry: array<f32>;\n";
const GEOMETRY_UPDATED: &str =
    "@group(0) @binding(2) var<storage, read_write> geometry: array<f32>;\n";
const COLORS_READ: &str = "@group(0) @binding(3) var<storage, read> colors: array<f32>;\n";
const COLORS_UPDATED: &str = "@group(0) @binding(3) var<storage, read_write> colors: array<f32>;\n";
const PROJECT_WGSL: &str = include_str!("../shaders/project.wgsl");
const SH_COLOR: &str = include_str!("../shaders/sh_color.wgsl");
const COLOR_OF: &str = include_str!("../shaders/color_of.wgsl");
const WAITING_COLORS: &str = include_str!("../shaders/waiting_colors.wgsl");
/// Before [`COLOR_OF`] if all colors are up to date.
const NONE_WAIT: &str = "fn catch_up(i: u32) {}\n";
const SPLAT_BACKWARD: &str = include_str!("../shaders/splat_backward.wgsl");
const ADAM_STEP: &str = include_str!("../shaders/adam_step.wgsl");
const ADAM_UPDATE: &str = include_str!("../shaders/adam_update.wgsl");
const ADAM_GEOMETRY_WGSL: &str = include_str!("../shaders/adam_geometry.wgsl");
const MCMC_RUN: &str = include_str!("../shaders/mcmc_run.wgsl");
const ORIGINAL_RUN: &str = include_str!("../shaders/original_run.wgsl");
const SORT_KEYS: &str = include_str!("../shaders/bin_sort_keys.wgsl");
const SORT_BINDINGS: [Access; 7] =
    [Uniform, ReadWrite, Read, Read, ReadWrite, ReadWrite, ReadWrite];
const BIN_TILES: &str = include_str!("../shaders/bin_tiles.wgsl");
const BIN_SEGMENTS: &str = include_str!("../shaders/bin_segments.wgsl");
const TILE_LIST: &str = include_str!("../shaders/tile_list.wgsl");
const TILE_BLOCKS: &str = include_str!("../shaders/tile_blocks.wgsl");
const BACKWARD: &str = include_str!("../shaders/rasterize_backward.wgsl");
const BACKWARD_BLOCKS: &str = include_str!("../shaders/rasterize_backward_blocks.wgsl");
const BACKWARD_PIXELS: &str = include_str!("../shaders/backward_pixels.wgsl");
const BACKWARD_BINDINGS: [Access; 10] =
    [Uniform, Uniform, Read, Read, Read, Read, Read, ReadWrite, ReadWrite, ReadWrite];
const BACKWARD_SUM: &str = include_str!("../shaders/rasterize_backward_sum.wgsl");
const BACKWARD_SUM_BINDINGS: [Access; 7] = [Uniform, Read, Read, Read, Read, Read, ReadWrite];
const LOSS_PIXELS: &str = include_str!("../shaders/loss_pixels.wgsl");
const LOSS_BINDINGS: [Access; 9] =
    [Uniform, Uniform, Read, Read, Read, ReadWrite, ReadWrite, ReadWrite, ReadWrite];
const TILE_WORK: [&str; 2] =
    [include_str!("../shaders/tile_memory.wgsl"), include_str!("../shaders/tile_subgroup.wgsl")];
const TILE_SUMS: [&str; 2] = [
    concat!(
        include_str!("../shaders/tile_memory.wgsl"),
        include_str!("../shaders/tile_sums_memory.wgsl")
    ),
    concat!(
        include_str!("../shaders/tile_subgroup.wgsl"),
        include_str!("../shaders/tile_sums_subgroup.wgsl")
    ),
];
// The backward kernels exist with and without sums of absolute gradients, which are rarely needed.
const SIGNED: &str = "const SUMS = GRADIENT;\n";
const ABSOLUTE: &str = "const SUMS = GRADIENT_ABSOLUTE;\n";

static PROJECT: Source = Source::new(
    "project",
    &[GEOMETRY_READ, COLORS_READ, GEOMETRY_WGSL, NONE_WAIT, COLOR_OF, SH_COLOR, PROJECT_WGSL],
    &[Uniform, Uniform, Read, Read, ReadWrite, ReadWrite],
);

static FIT_PROJECT: Source = Source::new(
    "fit_project",
    &[
        GEOMETRY_READ,
        COLORS_UPDATED,
        GEOMETRY_WGSL,
        ADAM_STEP,
        WAITING_COLORS,
        include_str!("../shaders/color_rows.wgsl"),
        COLOR_OF,
        SH_COLOR,
        PROJECT_WGSL,
    ],
    &[
        Uniform, Uniform, Read, ReadWrite, ReadWrite, ReadWrite, ReadWrite, ReadWrite, ReadWrite,
        Read, Uniform,
    ],
)
.with_gpu_parts(&[
    GEOMETRY_READ,
    COLORS_UPDATED,
    GEOMETRY_WGSL,
    ADAM_STEP,
    WAITING_COLORS,
    include_str!("../shaders/color_groups.wgsl"),
    SH_COLOR,
    PROJECT_WGSL,
]);

static PROJECT_BACKWARD: Source = Source::new(
    "project_backward",
    &[
        GEOMETRY_READ,
        COLORS_READ,
        GEOMETRY_WGSL,
        SPLAT_BACKWARD,
        include_str!("../shaders/project_backward.wgsl"),
    ],
    &[Uniform, Uniform, Read, Read, Read, Read, ReadWrite, ReadWrite, ReadWrite],
);

static FIT_GEOMETRY: Source = Source::new(
    "fit_geometry",
    &[
        GEOMETRY_UPDATED,
        COLORS_READ,
        GEOMETRY_WGSL,
        SPLAT_BACKWARD,
        ADAM_STEP,
        ADAM_UPDATE,
        ADAM_GEOMETRY_WGSL,
        include_str!("../shaders/fit_geometry.wgsl"),
    ],
    &[
        Uniform, Uniform, ReadWrite, Read, Read, Read, ReadWrite, ReadWrite, ReadWrite, ReadWrite,
        Uniform,
    ],
);

static DENSITY_SCAN: Source = Source::new(
    "density_scan",
    &[include_str!("../shaders/density_scan.wgsl")],
    &[Uniform, ReadWrite, ReadWrite, ReadWrite, ReadWrite],
);

static MCMC_WEIGH: Source = Source::new(
    "mcmc_weigh",
    &[MCMC_RUN, include_str!("../shaders/mcmc_weigh.wgsl")],
    &[Uniform, ReadWrite, Read, Read, Read, ReadWrite],
);

static MCMC_SPREAD: Source = Source::new(
    "mcmc_spread",
    &[MCMC_RUN, include_str!("../shaders/mcmc_spread.wgsl")],
    &[Uniform, ReadWrite, Read, Read, Read, ReadWrite, ReadWrite, ReadWrite, Read],
);

static DENSITY_ORDER: Source = Source::new(
    "density_order",
    &[include_str!("../shaders/density_order.wgsl")],
    &[Uniform, Read, Read, ReadWrite],
);

static DENSITY_ROWS: Source = Source::new(
    "density_rows",
    &[include_str!("../shaders/density_rows.wgsl")],
    &[Uniform, Read, Read, Read, ReadWrite],
);

static ORIGINAL_CHOOSE: Source = Source::new(
    "original_choose",
    &[ORIGINAL_RUN, include_str!("../shaders/original_choose.wgsl")],
    &[Uniform, Read, Read, Read, ReadWrite, Read, Read, ReadWrite, ReadWrite],
);

static ORIGINAL_DRAW: Source = Source::new(
    "original_draw",
    &[ORIGINAL_RUN, include_str!("../shaders/original_draw.wgsl")],
    &[Uniform, Read, Read, Read, Read, Read, ReadWrite, ReadWrite],
);

static ORIGINAL_RESET: Source = Source::new(
    "original_reset",
    &[include_str!("../shaders/original_reset.wgsl")],
    &[Uniform, ReadWrite, ReadWrite, ReadWrite],
);

static BIN_COUNT: Source = Source::new(
    "bin_count",
    &[BIN_TILES, BIN_SEGMENTS, include_str!("../shaders/bin_count.wgsl")],
    &[Uniform, Uniform, Read, Read, Read, ReadWrite, ReadWrite],
)
.segmented();

static BIN_SCAN: Source = Source::new(
    "bin_scan",
    &[BIN_SEGMENTS, include_str!("../shaders/bin_scan.wgsl")],
    &[Uniform, ReadWrite, Read, ReadWrite, ReadWrite],
)
.segmented();

static BIN_EMIT: Source = Source::new(
    "bin_emit",
    &[BIN_TILES, include_str!("../shaders/bin_emit.wgsl")],
    &[Uniform, Uniform, Read, Read, Read, Read, ReadWrite, ReadWrite, ReadWrite],
);

static BIN_SORT: Source =
    Source::new("bin_sort", &[SORT_KEYS, include_str!("../shaders/bin_sort.wgsl")], &SORT_BINDINGS)
        .segmented();

static BIN_SORT_WIDE: Source = Source::new(
    "bin_sort_wide",
    &[SORT_KEYS, include_str!("../shaders/bin_sort_wide.wgsl")],
    &SORT_BINDINGS,
)
.segmented();

static BIN_RANGES: Source = Source::new(
    "bin_ranges",
    &[include_str!("../shaders/bin_ranges.wgsl")],
    &[Uniform, Read, Read, Read, Read, ReadWrite, ReadWrite],
);

static RASTERIZE: Source = Source::new(
    "rasterize",
    &[TILE_LIST, include_str!("../shaders/rasterize.wgsl")],
    &[Uniform, Uniform, Read, Read, Read, ReadWrite, ReadWrite],
)
.with_tile_work(TILE_WORK)
.with_gpu_parts(&[
    TILE_LIST,
    BIN_TILES,
    TILE_BLOCKS,
    include_str!("../shaders/rasterize_blocks.wgsl"),
]);

static RASTERIZE_BACKWARD: Source = Source::new(
    "rasterize_backward",
    &[SIGNED, BACKWARD_PIXELS, TILE_LIST, BACKWARD],
    &BACKWARD_BINDINGS,
)
.with_tile_work(TILE_SUMS)
.with_gpu_parts(&[SIGNED, BACKWARD_PIXELS, TILE_LIST, BIN_TILES, TILE_BLOCKS, BACKWARD_BLOCKS]);

static RASTERIZE_BACKWARD_ABSOLUTE: Source = Source::new(
    "rasterize_backward_absolute",
    &[ABSOLUTE, BACKWARD_PIXELS, TILE_LIST, BACKWARD],
    &BACKWARD_BINDINGS,
)
.with_tile_work(TILE_SUMS)
.with_gpu_parts(&[ABSOLUTE, BACKWARD_PIXELS, TILE_LIST, BIN_TILES, TILE_BLOCKS, BACKWARD_BLOCKS]);

static RASTERIZE_BACKWARD_SUM: Source =
    Source::new("rasterize_backward_sum", &[SIGNED, BACKWARD_SUM], &BACKWARD_SUM_BINDINGS);

static RASTERIZE_BACKWARD_SUM_ABSOLUTE: Source = Source::new(
    "rasterize_backward_sum_absolute",
    &[ABSOLUTE, BACKWARD_SUM],
    &BACKWARD_SUM_BINDINGS,
);

static EXPOSURE: Source = Source::new(
    "exposure",
    &[include_str!("../shaders/exposure.wgsl")],
    &[Uniform, Uniform, Read, ReadWrite, ReadWrite, ReadWrite, ReadWrite],
);

static DEPTH_LOSS: Source = Source::new(
    "depth_loss",
    &[include_str!("../shaders/depth_loss.wgsl")],
    &[Uniform, Uniform, Read, Read, Read, ReadWrite, ReadWrite, ReadWrite],
);

static LOSS: Source =
    Source::new("loss", &[LOSS_PIXELS, include_str!("../shaders/loss.wgsl")], &LOSS_BINDINGS);

static LOSS_LINES: Source = Source::new(
    "loss_lines",
    &[LOSS_PIXELS, include_str!("../shaders/loss_lines.wgsl")],
    &LOSS_BINDINGS,
);

static ADAM_GEOMETRY: Source = Source::new(
    "adam_geometry",
    &[ADAM_STEP, ADAM_UPDATE, ADAM_GEOMETRY_WGSL, include_str!("../shaders/adam_plain.wgsl")],
    &[Uniform, Uniform, ReadWrite, Read, ReadWrite, ReadWrite],
);

static ADAM_COLORS: Source = Source::new(
    "adam_colors",
    &[ADAM_STEP, ADAM_UPDATE, include_str!("../shaders/adam_colors.wgsl")],
    &[Uniform, Uniform, Uniform, ReadWrite, Read, ReadWrite, ReadWrite],
);
