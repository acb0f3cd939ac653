//! Writes pictures: PNG as shown, EXR with alpha and depth.

use std::path::Path;

use splat_render::io::{self, ExrPicture, write_atomically};
use splat_render::{Image, Result};

/// Writes RGB bytes as a PNG, whole or not at all.
pub fn write_png(path: &Path, [width, height]: [u32; 2], rgb: &[u8]) -> Result<()> {
    write_atomically(path, |out| {
        let mut encoder = png::Encoder::new(out, width, height);
        encoder.set_color(png::ColorType::Rgb);
        encoder.set_depth(png::BitDepth::Eight);
        // By this, igsr does not take it for a photo.
        let tag = encoder.add_text_chunk("Software".to_owned(), "igsr render".to_owned());
        tag.map_err(std::io::Error::other)?;
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

/// Writes R, G, B (not linear light), A, and the expected depth Z, 0 for empty pixels.
pub fn write_exr(path: &Path, image: &Image<f32>) -> Result<()> {
    let expected = |(&depth, &alpha): (&f32, &f32)| if alpha > 0.0 { depth / alpha } else { 0.0 };
    let depth: Vec<f32> = image.depth.iter().zip(&image.alpha).map(expected).collect();
    io::write_exr(
        path,
        &ExrPicture {
            width: image.width as usize,
            height: image.height as usize,
            color: &image.color,
            alpha: &image.alpha,
            depth: &depth,
        },
    )
}
