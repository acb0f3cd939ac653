//! The size of the kernels for GPUs as SPIR-V, compiled as on a device: without checks.

use naga::back::spv;
use naga::proc::{BoundsCheckPolicies, BoundsCheckPolicy};

use super::{Compiled, compiled};

const OP_VARIABLE: u32 = 59;
const OP_LOOP_MERGE: u32 = 246;
const FUNCTION_STORAGE: u32 = 7;

/// Instructions, loops and variables of functions.
fn size(shader: &Compiled) -> [usize; 3] {
    let none = BoundsCheckPolicy::Unchecked;
    let policies =
        BoundsCheckPolicies { index: none, buffer: none, image_load: none, binding_array: none };
    let options = spv::Options {
        lang_version: (1, 0),
        // Names of variables are instructions too; a debug build would write and count them.
        flags: spv::WriterFlags::empty(),
        bounds_check_policies: policies,
        zero_initialize_workgroup_memory: spv::ZeroInitializeWorkgroupMemoryMode::None,
        force_loop_bounding: false,
        emit_int_div_checks: false,
        ..spv::Options::default()
    };
    let entry =
        spv::PipelineOptions { shader_stage: shader.stage, entry_point: shader.entry.clone() };
    let words = spv::write_vec(&shader.module, &shader.info, &options, Some(&entry))
        .unwrap_or_else(|e| panic!("{}: {e}", shader.name));
    let mut count = [0; 3];
    // Five words of header; then each instruction begins with its length and its operation.
    let mut rest = &words[5..];
    while let [first, ..] = rest {
        let (length, operation) = ((first >> 16) as usize, first & 0xffff);
        count[0] += 1;
        count[1] += usize::from(operation == OP_LOOP_MERGE);
        count[2] += usize::from(operation == OP_VARIABLE && rest[3] == FUNCTION_STORAGE);
        rest = &rest[length..];
    }
    count
}

#[test]
fn kernels_of_a_step_stay_small() {
    // Most instructions, loops and variables of functions.
    let bounds = [
        ("fit_project, GPUs, project", [2900, 3, 50]),
        ("fit_geometry, GPUs, fit_geometry", [3700, 12, 52]),
        ("bin_sort_wide, GPUs, sort_count", [450, 1, 6]),
        ("bin_sort_wide, GPUs, sort_place", [820, 7, 20]),
        ("rasterize, GPUs, rasterize", [1600, 4, 27]),
        ("loss, GPUs, loss_slopes", [900, 5, 15]),
        ("loss, GPUs, loss_gradient", [950, 5, 17]),
        ("rasterize_backward, GPUs, rasterize_backward", [2300, 7, 36]),
        ("rasterize_backward_sum, GPUs, rasterize_backward_sum", [780, 4, 12]),
    ];
    let shaders = compiled();
    for (name, most) in bounds {
        let shader = shaders.iter().find(|shader| shader.name == name).expect(name);
        let found = size(shader);
        println!("{name}: {found:?}, at most {most:?}");
        for (has, most) in found.iter().zip(most) {
            assert!(*has <= most, "{name}: {found:?}, at most {most:?}");
        }
    }
}
