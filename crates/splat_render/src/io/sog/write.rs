//! Writing a `.sog`, or the folder that it is a zip of.

use std::path::Path;

use super::codebook::{codebook, nearest};
use super::images::{Image, webp, zipped};
use super::meta::{Coded, Meta, Rest};
use super::palette::palette;
use super::{META, PALETTE_COLUMNS, ROTATION_TAG, SH_DEGREE};
use crate::error::{Error, Result};
use crate::io::SplatFile;
use crate::io::prepare::{Room, prepare, unfit};
use crate::io::quantize::{SmallestThree, opacity_byte, to_f64, unit_byte};
use crate::morton::morton_order;
use crate::splats::SplatArrays;

const ROOM: Room = Room { name: ".sog", sh_degree: SH_DEGREE, origin: false, antialiased: true };

/// Splats per row of the palette in large scenes: its image is then about as large as another.
const SPLATS_PER_ROW: usize = 8;
/// Rows that any scene may have.
const ROWS_FREE: usize = 1024;

const MEANS: [&str; 2] = ["means_l.webp", "means_u.webp"];
const QUATS: &str = "quats.webp";
const SCALES: &str = "scales.webp";
const SH0: &str = "sh0.webp";
const CENTROIDS: &str = "shN_centroids.webp";
const LABELS: &str = "shN_labels.webp";

/// The whole file. Splats are put in Morton's order: images of neighbors compress better.
pub fn encode(file: &SplatFile, notes: &mut Vec<String>) -> Result<Vec<u8>> {
    let prepared = prepare(file, &ROOM, notes);
    let splats = prepared.select(&morton_order(&prepared.means));
    let files = files(&splats, file.antialiased)?;
    // Writing to memory does not fail.
    zipped(&files).map_err(|e| unfit(&format!("cannot be zipped ({e})")))
}

/// Writes a SOG into an existing folder. Splats keep their order; all are finite, degree at most 3.
pub fn write_folder(folder: &Path, splats: &SplatArrays, antialiased: bool) -> Result<()> {
    for (name, bytes) in files(splats, antialiased)? {
        let path = folder.join(name);
        std::fs::write(&path, bytes)
            .map_err(|e| Error::file(&path, format!("cannot be written ({e})")))?;
    }
    Ok(())
}

/// The files by name, `meta.json` last.
fn files(splats: &SplatArrays, antialiased: bool) -> Result<Vec<(&'static str, Vec<u8>)>> {
    let stride = splats.stride();
    let mut images: Vec<(&'static str, Image)> = Vec::new();

    let (low, high) = bounds(splats);
    let mut means = [Image::square(splats.len()), Image::square(splats.len())];
    for (i, mean) in splats.means.iter().enumerate() {
        for k in 0..3 {
            let place = (signed_ln(mean[k]) - low[k]) / (high[k] - low[k]);
            // 0 / 0 becomes 0: all lie in one plane.
            let place = ((place * 65535.0).round() as u16).to_le_bytes();
            means[0].rgba[i][k] = place[0];
            means[1].rgba[i][k] = place[1];
        }
        means[0].rgba[i][3] = 255;
        means[1].rgba[i][3] = 255;
    }
    let [means_low, means_high] = means;
    images.push((MEANS[0], means_low));
    images.push((MEANS[1], means_high));

    let mut quats = Image::square(splats.len());
    for (pixel, quat) in quats.rgba.iter_mut().zip(&splats.quats) {
        let three = SmallestThree::of(to_f64(*quat));
        let [r, g, b] = three.others.map(|c| unit_byte(c / std::f64::consts::SQRT_2 + 0.5));
        *pixel = [r, g, b, ROTATION_TAG + three.largest as u8];
    }
    images.push((QUATS, quats));

    let scales_codebook = codebook(splats.scales.as_flattened().iter().copied());
    let mut scales = Image::square(splats.len());
    for (pixel, scale) in scales.rgba.iter_mut().zip(&splats.scales) {
        let [r, g, b] = scale.map(|s| nearest(&scales_codebook, s));
        *pixel = [r, g, b, 255];
    }
    images.push((SCALES, scales));

    let sh0_codebook = codebook(splats.sh.iter().step_by(stride).flatten().copied());
    let mut sh0 = Image::square(splats.len());
    for (i, dc) in splats.sh.iter().step_by(stride).enumerate() {
        let [r, g, b] = dc.map(|c| nearest(&sh0_codebook, c));
        sh0.rgba[i] = [r, g, b, opacity_byte(splats.opacities[i])];
    }
    images.push((SH0, sh0));

    let rest = (stride > 1 && !splats.is_empty()).then(|| pack_rest(splats, &mut images));
    let meta = Meta {
        count: splats.len() as u64,
        antialiased,
        low,
        high,
        means: MEANS.map(String::from),
        scales: Coded { codebook: scales_codebook, image: SCALES.into() },
        quats: QUATS.into(),
        sh0: Coded { codebook: sh0_codebook, image: SH0.into() },
        rest,
    };
    let mut files = Vec::new();
    for (name, image) in &images {
        let bytes = webp(image).ok_or_else(|| {
            unfit(&format!("a .sog holds at most 16384 x 16384 splats, not {}", splats.len()))
        })?;
        files.push((*name, bytes));
    }
    files.push((META, meta.write().into_bytes()));
    Ok(files)
}

fn pack_rest(splats: &SplatArrays, images: &mut Vec<(&'static str, Image)>) -> Rest {
    let stride = splats.stride();
    let each = stride - 1;
    let vectors: Vec<f32> = splats
        .sh
        .chunks_exact(stride)
        .flat_map(|row| row[1..].as_flattened().iter().copied())
        .collect();
    let rows_max = (splats.len() / SPLATS_PER_ROW).max(ROWS_FREE);
    let palette = palette(&vectors, 3 * each, rows_max);
    let codebook = codebook(palette.rows.iter().copied());
    let count = palette.rows.len() / (3 * each);
    let mut centroids = Image::new(PALETTE_COLUMNS * each, count * each);
    for (pixel, rgb) in centroids.rgba.iter_mut().zip(palette.rows.chunks_exact(3)) {
        let [r, g, b] = std::array::from_fn(|c| nearest(&codebook, rgb[c]));
        *pixel = [r, g, b, 255];
    }
    let mut labels = Image::square(splats.len());
    for (pixel, label) in labels.rgba.iter_mut().zip(&palette.labels) {
        let [low, high] = label.to_le_bytes();
        *pixel = [low, high, 0, 255];
    }
    images.push((CENTROIDS, centroids));
    images.push((LABELS, labels));
    Rest {
        count,
        degree: splats.sh_degree,
        codebook,
        centroids: CENTROIDS.into(),
        labels: LABELS.into(),
    }
}

/// sign(x) ln(|x| + 1).
fn signed_ln(x: f32) -> f64 {
    let x = f64::from(x);
    x.signum() * x.abs().ln_1p()
}

/// Bounds of the positions' signed logarithms; zero without splats.
fn bounds(splats: &SplatArrays) -> ([f64; 3], [f64; 3]) {
    let fold = |start: f64, pick: fn(f64, f64) -> f64| {
        std::array::from_fn(|k| {
            let bound = splats.means.iter().fold(start, |b, mean| pick(b, signed_ln(mean[k])));
            if bound.is_finite() { bound } else { 0.0 }
        })
    };
    (fold(f64::INFINITY, f64::min), fold(f64::NEG_INFINITY, f64::max))
}
