use std::mem::offset_of;

use super::Access::{Read, Uniform, Write as ReadWrite};
use super::*;
use crate::fit_device::FogCamera;
use crate::gpu::drawn::{CellsUniform, Rows, Scan};
use crate::gpu::layout::{
    Chunk, ChunkCount, ColorSteps, DepthStep, ExposureUniform, SortPass, Splat2d, StatusHead, Step,
    View, Window,
};
use crate::gpu::mcmc::Run;
use crate::gpu::original::RunUniform;

fn parse(source: &Source) -> naga::Module {
    let text = source.text(Build::Gpu);
    naga::front::wgsl::parse_str(&text)
        .unwrap_or_else(|e| panic!("{}: {}", source.name, e.emit_to_string(&text)))
}

#[test]
fn kernels_name_entry_points_of_their_sources() {
    let mut names: Vec<_> = sources().map(|source| source.name).collect();
    for kernel in Kernel::ALL {
        let (source, entry) = (kernel.source(), kernel.entry());
        let module = parse(source);
        assert!(
            module.entry_points.iter().any(|e| e.name == entry),
            "{} has no {entry}",
            source.name
        );
    }
    for source in sources() {
        let storage = source.bindings.iter().filter(|&&b| b != Uniform).count();
        assert!(storage <= 8, "{} binds {storage} storage buffers", source.name);
    }
    names.sort_unstable();
    let count = names.len();
    names.dedup();
    assert_eq!(names.len(), count, "a source's kernels are apart in the table");
}

#[test]
fn bindings_are_declared_as_bound() {
    for source in sources() {
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

/// The kernels are compiled without naga's bounds on loops.
#[test]
fn loops_count_to_an_end() {
    let mut loops = 0;
    for (source, build) in sources().flat_map(|source| Build::ALL.map(|build| (source, build))) {
        for line in source.text(build).lines() {
            let line = line.split("//").next().unwrap_or_default().trim();
            let words = line.split(|c: char| !c.is_alphanumeric() && c != '_');
            assert!(
                !words.clone().any(|w| ["while", "loop"].contains(&w)),
                "{}: {line}",
                source.name
            );
            if words.clone().any(|word| word == "for") {
                let parts: Vec<_> = line.split(';').collect();
                let [_, condition, step] = parts[..] else { panic!("{}: {line}", source.name) };
                let compares = ["<", "!="].iter().any(|sign| condition.contains(sign));
                let counts = ["++", "+= ", "*= ", "&= "].iter().any(|sign| step.contains(sign));
                assert!(compares && counts, "{}: {line}", source.name);
                loops += 1;
            }
        }
    }
    assert!(loops > 100, "{loops}");
}

/// Asserts a struct's members and size against naga's layout of the WGSL struct.
fn assert_layout(kernel: Kernel, name: &str, size: usize, members: &[(&str, usize)]) {
    let module = parse(kernel.source());
    let (_, ty) = module
        .types
        .iter()
        .find(|(_, t)| t.name.as_deref() == Some(name))
        .unwrap_or_else(|| panic!("{kernel:?} has no struct {name}"));
    let naga::TypeInner::Struct { members: in_wgsl, span } = &ty.inner else {
        panic!("{name} is not a struct")
    };
    let in_wgsl: Vec<_> = in_wgsl
        .iter()
        .map(|m| (m.name.as_deref().unwrap_or_default(), m.offset as usize))
        .collect();
    assert_eq!(in_wgsl, members, "{name}");
    assert_eq!(*span as usize, size, "{name}");
}

/// Calls [`assert_layout`] for Rust types whose members have the names of the WGSL struct's.
macro_rules! layouts {
    ($($kernel:ident, $type:ident as $name:literal: $($member:ident)+;)*) => {
        $(assert_layout(
            Kernel::$kernel,
            $name,
            size_of::<$type>(),
            &[$((stringify!($member), offset_of!($type, $member))),+],
        );)*
    };
}

#[test]
fn rust_and_wgsl_agree_on_layouts() {
    layouts! {
        Project, View as "View":
            world_to_camera jacobian_limits focal principal background near far blur width height tiles_x
            sh_degree sh_stride raw antialiased dropout_threshold dropout_seed compensation;
        Project, Window as "Window": first count groups_max;
        Project, Splat2d as "Splat2d": mean pq color r depth opacity radii;
        DepthKeys, Chunk as "Chunk":
            tile_begin tile_end capacity splats index is_first is_last list_begin list_end groups_max;
        ScanApply, ChunkCount as "ChunkCount": pairs total;
        SortCount, SortPass as "SortPass": shift chunk is_first sum_set;
        DepthLoss, DepthStep as "DepthStep": scale;
        Exposure, ExposureUniform as "Exposure": gain offset behind background;
        AdamColors, Step as "Step":
            means quats scales opacities sh0 sh_rest bias_first bias_second opacity_pull scale_pull noise
            noise_seed l1 ssim has_weights frozen moving;
        // WGSL pads the head of the array of steps.
        FitProject, ColorSteps as "ColorSteps": count moving steps;
        McmcWeigh, Run as "Run": splats fresh seed round cameras every color_floats zero;
        McmcWeigh, FogCamera as "FogCamera": rows focal principal size nearest unused;
        OriginalKeep, RunUniform as "OriginalRun":
            splats color_floats room seed log_split log_huge keeps_all zero;
        DensitySums, Scan as "Scan": splats round;
        DensityRows, Rows as "Rows": splats floats kind unused;
        DensityBounds, CellsUniform as "Cells": low splats scale upper;
    }
    assert_layout(
        Kernel::ScanApply,
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
