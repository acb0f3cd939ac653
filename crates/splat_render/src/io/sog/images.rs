//! The files of a SOG, in a zip or in a folder, and the WebP images among them.

use std::fs::File;
use std::io::{Cursor, Read, Write};
use std::path::{Component, Path, PathBuf};

use image_webp::{ColorType, WebPDecoder, WebPEncoder};
use zip::write::SimpleFileOptions;
use zip::{CompressionMethod, ZipArchive, ZipWriter};

use super::META;
use crate::error::{Error, Result};
use crate::io::bytes::Named;
use crate::io::limits::unpacked_max;
use crate::io::open::open_file;

/// Unused pixels that an image may have: writers round sizes up.
const SPARE_PIXELS: u64 = 1 << 16;

/// Longest meta.json that is read: real ones are 20 kB, and JSON takes many times its text.
const META_MAX: u64 = 1 << 20;

/// Location of the files.
enum Place<'a> {
    /// The zip of a `.sog`, and the bytes that an entry may unpack to.
    Zip(Box<ZipArchive<Cursor<&'a [u8]>>>, u64),
    /// The folder of a `meta.json`.
    Folder(PathBuf),
}

pub struct Bundle<'a> {
    place: Place<'a>,
    named: Named<'a>,
}

impl<'a> Bundle<'a> {
    pub fn open(bytes: &'a [u8], named: &Named<'a>) -> Result<Self> {
        let zip = ZipArchive::new(Cursor::new(bytes)).map_err(|e| {
            named.bad(format!("cannot be opened as the zip of a .sog ({e}); copy it again"))
        })?;
        Ok(Self { place: Place::Zip(Box::new(zip), unpacked_max(bytes.len())), named: *named })
    }

    /// The files next to a `meta.json`.
    pub fn beside(named: &Named<'a>) -> Self {
        let folder = named.0.parent().unwrap_or(Path::new("")).to_owned();
        Self { place: Place::Folder(folder), named: *named }
    }

    pub fn meta(&mut self) -> Result<Vec<u8>> {
        self.file(META, META_MAX)
    }

    /// Bytes that files of a folder take on the disk.
    pub fn size_of<'n>(&self, names: impl Iterator<Item = &'n str>) -> Result<u64> {
        names.map(|name| Ok(self.outside(name)?.1)).sum()
    }

    /// A file of the folder, which lies in it and nowhere else, and its size.
    fn outside(&self, name: &str) -> Result<(File, u64)> {
        let Place::Folder(folder) = &self.place else {
            return Err(unreadable(&self.named, name, &"it is in no folder"));
        };
        let mut parts = Path::new(name).components();
        if !matches!((parts.next(), parts.next()), (Some(Component::Normal(_)), None)) {
            return Err(unreadable(&self.named, name, &"it is in another folder"));
        }
        let file = open_file(&folder.join(name)).map_err(|e| unreadable(&self.named, name, &e))?;
        let size = file.metadata().map_err(|e| unreadable(&self.named, name, &e))?.len();
        Ok((file, size))
    }

    /// The first `limit` bytes of the file `name`; None means the limit for unpacked data.
    fn file(&mut self, name: &str, limit: impl Into<Option<u64>>) -> Result<Vec<u8>> {
        let (limit, named) = (limit.into(), self.named);
        let mut bytes = Vec::new();
        let read = match &mut self.place {
            Place::Zip(zip, unpacked) => match zip.by_name(name) {
                Ok(entry) => entry.take(limit.unwrap_or(*unpacked)).read_to_end(&mut bytes),
                Err(error) => return Err(unreadable(&named, name, &error)),
            },
            Place::Folder(_) => {
                let (file, size) = self.outside(name)?;
                file.take(limit.unwrap_or(size)).read_to_end(&mut bytes)
            }
        };
        read.map_err(|e| unreadable(&named, name, &e))?;
        Ok(bytes)
    }

    /// The image `name`, which is to have at least `used` pixels, or more by a little.
    pub fn image(&mut self, name: &str, used: usize) -> Result<Image> {
        let bytes = self.file(name, None)?;
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
                "has an image '{name}' of {width}x{height} pixels, but {used} are used; it is \
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

fn unreadable(named: &Named<'_>, name: &str, why: &dyn std::fmt::Display) -> Error {
    named.bad(format!("has no readable '{name}' in it ({why}); export it again"))
}

pub struct Image {
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
