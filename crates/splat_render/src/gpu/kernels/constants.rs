//! The crate's constants as WGSL.

use std::fmt::Write;

use super::ROWS;

use crate::constants::{
    ADAM, ALPHA_MAX, ALPHA_MIN, DEPTH_ALPHA, QUAT_NORM2_MIN, SH_COEFFS_MAX, SSIM_C, SSIM_WINDOW,
    TILE, TRANSMITTANCE_MIN,
};
use crate::fit_device::{
    BINS, BINS_PER_LOGIT, CELLS, COLOR_WAIT, INVERSE_GUESS, KEPT_BITS_MIN, LOG_SPLIT_SHRINK,
    LOGIT_DEAD, LOGIT_FIRST, LOGIT_FOG, LOGIT_RESET, PULL_GROW, PULL_SUM_MAX, PULL_UNITS,
    SHARES_MAX,
};
use crate::gpu::layout::{
    CAMERA, DEPTH_GROUPS, EXPOSURE_GROUPS, GEOMETRY, GRADIENT, GRADIENT_ABSOLUTE, NOTE_COLOR,
    NOTE_DIRECTION, NOTE_PULL, NOTE_SEEN, NOTE_WAITS, NOTES, SUM_ROWS,
};
use crate::sh;

/// Constants of the crate as WGSL, so that no shader repeats a value by hand.
pub(super) fn constants() -> String {
    let mut out = String::new();
    for (name, value) in [("TILE", TILE), ("GEOMETRY", GEOMETRY as u32)].into_iter().chain([
        ("ROWS", ROWS),
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
        ("SUM_ROWS", SUM_ROWS),
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
    out
}
