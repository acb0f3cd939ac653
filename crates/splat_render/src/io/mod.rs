//! Files of splats and of pictures ([`write_exr`]); `docs/guides/formats.md` describes each format of
//! splats.
//!
//! Files are untrusted: every size that a file claims is checked against the actual number of bytes
//! before memory is allocated for it, and each error is one message. Files are written whole or not at
//! all.

mod atomic;
mod bytes;
mod compressed_ply;
mod exr;
mod exr_depth;
mod format;
mod frame;
mod gltf;
mod ksplat;
mod limits;
mod open;
mod ply;
mod ply_header;
mod prepare;
mod quantize;
mod rows;
mod sh_rotation;
mod sog;
mod splat;
mod splat_file;
mod spz;

pub use crate::morton::morton_order;
pub use atomic::write_atomically;
pub use exr::{ExrPicture, encode_exr, write_exr};
pub use exr_depth::read_exr_depth;
pub use format::Format;
pub(crate) use limits::parse_json;
pub use open::open_file;
pub(crate) use prepare::{cut_degree, is_drawn};
pub use rows::SplatRows;
pub(crate) use sog::{META as SOG_META, write_folder as write_sog_folder};
pub use splat_file::{Loaded, SplatFile};

use std::io::{BufRead, BufReader, Read, Write};
use std::path::Path;

use crate::error::Result;
use bytes::Named;
use ply_header::Header;

/// The index of a scene in levels of detail, which no one file holds.
const STREAMED: &str = "lod-meta.json";

/// Reads a file of any format in [`Format`]. The format is detected from the content or, for formats
/// without a signature, from the ending. A file named `meta.json` belongs to a SOG in a folder.
pub fn read_splats(path: &Path) -> Result<Loaded> {
    let named = Named(path);
    if path.file_name().is_some_and(|name| name == sog::META) {
        return sog::parse_folder(&named);
    }
    if path.file_name().is_some_and(|name| name == STREAMED) {
        return Err(named.bad(
            "is a scene in levels of detail; open it with splat-view or igsr view, or give the \
             meta.json of one of its folders",
        ));
    }
    let file = open_file(path)?;
    let unreadable = |e| named.bad(format!("cannot be read ({e})"));
    let size = file.metadata().map_err(unreadable)?.len();
    let mut reader = BufReader::new(file);
    let format = Format::of(reader.fill_buf().map_err(unreadable)?, &named)?;
    if format == Format::Ply {
        return read_any_ply(&mut reader, size, &named);
    }
    limits::check_file_size(&named, size)?;
    let mut bytes = Vec::new();
    reader.read_to_end(&mut bytes).map_err(unreadable)?;
    parse(&bytes, format, &named)
}

/// Reads a file in memory, as [`read_splats`] does. `path` is its name in errors, detects formats without
/// a signature, and locates a `.gltf`'s other files.
pub fn parse_splats(bytes: &[u8], path: &Path) -> Result<Loaded> {
    let named = Named(path);
    parse(bytes, Format::of(bytes, &named)?, &named)
}

/// Reads a `.ply` of `size` bytes: the header distinguishes INRIA's from a compressed one.
fn read_any_ply(reader: &mut impl BufRead, size: u64, named: &Named<'_>) -> Result<Loaded> {
    let header = Header::read(reader, named)?;
    if header.starts_with("chunk") {
        compressed_ply::read(reader, &header, size, named)
    } else {
        ply::read(reader, &header, size, named)
    }
}

fn parse(mut bytes: &[u8], format: Format, named: &Named<'_>) -> Result<Loaded> {
    match format {
        Format::Ply | Format::CompressedPly => {
            let size = bytes.len() as u64;
            read_any_ply(&mut bytes, size, named)
        }
        Format::Splat => splat::parse(bytes, named),
        Format::Ksplat => ksplat::parse(bytes, named),
        Format::Spz => spz::parse(bytes, named),
        Format::Sog => sog::parse(bytes, named),
        Format::Glb | Format::Gltf => gltf::parse(bytes, format, named),
    }
}

/// Writes splats, whole or not at all, in the format of the ending. Returns one message for each thing
/// that the format cannot hold and that was left out or rounded.
pub fn write_splats(path: &Path, file: &SplatFile) -> Result<Vec<String>> {
    let format = Format::to_write(path)?;
    file.splats.validate()?;
    let mut notes = Vec::new();
    let bytes = match format {
        Format::Ply => {
            write_atomically(path, |out| ply::write(out, file))?;
            return Ok(notes);
        }
        Format::CompressedPly => compressed_ply::encode(file, &mut notes),
        Format::Splat => splat::encode(file, &mut notes)?,
        Format::Spz => spz::encode(file, &mut notes)?,
        Format::Sog => sog::encode(file, &mut notes)?,
        Format::Glb | Format::Gltf => gltf::encode(file, format, &mut notes)?,
        Format::Ksplat => return Err(Format::unwritable(path)),
    };
    write_atomically(path, |out| out.write_all(&bytes))?;
    Ok(notes)
}
