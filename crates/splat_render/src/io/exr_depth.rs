//! The depth channel of an OpenEXR file.

use std::io::Cursor;
use std::path::Path;

use ::exr::prelude::{FlatSamples, ReadChannels, ReadLayers, read};

use crate::error::{Error, Result};

/// Maximum number of pixels of a depth map.
const PIXELS_MAX: usize = 1 << 28;

/// Reads channel Z of an EXR file's largest layer, or its only channel. Returns height, width and `[H *
/// W]` numbers, row-major.
pub fn read_exr_depth(path: &Path) -> Result<(usize, usize, Vec<f32>)> {
    let bytes = std::fs::read(path).map_err(|e| Error::file(path, e.to_string()))?;
    decode(bytes)
}

fn decode(bytes: Vec<u8>) -> Result<(usize, usize, Vec<f32>)> {
    let bad = |reason: String| Error::argument("file", reason);
    // Headers first: one that claims too much reserves no memory.
    let meta = ::exr::meta::MetaData::read_from_buffered(Cursor::new(&bytes), false)
        .map_err(|e| bad(format!("is not an OpenEXR file ({e})")))?;
    let pixels = meta.headers.iter().map(|header| header.layer_size.area()).max().unwrap_or(0);
    if pixels > PIXELS_MAX {
        return Err(bad(format!("has {pixels} pixels; the limit is {PIXELS_MAX}")));
    }
    let image = read()
        .no_deep_data()
        .largest_resolution_level()
        .all_channels()
        .first_valid_layer()
        .all_attributes()
        .on_progress(|_| {})
        .from_buffered(Cursor::new(bytes))
        .map_err(|e| bad(format!("cannot be read ({e})")))?;
    let (size, channels) = (image.layer_data.size, image.layer_data.channel_data.list);
    let depth = match channels.iter().find(|channel| channel.name.eq("Z")) {
        Some(depth) => depth,
        None if channels.len() == 1 => &channels[0],
        None => {
            let names: Vec<String> = channels.iter().map(|c| c.name.to_string()).collect();
            return Err(bad(format!("has the channels {}, but no Z", names.join(", "))));
        }
    };
    let values = match &depth.sample_data {
        FlatSamples::F16(values) => values.iter().map(|v| v.to_f32()).collect(),
        FlatSamples::F32(values) => values.clone(),
        FlatSamples::U32(values) => values.iter().map(|&v| v as f32).collect(),
    };
    Ok((size.height(), size.width(), values))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::io::{ExrPicture, encode_exr};

    #[test]
    fn a_written_depth_is_read() {
        let depth: Vec<f32> = (0..6).map(|i| 0.3 + i as f32).collect();
        let (color, alpha) = ([[0.5; 3]; 6], [1.0; 6]);
        let picture =
            ExrPicture { width: 3, height: 2, color: &color, alpha: &alpha, depth: &depth };
        let bytes = encode_exr(&picture).unwrap();
        assert_eq!(decode(bytes.clone()).unwrap(), (2, 3, depth));
        for cut in [0, 3, 20, bytes.len() / 2, bytes.len() - 1] {
            assert!(decode(bytes[..cut].to_vec()).is_err(), "{cut}");
        }
    }
}
