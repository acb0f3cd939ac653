//! antimatter15's `.splat`: 32 bytes a splat and no header.
//!
//! Position and scale as floats, color and opacity as bytes, rotation wxyz as bytes.

use super::bytes::{Named, f32_at};
use super::prepare::{Room, prepare, say_clipped, unfit};
use super::quantize::{color_of_dc, dc_of_color, logit_of_byte, opacity_byte, to_f64, unit_byte};
use super::{Format, Loaded, SplatFile};
use crate::error::Result;
use crate::splats::SplatArrays;

const ROW: usize = 32;
const ROOM: Room = Room { name: ".splat", sh_degree: 0, origin: false, antialiased: false };

pub fn parse(bytes: &[u8], named: &Named<'_>) -> Result<Loaded> {
    let (rows, rest) = bytes.as_chunks::<ROW>();
    if !rest.is_empty() {
        return Err(named.bad(format!(
            "is {} bytes, not a multiple of the {ROW} of a splat; it is truncated or not a .splat",
            bytes.len()
        )));
    }
    let mut splats = SplatArrays::zeros(rows.len(), 0);
    for (i, row) in rows.iter().enumerate() {
        splats.means[i] = std::array::from_fn(|k| f32_at(row, 4 * k));
        splats.scales[i] = std::array::from_fn(|k| log_scale(f32_at(row, 12 + 4 * k)));
        splats.sh[i] = std::array::from_fn(|c| dc_of_color(f64::from(row[24 + c]) / 255.0));
        splats.opacities[i] = logit_of_byte(row[27]);
        splats.quats[i] = std::array::from_fn(|k| (f32::from(row[28 + k]) - 128.0) / 128.0);
    }
    Ok(Loaded {
        file: SplatFile { splats, ..SplatFile::default() },
        format: Format::Splat,
        notes: Vec::new(),
    })
}

/// The logarithm of a scale; a scale of 0 becomes the least above it.
pub fn log_scale(scale: f32) -> f32 {
    if scale == 0.0 { f32::MIN_POSITIVE.ln() } else { scale.ln() }
}

/// The scale of a logarithm, finite whatever that is.
pub fn linear_scale(log: f32) -> f32 {
    f64::from(log).exp().min(f64::from(f32::MAX)) as f32
}

pub fn encode(file: &SplatFile, notes: &mut Vec<String>) -> Result<Vec<u8>> {
    let splats = prepare(file, &ROOM, notes);
    if splats.is_empty() {
        return Err(unfit("no splats are left to write, and the .splat would be an empty file"));
    }
    let mut out = Vec::with_capacity(ROW * splats.len());
    let mut clipped = 0;
    for i in 0..splats.len() {
        let scale = splats.scales[i].map(linear_scale);
        for value in splats.means[i].into_iter().chain(scale) {
            out.extend(value.to_le_bytes());
        }
        let rgb = splats.sh[i].map(color_of_dc);
        clipped += usize::from(rgb.iter().any(|c| !(0.0..=1.0).contains(c)));
        out.extend(rgb.map(unit_byte));
        out.push(opacity_byte(splats.opacities[i]));
        let quat = to_f64(splats.quats[i]);
        let norm = quat.iter().map(|c| c * c).sum::<f64>().sqrt();
        // `as` saturates: 1 becomes 255.
        out.extend(quat.map(|c| (c / norm * 128.0 + 128.0).round() as u8));
    }
    say_clipped(notes, clipped, "color", "0 to 1");
    Ok(out)
}
