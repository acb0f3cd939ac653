//! The depth channel of an OpenEXR file.

use std::io::{BufReader, Read, Seek};
use std::path::Path;

use ::exr::math::Vec2;
use ::exr::meta::header::Header;
use ::exr::prelude::{ReadChannels, ReadLayers, ReadSpecificChannel, read};

use super::limits::{EXR_BLOCK_MAX, EXR_MAX};
use super::open_file;
use crate::error::{Error, Result};

/// Reads channel Z of an EXR file's first layer that has it, or the only channel, of at most `most`
/// pixels. Returns height, width and `[H * W]` numbers, row-major.
pub fn read_exr_depth(path: &Path, most: usize) -> Result<(usize, usize, Vec<f32>)> {
    decode(BufReader::new(open_file(path)?), most)
}

fn decode(file: impl Read + Seek, most: usize) -> Result<(usize, usize, Vec<f32>)> {
    let bad = |reason: String| Error::argument("file", reason);
    // Headers first: one that claims too much reserves no memory.
    let chunks = ::exr::block::read(file, false)
        .map_err(|e| bad(format!("is not an OpenEXR file ({e})")))?;
    let headers = chunks.headers();
    let pixels = headers.iter().map(|header| header.layer_size.area()).max().unwrap_or(0);
    if pixels > most {
        return Err(bad(format!("has {pixels} pixels; the limit is {most}")));
    }
    let bytes: usize = headers.iter().map(Header::total_pixel_bytes).sum();
    let block_of = |header: &Header| {
        let (block, layer) = (header.max_block_pixel_size(), header.layer_size);
        let pixels = block.width().min(layer.width()) * block.height().min(layer.height());
        pixels * header.channels.bytes_per_pixel
    };
    let block = headers.iter().map(block_of).max().unwrap_or(0);
    if bytes > EXR_MAX || block > EXR_BLOCK_MAX {
        return Err(bad(format!(
            "has {bytes} bytes, and {block} in a block; the limits are {EXR_MAX} and \
             {EXR_BLOCK_MAX}: save channel Z alone"
        )));
    }
    let channels = |header: &Header| header.channels.list.iter().map(|c| c.name.clone()).collect();
    let layers: Vec<Vec<_>> = headers.iter().map(channels).collect();
    let first = layers.first().map_or(&[][..], Vec::as_slice);
    let name = match (layers.iter().flatten().find(|name| **name == *"Z"), first) {
        (Some(name), _) | (None, [name]) => name.clone(),
        _ => {
            let names: Vec<String> = first.iter().map(ToString::to_string).collect();
            return Err(bad(format!("has the channels {}, but no Z", names.join(", "))));
        }
    };
    // Values of one channel are kept.
    let image = read()
        .no_deep_data()
        .largest_resolution_level()
        .specific_channels()
        .required(name)
        .collect_pixels(
            |size: Vec2<usize>, _| (size.width(), vec![0.0; size.area()]),
            |(width, depth), at: Vec2<usize>, (z,): (f32,)| depth[at.y() * *width + at.x()] = z,
        )
        .first_valid_layer()
        .all_attributes()
        .on_progress(|_| {})
        .from_chunks(chunks)
        .map_err(|e| bad(format!("cannot be read ({e})")))?;
    let size = image.layer_data.size;
    Ok((size.height(), size.width(), image.layer_data.channel_data.pixels.1))
}

#[cfg(test)]
mod tests {
    use std::io::Cursor;

    use super::*;
    use crate::io::{ExrPicture, encode_exr};

    #[test]
    fn a_written_depth_is_read() {
        let depth: Vec<f32> = (0..6).map(|i| 0.3 + i as f32).collect();
        let (color, alpha) = ([[0.5; 3]; 6], [1.0; 6]);
        let picture =
            ExrPicture { width: 3, height: 2, color: &color, alpha: &alpha, depth: &depth };
        let bytes = encode_exr(&picture).unwrap();
        assert_eq!(decode(Cursor::new(&bytes), 6).unwrap(), (2, 3, depth));
        assert!(decode(Cursor::new(&bytes), 5).unwrap_err().to_string().contains("limit is 5"));
        for cut in [0, 3, 20, bytes.len() / 2, bytes.len() - 1] {
            assert!(decode(Cursor::new(&bytes[..cut]), 6).is_err(), "{cut}");
        }
    }
}
