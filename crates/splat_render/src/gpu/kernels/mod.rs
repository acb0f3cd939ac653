//! The kernels with their bindings, and the WGSL that they are compiled from.

mod constants;
mod table;
#[cfg(test)]
mod tests;

use constants::constants;
pub(super) use table::Kernel;

use crate::constants::TILE;
use crate::gpu::layout::{SUM_ROWS, SUM_SETS};

/// Declarations and functions at the start of every shader.
const SHARED: &str = include_str!("../shaders/shared.wgsl");

/// How a shader uses a binding.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Access {
    Uniform,
    Read,
    Write,
}

/// The kinds of adapters that shaders are built for.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Build {
    Gpu,
    /// A software adapter on which a tile's threads are one subgroup and share data through it.
    SoftwareSubgroups,
    Software,
}

/// Pixel rows per thread of the rasterize kernels for software adapters: many, because each read of a splat
/// takes long.
const ROWS: u32 = 8;
/// Threads of a tile in these kernels.
pub(super) const SOFTWARE_THREADS: u32 = TILE * TILE / 4 / ROWS;

/// As bin_sort_wide.wgsl has it.
const _: () = assert!(Build::Gpu.segments() == 256 && SUM_SETS * SUM_ROWS <= 256);

impl Build {
    pub const ALL: [Self; 3] = [Self::Gpu, Self::SoftwareSubgroups, Self::Software];

    pub const fn is_gpu(self) -> bool {
        matches!(self, Self::Gpu)
    }

    pub const fn subgroups(self) -> bool {
        matches!(self, Self::SoftwareSubgroups)
    }

    /// Bits that a pass of the sort takes.
    pub const fn digit_bits(self) -> u32 {
        if self.is_gpu() { 8 } else { 4 }
    }

    /// Workgroups per scan or sort: a few per core on a CPU, many on a GPU.
    pub const fn segments(self) -> u32 {
        if self.is_gpu() { 256 } else { 16 }
    }
}

/// A WGSL source: its texts, and its bindings in the order of their numbers.
#[derive(Debug)]
pub(super) struct Source {
    pub name: &'static str,
    pub bindings: &'static [Access],
    /// Texts after [`SHARED`].
    parts: &'static [&'static str],
    /// Text for cooperating threads of a tile: for any device, and for tiles that are subgroups.
    tile_work: Option<[&'static str; 2]>,
    /// Texts in place of both on GPUs.
    gpu_parts: Option<&'static [&'static str]>,
    /// Whether the source has the override `SEGMENTS`.
    segmented: bool,
}

/// WGSL declarations such as `Splat2d`, for callers that draw from the kernels' buffers.
pub fn shared_wgsl() -> String {
    constants() + SHARED
}

/// Every source once.
fn sources() -> impl Iterator<Item = &'static Source> {
    let of_kernel = |i: usize| Kernel::ALL[i].source();
    let is_first = move |&i: &usize| i == 0 || of_kernel(i - 1).name != of_kernel(i).name;
    (0..Kernel::ALL.len()).filter(is_first).map(of_kernel)
}

/// A shader as one kind of adapter compiles it.
#[derive(Debug, Clone)]
pub struct ShaderVariant {
    /// Source and build.
    pub name: String,
    /// The WGSL.
    pub text: String,
    /// Whether it needs subgroup operations.
    pub subgroups: bool,
    /// Values of its pipeline-overridable constants.
    pub constants: Vec<(&'static str, f64)>,
}

/// Every shader in every variant, for tests that translate them to the drivers' languages.
pub fn shader_variants() -> impl Iterator<Item = ShaderVariant> {
    Build::ALL.into_iter().flat_map(|build| {
        sources().map(move |source| ShaderVariant {
            name: format!(
                "{}, {}{}",
                source.name,
                if build.is_gpu() { "GPUs" } else { "software" },
                if build.subgroups() { ", subgroups" } else { "" }
            ),
            text: source.text(build),
            subgroups: build.subgroups(),
            constants: source.constants(build),
        })
    })
}

/// Repeats every line that contains `{row}` once for each of [`ROWS`].
fn repeat_rows(text: &str) -> String {
    let mut out = String::with_capacity(2 * text.len());
    for line in text.split_inclusive('\n') {
        if line.contains("{row}") && !line.trim_start().starts_with("//") {
            (0..ROWS).for_each(|row| out.push_str(&line.replace("{row}", &row.to_string())));
        } else {
            out.push_str(line);
        }
    }
    out
}

impl Source {
    const fn new(
        name: &'static str,
        parts: &'static [&'static str],
        bindings: &'static [Access],
    ) -> Self {
        Self { name, bindings, parts, tile_work: None, gpu_parts: None, segmented: false }
    }

    const fn with_tile_work(self, texts: [&'static str; 2]) -> Self {
        Self { tile_work: Some(texts), ..self }
    }

    const fn with_gpu_parts(self, parts: &'static [&'static str]) -> Self {
        Self { gpu_parts: Some(parts), ..self }
    }

    const fn segmented(self) -> Self {
        Self { segmented: true, ..self }
    }

    pub fn text(&self, build: Build) -> String {
        let mut text = constants();
        let gpu_parts = self.gpu_parts.filter(|_| build.is_gpu());
        if let (Some(texts), None) = (self.tile_work, gpu_parts) {
            text.push_str(texts[usize::from(build.subgroups())]);
        }
        text.push_str(SHARED);
        for part in gpu_parts.unwrap_or(self.parts) {
            text.push_str(&repeat_rows(part));
        }
        text
    }

    pub fn constants(&self, build: Build) -> Vec<(&'static str, f64)> {
        if self.segmented { vec![("SEGMENTS", f64::from(build.segments()))] } else { Vec::new() }
    }
}
