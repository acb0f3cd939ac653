//! Reading a `.sog`.

use super::images::Bundle;
use super::meta::{Meta, Rest};
use super::{PALETTE_COLUMNS, ROTATION_TAG};
use crate::error::Result;
use crate::io::bytes::Named;
use crate::io::limits::{check_claim, check_file_size};
use crate::io::quantize::{SmallestThree, logit_of_byte, to_f32};
use crate::io::{Format, Loaded, SplatFile};
use crate::splats::SplatArrays;

pub fn parse(bytes: &[u8], named: &Named<'_>) -> Result<Loaded> {
    let mut bundle = Bundle::open(bytes, named)?;
    let meta = Meta::read(&bundle.meta()?, named)?;
    unpack(&meta, &mut bundle, bytes.len(), named)
}

/// Reads a `meta.json` and the images next to it.
pub fn parse_folder(named: &Named<'_>) -> Result<Loaded> {
    let mut bundle = Bundle::beside(named);
    let meta = Meta::read(&bundle.meta()?, named)?;
    let size = bundle.size_of(meta.files())?;
    check_file_size(named, size)?;
    unpack(&meta, &mut bundle, size as usize, named)
}

/// The splats in images that take `size` bytes.
fn unpack(meta: &Meta, bundle: &mut Bundle<'_>, size: usize, named: &Named<'_>) -> Result<Loaded> {
    let degree = meta.rest.as_ref().map_or(0, |rest| rest.degree);
    let n = check_claim(named, meta.count, degree, size)?;
    let mut splats = SplatArrays::zeros(n, degree);
    let stride = splats.stride();

    let low = bundle.image(&meta.means[0], n)?;
    let high = bundle.image(&meta.means[1], n)?;
    for (i, mean) in splats.means.iter_mut().enumerate() {
        *mean = std::array::from_fn(|k| {
            let place = u16::from_le_bytes([low.rgba[i][k], high.rgba[i][k]]);
            let unit = f64::from(place) / 65535.0;
            let signed = meta.low[k] + (meta.high[k] - meta.low[k]) * unit;
            signed_exp(signed) as f32
        });
    }
    let scales = bundle.image(&meta.scales.image, n)?;
    let quats = bundle.image(&meta.quats, n)?;
    let sh0 = bundle.image(&meta.sh0.image, n)?;
    for i in 0..n {
        let [r, g, b, _] = scales.rgba[i];
        splats.scales[i] = [r, g, b].map(|code| meta.scales.codebook[usize::from(code)]);
        let [r, g, b, opacity] = sh0.rgba[i];
        splats.sh[i * stride] = [r, g, b].map(|code| meta.sh0.codebook[usize::from(code)]);
        splats.opacities[i] = logit_of_byte(opacity);
        let [r, g, b, tag] = quats.rgba[i];
        let largest = tag.checked_sub(ROTATION_TAG).ok_or_else(|| {
            named.bad(format!(
                "has a rotation tagged {tag}, but only 252 to 255 are known; it is damaged"
            ))
        })?;
        let others = [r, g, b].map(|c| (f64::from(c) / 255.0 - 0.5) * std::f64::consts::SQRT_2);
        let three = SmallestThree { largest: usize::from(largest), others };
        splats.quats[i] = to_f32(three.quat());
    }
    if let Some(rest) = &meta.rest {
        unpack_rest(&mut splats, rest, bundle, named)?;
    }
    Ok(Loaded {
        file: SplatFile { splats, antialiased: meta.antialiased, ..SplatFile::default() },
        format: Format::Sog,
        notes: Vec::new(),
    })
}

fn unpack_rest(
    splats: &mut SplatArrays,
    rest: &Rest,
    bundle: &mut Bundle<'_>,
    named: &Named<'_>,
) -> Result<()> {
    let (n, stride) = (splats.len(), splats.stride());
    let each = stride - 1;
    let labels = bundle.image(&rest.labels, n)?;
    let used = rest.count.div_ceil(PALETTE_COLUMNS) * PALETTE_COLUMNS * each;
    let palette = bundle.image(&rest.centroids, used)?;
    if palette.width != PALETTE_COLUMNS * each {
        return Err(named.bad(format!(
            "has a palette {} pixels wide, but SH of degree {} take {}; it is damaged",
            palette.width,
            rest.degree,
            PALETTE_COLUMNS * each
        )));
    }
    for i in 0..n {
        let label = usize::from(u16::from_le_bytes([labels.rgba[i][0], labels.rgba[i][1]]));
        if label >= rest.count {
            return Err(named.bad(format!(
                "has a splat with row {label} of a palette of {}; it is damaged",
                rest.count
            )));
        }
        // Rows of the image hold PALETTE_COLUMNS consecutive entries, as in memory.
        let row = &palette.rgba[label * each..][..each];
        for (k, [r, g, b, _]) in row.iter().enumerate() {
            splats.sh[i * stride + 1 + k] =
                [*r, *g, *b].map(|code| rest.codebook[usize::from(code)]);
        }
    }
    Ok(())
}

/// The inverse of sign(x) ln(|x| + 1).
fn signed_exp(x: f64) -> f64 {
    x.signum() * x.abs().exp_m1()
}
