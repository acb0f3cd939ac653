//! The zip and the WebP images in it.

use std::io::{Cursor, Read, Write};

use image_webp::{ColorType, WebPDecoder, WebPEncoder};
use zip::write::SimpleFileOptions;
use zip::{CompressionMethod, ZipArchive, ZipWriter};

use super::META;
use crate::error::Result;
use crate::io::bytes::Named;
use crate::io::limits::unpacked_max;

/// Pixels that an image may have beyond those that are used: writers round sizes up.
const SPARE_PIXELS: u64 = 1 << 16;

/// Longest meta.json that is read: real ones are 20 kB, and JSON takes many times its text.
const META_MAX: u64 = 1 << 20;

/// The zip of a `.sog`.
pub struct Bundle<'a> {
    zip: ZipArchive<Cursor<&'a [u8]>>,
    /// Bytes that an entry may unpack to.
    limit: u64,
    named: Named<'a>,
}

impl<'a> Bundle<'a> {
    /// Opens the zip in `bytes`.
    pub fn open(bytes: &'a [u8], named: &Named<'a>) -> Result<Self> {
        let zip = ZipArchive::new(Cursor::new(bytes)).map_err(|e| {
            named.bad(format!("cannot be opened as the zip that a .sog is ({e}); copy it again"))
        })?;
        Ok(Self { zip, limit: unpacked_max(bytes.len()), named: *named })
    }

    /// The text of `meta.json`.
    pub fn meta(&mut self) -> Result<Vec<u8>> {
        self.file(META, META_MAX)
    }

    /// The first `limit` bytes of the file `name`.
    fn file(&mut self, name: &str, limit: u64) -> Result<Vec<u8>> {
        let damaged = |e: &dyn std::fmt::Display| {
            self.named.bad(format!("has no readable '{name}' in it ({e}); export it again"))
        };
        let entry = self.zip.by_name(name).map_err(|e| damaged(&e))?;
        let mut bytes = Vec::new();
        entry.take(limit).read_to_end(&mut bytes).map_err(|e| damaged(&e))?;
        Ok(bytes)
    }

    /// The image `name`, which is to have at least `used` pixels, or more by a little.
    pub fn image(&mut self, name: &str, used: usize) -> Result<Image> {
        let bytes = self.file(name, self.limit)?;
        let damaged = |e: &dyn std::fmt::Display| {
            self.named
                .bad(format!("has an image '{name}' that cannot be read ({e}); export it again"))
        };
        let mut webp = WebPDecoder::new(Cursor::new(&bytes)).map_err(|e| damaged(&e))?;
        let (width, height) = webp.dimensions();
        let pixels = u64::from(width) * u64::from(height);
        let used = used as u64;
        if pixels < used || pixels > 2 * used + SPARE_PIXELS {
            return Err(self.named.bad(format!(
                "has an image '{name}' of {width}x{height} pixels where {used} are used; it is \
                 damaged"
            )));
        }
        let channels = if webp.has_alpha() { 4 } else { 3 };
        let mut raw = vec![0; pixels as usize * channels];
        webp.read_image(&mut raw).map_err(|e| damaged(&e))?;
        let rgba = match raw.as_chunks::<4>() {
            (rgba, []) if channels == 4 => rgba.to_vec(),
            _ => raw.as_chunks::<3>().0.iter().map(|&[r, g, b]| [r, g, b, 255]).collect(),
        };
        Ok(Image { width: width as usize, rgba })
    }
}

/// Pixels.
pub struct Image {
    /// Pixels per row.
    pub width: usize,
    /// All pixels, the top row first.
    pub rgba: Vec<[u8; 4]>,
}

impl Image {
    /// An image of `width` with room for `used` black, transparent pixels.
    pub fn new(width: usize, used: usize) -> Self {
        let height = used.div_ceil(width).max(1);
        Self { width, rgba: vec![[0; 4]; width * height] }
    }

    /// An image about as high as wide, with room for `used` pixels.
    pub fn square(used: usize) -> Self {
        // A multiple of 4, as the format's own writers have it.
        let width = (used as f64).sqrt().ceil() as usize;
        Self::new(width.div_ceil(4).max(1) * 4, used)
    }
}

/// Zips files whose names and contents are given; images are compressed as they are.
pub fn zipped(files: &[(&str, Vec<u8>)]) -> std::io::Result<Vec<u8>> {
    let mut zip = ZipWriter::new(Cursor::new(Vec::new()));
    let stored = SimpleFileOptions::default().compression_method(CompressionMethod::Stored);
    for (name, bytes) in files {
        zip.start_file(*name, stored)?;
        zip.write_all(bytes)?;
    }
    Ok(zip.finish()?.into_inner())
}

/// The bytes of an image as lossless WebP; None if a side is beyond WebP's 16 384 pixels.
pub fn webp(image: &Image) -> Option<Vec<u8>> {
    let width = u32::try_from(image.width).ok()?;
    let height = u32::try_from(image.rgba.len() / image.width).ok()?;
    let mut bytes = Vec::new();
    WebPEncoder::new(&mut bytes)
        .encode(image.rgba.as_flattened(), width, height, ColorType::Rgba8)
        .ok()?;
    Some(bytes)
}
