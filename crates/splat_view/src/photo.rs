//! Photos of a capture: PNG and JPEG, untrusted.

use std::fs::File;
use std::io::{BufReader, Cursor, Read};
use std::path::Path;

use splat_render::{Error, Result};
use zune_jpeg::JpegDecoder;
use zune_jpeg::zune_core::colorspace::ColorSpace;
use zune_jpeg::zune_core::options::DecoderOptions;

/// Largest file that is read.
const FILE_MAX: u64 = 256 << 20;
/// Longest side that is read.
const SIDE_MAX: usize = 16_384;

/// An 8-bit picture.
#[derive(Debug, Clone)]
pub struct Photo {
    /// Width and height in pixels.
    pub size: [usize; 2],
    /// RGBA, row-major, colours not multiplied by alpha.
    pub rgba: Vec<u8>,
}

fn bytes(path: &Path) -> Result<Vec<u8>> {
    let unreadable = |e: std::io::Error| Error::file(path, format!("cannot be read ({e})"));
    let file = File::open(path).map_err(unreadable)?;
    let mut bytes = Vec::new();
    BufReader::new(file).take(FILE_MAX).read_to_end(&mut bytes).map_err(unreadable)?;
    Ok(bytes)
}

fn bad(path: &Path, what: impl std::fmt::Display) -> Error {
    Error::file(path, format!("is no PNG or JPEG that can be read ({what}); convert it to one"))
}

fn is_png(bytes: &[u8]) -> bool {
    bytes.starts_with(b"\x89PNG")
}

fn jpeg(bytes: &[u8]) -> JpegDecoder<Cursor<&[u8]>> {
    let options = DecoderOptions::default()
        .set_max_width(SIDE_MAX)
        .set_max_height(SIDE_MAX)
        .jpeg_set_out_colorspace(ColorSpace::RGBA);
    JpegDecoder::new_with_options(Cursor::new(bytes), options)
}

/// Width and height in pixels, from the file's head.
pub fn photo_size(path: &Path) -> Result<[usize; 2]> {
    let bytes = bytes(path)?;
    if is_png(&bytes) {
        let reader =
            png::Decoder::new(Cursor::new(&bytes)).read_info().map_err(|e| bad(path, e))?;
        let info = reader.info();
        return Ok([info.width as usize, info.height as usize]);
    }
    let mut decoder = jpeg(&bytes);
    decoder.decode_headers().map_err(|e| bad(path, e))?;
    let (width, height) = decoder.dimensions().ok_or_else(|| bad(path, "it has no size"))?;
    Ok([width, height])
}

/// Reads a photo.
pub fn read_photo(path: &Path) -> Result<Photo> {
    let bytes = bytes(path)?;
    if !is_png(&bytes) {
        let mut decoder = jpeg(&bytes);
        let rgba = decoder.decode().map_err(|e| bad(path, e))?;
        let (width, height) = decoder.dimensions().ok_or_else(|| bad(path, "it has no size"))?;
        return Ok(Photo { size: [width, height], rgba });
    }
    let mut decoder = png::Decoder::new(Cursor::new(&bytes));
    decoder.set_transformations(png::Transformations::normalize_to_color8());
    let mut reader = decoder.read_info().map_err(|e| bad(path, e))?;
    let size = [reader.info().width as usize, reader.info().height as usize];
    if size.iter().any(|&side| side > SIDE_MAX) {
        return Err(bad(path, format!("a side is longer than {SIDE_MAX}")));
    }
    let room = reader.output_buffer_size().ok_or_else(|| bad(path, "it is too large"))?;
    let mut data = vec![0; room];
    let frame = reader.next_frame(&mut data).map_err(|e| bad(path, e))?;
    data.truncate(frame.buffer_size());
    let rgba = match frame.color_type {
        png::ColorType::Rgba => data,
        png::ColorType::Rgb => data.chunks_exact(3).flat_map(|p| [p[0], p[1], p[2], 255]).collect(),
        png::ColorType::Grayscale => data.iter().flat_map(|&v| [v, v, v, 255]).collect(),
        png::ColorType::GrayscaleAlpha => {
            data.chunks_exact(2).flat_map(|p| [p[0], p[0], p[0], p[1]]).collect()
        }
        png::ColorType::Indexed => return Err(bad(path, "its palette was not applied")),
    };
    Ok(Photo { size, rgba })
}
