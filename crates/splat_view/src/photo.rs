//! Reads photos of a capture, PNG and JPEG. The files are untrusted.

use std::io::{BufReader, Cursor, Read};
use std::path::Path;

use splat_render::io::open_file;
use splat_render::{Error, Result};
use zune_jpeg::JpegDecoder;
use zune_jpeg::zune_core::colorspace::ColorSpace;
use zune_jpeg::zune_core::options::DecoderOptions;

/// Largest file that is read, bytes.
const FILE_MAX: u64 = 256 << 20;
/// Longest side and largest number of pixels that are read; a pixel takes 4 bytes.
const SIDE_MAX: usize = 16_384;
const PIXELS_MAX: usize = 1 << 27;

#[derive(Debug, Clone)]
pub struct Photo {
    pub size: [usize; 2],
    /// RGBA, row-major, colors not multiplied by alpha.
    pub rgba: Vec<u8>,
}

impl Photo {
    /// Shrinks the photo by averaging until no side is longer than `most` pixels.
    #[must_use]
    pub fn within(self, most: usize) -> Self {
        let [width, height] = self.size;
        let longest = width.max(height);
        if longest <= most {
            return self;
        }
        let size = self.size.map(|side| (side * most / longest).max(1));
        // The range of source pixels that one target pixel averages.
        let part = |i: usize, was: usize, is: usize| {
            let begin = i * was / is;
            begin..((i + 1) * was / is).max(begin + 1)
        };
        let mut rgba = Vec::with_capacity(4 * size[0] * size[1]);
        for y in 0..size[1] {
            let rows = part(y, height, size[1]);
            for x in 0..size[0] {
                let columns = part(x, width, size[0]);
                let (mut sum, mut alphas) = ([0u64; 3], 0u64);
                for row in rows.clone() {
                    let from = 4 * (row * width + columns.start);
                    for pixel in self.rgba[from..from + 4 * columns.len()].chunks_exact(4) {
                        let alpha = u64::from(pixel[3]);
                        alphas += alpha;
                        // Weighted by alpha: invisible pixels have no meaningful color.
                        for (sum, &value) in sum.iter_mut().zip(pixel) {
                            *sum += alpha * u64::from(value);
                        }
                    }
                }
                let count = (rows.len() * columns.len()) as u64;
                let weight = alphas.max(1);
                rgba.extend(sum.map(|sum| ((sum + weight / 2) / weight) as u8));
                rgba.push(((alphas + count / 2) / count) as u8);
            }
        }
        Self { size, rgba }
    }
}

fn bytes(path: &Path) -> Result<Vec<u8>> {
    let unreadable = |e: std::io::Error| Error::file(path, format!("cannot be read ({e})"));
    let file = open_file(path)?;
    let mut bytes = Vec::new();
    BufReader::new(file).take(FILE_MAX).read_to_end(&mut bytes).map_err(unreadable)?;
    Ok(bytes)
}

fn bad(path: &Path, what: impl std::fmt::Display) -> Error {
    Error::file(path, format!("cannot be read as a PNG or JPEG ({what}); convert it to one"))
}

fn is_png(bytes: &[u8]) -> bool {
    bytes.starts_with(b"\x89PNG")
}

fn jpeg(bytes: &[u8]) -> JpegDecoder<Cursor<&[u8]>> {
    let options = DecoderOptions::default()
        // Both are u16 in a JPEG; check_size has a clearer sentence.
        .set_max_width(usize::from(u16::MAX))
        .set_max_height(usize::from(u16::MAX))
        .jpeg_set_out_colorspace(ColorSpace::RGBA);
    JpegDecoder::new_with_options(Cursor::new(bytes), options)
}

fn check_size(path: &Path, [width, height]: [usize; 2]) -> Result<()> {
    let limit = if width.max(height) > SIDE_MAX {
        format!("{SIDE_MAX} on a side")
    } else if width * height > PIXELS_MAX {
        format!("{PIXELS_MAX} in all")
    } else {
        return Ok(());
    };
    Err(Error::file(path, format!("has {width}x{height} pixels, more than {limit}; shrink it")))
}

pub fn read_photo(path: &Path) -> Result<Photo> {
    let bytes = bytes(path)?;
    if !is_png(&bytes) {
        let mut decoder = jpeg(&bytes);
        decoder.decode_headers().map_err(|e| bad(path, e))?;
        let (width, height) = decoder.dimensions().ok_or_else(|| bad(path, "it has no size"))?;
        check_size(path, [width, height])?;
        let rgba = decoder.decode().map_err(|e| bad(path, e))?;
        return Ok(Photo { size: [width, height], rgba });
    }
    let mut decoder = png::Decoder::new(Cursor::new(&bytes));
    decoder.set_transformations(
        png::Transformations::normalize_to_color8() | png::Transformations::ALPHA,
    );
    let mut reader = decoder.read_info().map_err(|e| bad(path, e))?;
    let size = [reader.info().width as usize, reader.info().height as usize];
    check_size(path, size)?;
    let room = reader.output_buffer_size().ok_or_else(|| bad(path, "it is too large"))?;
    let mut data = vec![0; room];
    let frame = reader.next_frame(&mut data).map_err(|e| bad(path, e))?;
    data.truncate(frame.buffer_size());
    let rgba = match frame.color_type {
        png::ColorType::Rgba => data,
        png::ColorType::GrayscaleAlpha => {
            data.chunks_exact(2).flat_map(|p| [p[0], p[0], p[0], p[1]]).collect()
        }
        _ => return Err(bad(path, "it was not converted")),
    };
    Ok(Photo { size, rgba })
}

#[cfg(test)]
mod tests {
    use std::path::PathBuf;

    use super::*;

    fn file(name: &str, bytes: &[u8]) -> PathBuf {
        let name = format!("splat-view-photo-{}-{name}", std::process::id());
        let path = std::env::temp_dir().join(name);
        std::fs::write(&path, bytes).expect("file");
        path
    }

    fn png(color: png::ColorType, depth: png::BitDepth, data: &[u8]) -> Vec<u8> {
        let mut bytes = Vec::new();
        let mut encoder = png::Encoder::new(&mut bytes, 2, 1);
        encoder.set_color(color);
        encoder.set_depth(depth);
        if color == png::ColorType::Indexed {
            encoder.set_palette(vec![10, 20, 30, 40, 50, 60]);
        }
        let mut writer = encoder.write_header().expect("header");
        writer.write_image_data(data).expect("pixels");
        writer.finish().expect("end");
        bytes
    }

    #[test]
    fn every_kind_of_png_becomes_rgba() {
        use png::BitDepth::{Eight, Sixteen};
        use png::ColorType::{Grayscale, GrayscaleAlpha, Indexed, Rgb, Rgba};
        let gray = [7, 7, 7, 255, 9, 9, 9, 255];
        let kinds: [(_, _, &[u8], [u8; 8]); 6] = [
            (Grayscale, Eight, &[7, 9], gray),
            (Grayscale, Sixteen, &[7, 7, 9, 9], gray),
            (GrayscaleAlpha, Eight, &[7, 1, 9, 2], [7, 7, 7, 1, 9, 9, 9, 2]),
            (Rgb, Eight, &[1, 2, 3, 4, 5, 6], [1, 2, 3, 255, 4, 5, 6, 255]),
            (Rgba, Eight, &[1, 2, 3, 4, 5, 6, 7, 8], [1, 2, 3, 4, 5, 6, 7, 8]),
            (Indexed, Eight, &[1, 0], [40, 50, 60, 255, 10, 20, 30, 255]),
        ];
        for (color, depth, data, expected) in kinds {
            let path = file("kind.png", &png(color, depth, data));
            let photo = read_photo(&path).expect("photo");
            assert_eq!((photo.size, &photo.rgba[..]), ([2, 1], &expected[..]), "{color:?}");
            std::fs::remove_file(path).expect("clean");
        }
    }

    #[test]
    fn only_photos_that_are_too_large_are_averaged() {
        let pixel = |x: u8, y: u8| [10 * x, 100 + 10 * y, 50, 255];
        let rgba: Vec<u8> = (0..2).flat_map(|y| (0..6).flat_map(move |x| pixel(x, y))).collect();
        let photo = Photo { size: [6, 2], rgba: rgba.clone() };
        assert_eq!(photo.clone().within(6).rgba, rgba);
        let small = photo.within(3);
        assert_eq!(small.size, [3, 1]);
        assert_eq!(small.rgba, [5, 105, 50, 255, 25, 105, 50, 255, 45, 105, 50, 255]);
        // Thinner than the reduced size, and partly transparent.
        let line = Photo { size: [4, 1], rgba: [[9, 9, 9, 255], [77, 0, 0, 0]].concat().repeat(2) };
        let line = line.within(2);
        assert_eq!((line.size, line.rgba), ([2, 1], [9, 9, 9, 128].repeat(2)));
    }

    #[test]
    fn a_jpeg_is_read_and_other_files_are_refused_by_name() {
        // 16x8: the left half (200, 40, 30), the right one (20, 60, 180).
        let bytes = include_bytes!("../tests/photo.jpg");
        let path = file("a.jpg", bytes);
        let photo = read_photo(&path).expect("photo");
        assert_eq!((photo.size, photo.rgba.len()), ([16, 8], 16 * 8 * 4));
        for (x, expected) in [(3, [200, 40, 30, 255]), (12, [20, 60, 180, 255])] {
            let pixel = &photo.rgba[4 * (16 * 4 + x)..][..4];
            let off = pixel.iter().zip(expected).map(|(a, b): (&u8, u8)| a.abs_diff(b)).max();
            assert!(off <= Some(6), "{pixel:?} at {x}");
        }
        std::fs::remove_file(path).expect("clean");
        let wide = png(png::ColorType::Grayscale, png::BitDepth::Eight, &[1, 2]);
        for (name, bytes) in [("empty", &b""[..]), ("text", b"no photo"), ("cut.png", &wide[..30])]
        {
            let path = file(name, bytes);
            let error = read_photo(&path).expect_err(name).to_string();
            assert!(error.contains(name) && error.contains("a PNG or JPEG"), "{error}");
            std::fs::remove_file(path).expect("clean");
        }
        for ([height, width], limit) in [
            ([16_384, 16_384], "more than 134217728 in all; shrink it"),
            ([8, 16_385], "more than 16384 on a side; shrink it"),
        ] {
            let mut huge = bytes.to_vec();
            let frame = huge.windows(2).position(|w| w == [0xff, 0xc0]).expect("a frame");
            let sides = [height, width].map(u16::to_be_bytes).concat();
            huge[frame + 5..frame + 9].copy_from_slice(&sides);
            let path = file("huge.jpg", &huge);
            let error = read_photo(&path).expect_err("too large").to_string();
            let size = format!("has {width}x{height} pixels");
            assert!(error.contains(&size) && error.contains(limit), "{error}");
            std::fs::remove_file(path).expect("clean");
        }
    }
}
