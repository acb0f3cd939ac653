//! Renders as OpenEXR files: 32-bit floats, ZIP-compressed without loss.

use std::io::{Cursor, Write};
use std::path::Path;

use ::exr::prelude::{
    AnyChannel, AnyChannels, Encoding, FlatSamples, Image, Layer, LayerAttributes, SmallVec,
    WritableImage,
};

use super::atomic::write_atomically;
use crate::error::{Error, Result};

/// A picture with alpha and depth, row-major, `H * W` pixels each.
#[derive(Debug, Clone, Copy)]
pub struct ExrPicture<'a> {
    /// Width in pixels.
    pub width: usize,
    /// Height in pixels.
    pub height: usize,
    /// `[H * W]` RGB, as rendered (not linear light): channels R, G and B.
    pub color: &'a [[f32; 3]],
    /// `[H * W]` in 0..1: channel A.
    pub alpha: &'a [f32],
    /// `[H * W]` camera-space z in world units, 0 for empty pixels: channel Z.
    pub depth: &'a [f32],
}

/// Writes a picture as an EXR file of one layer with the channels A, B, G, R, Z, whole or not at all.
pub fn write_exr(path: &Path, picture: &ExrPicture<'_>) -> Result<()> {
    let bytes = encode_exr(picture)?;
    write_atomically(path, |out| out.write_all(&bytes))
}

/// The bytes of such a file.
pub fn encode_exr(picture: &ExrPicture<'_>) -> Result<Vec<u8>> {
    let ExrPicture { width, height, color, alpha, depth } = *picture;
    let pixels = width.checked_mul(height).filter(|&pixels| pixels > 0).ok_or_else(|| {
        Error::argument("width, height", format!("must be positive, got {width} x {height}"))
    })?;
    let lengths = [("color", color.len()), ("alpha", alpha.len()), ("depth", depth.len())];
    for (name, length) in lengths {
        if length != pixels {
            return Err(Error::argument(
                name,
                format!("has {length} pixels, but the picture has {width} x {height}"),
            ));
        }
    }
    let plane = |c: usize| color.iter().map(|rgb| rgb[c]).collect::<Vec<f32>>();
    let channels: SmallVec<[AnyChannel<FlatSamples>; 4]> = [
        ("A", alpha.to_vec()),
        ("B", plane(2)),
        ("G", plane(1)),
        ("R", plane(0)),
        ("Z", depth.to_vec()),
    ]
    .into_iter()
    .map(|(name, samples)| AnyChannel::new(name, FlatSamples::F32(samples)))
    .collect();
    let layer = Layer::new(
        (width, height),
        LayerAttributes::default(),
        Encoding::SMALL_LOSSLESS,
        AnyChannels::sort(channels),
    );
    let mut bytes = Cursor::new(Vec::new());
    Image::from_layer(layer)
        .write()
        .to_buffered(&mut bytes)
        .map_err(|e| Error::argument("picture", format!("cannot be written as EXR ({e})")))?;
    Ok(bytes.into_inner())
}
