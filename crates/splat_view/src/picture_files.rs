//! Writes pictures: PNG as shown, EXR with alpha and depth.

use std::path::Path;

use exr::prelude::{
    AnyChannel, AnyChannels, Encoding, FlatSamples, Layer, LayerAttributes, SmallVec, WritableImage,
};
use splat_render::io::write_atomically;
use splat_render::{Error, Image, Result};

/// Writes RGB bytes as a PNG, whole or not at all.
pub fn write_png(path: &Path, [width, height]: [u32; 2], rgb: &[u8]) -> Result<()> {
    write_atomically(path, |out| {
        let mut encoder = png::Encoder::new(out, width, height);
        encoder.set_color(png::ColorType::Rgb);
        encoder.set_depth(png::BitDepth::Eight);
        let mut writer = encoder.write_header().map_err(std::io::Error::other)?;
        writer.write_image_data(rgb).map_err(std::io::Error::other)?;
        writer.finish().map_err(std::io::Error::other)
    })
}

/// Drops alpha: RGBA bytes to RGB bytes.
pub fn without_alpha(rgba: &[u8]) -> Vec<u8> {
    rgba.chunks_exact(4).flat_map(|p| [p[0], p[1], p[2]]).collect()
}

/// A rendered picture as RGB bytes, rounded.
pub fn to_bytes(image: &Image<f32>) -> Vec<u8> {
    let byte = |v: &f32| (v.clamp(0.0, 1.0) * 255.0).round() as u8;
    image.color.iter().flatten().map(byte).collect()
}

/// Writes a rendered picture: R, G, B over the background as in the PNG (not linear light), A, and the
/// expected depth Z in world units, 0 where nothing is.
pub fn write_exr(path: &Path, image: &Image<f32>) -> Result<()> {
    let color = |c: usize| image.color.iter().map(|p| p[c]).collect::<Vec<f32>>();
    let depth = |(&depth, &alpha): (&f32, &f32)| if alpha > 0.0 { depth / alpha } else { 0.0 };
    let channels = [
        ("A", image.alpha.clone()),
        ("B", color(2)),
        ("G", color(1)),
        ("R", color(0)),
        ("Z", image.depth.iter().zip(&image.alpha).map(depth).collect()),
    ];
    let list: SmallVec<[AnyChannel<FlatSamples>; 4]> = channels
        .into_iter()
        .map(|(name, samples)| AnyChannel::new(name, FlatSamples::F32(samples)))
        .collect();
    let layer = Layer::new(
        (image.width as usize, image.height as usize),
        LayerAttributes::default(),
        Encoding::SMALL_LOSSLESS,
        AnyChannels::sort(list),
    );
    let mut bytes = std::io::Cursor::new(Vec::new());
    exr::prelude::Image::from_layer(layer)
        .write()
        .to_buffered(&mut bytes)
        .map_err(|e| Error::file(path, format!("cannot be written as EXR ({e})")))?;
    write_atomically(path, |out| std::io::Write::write_all(out, bytes.get_ref()))
}
