//! Which format a file is in.

use std::path::Path;

use super::bytes::Named;
use crate::error::{Error, Result};

/// Formats of splat files.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Format {
    /// INRIA's `.ply` of floats.
    Ply,
    /// PlayCanvas's `.ply` of packed integers, `.compressed.ply`.
    CompressedPly,
    /// antimatter15's `.splat`.
    Splat,
    /// mkkellogg's `.ksplat`; read only.
    Ksplat,
    /// Niantic's `.spz`.
    Spz,
    /// PlayCanvas's `.sog`.
    Sog,
    /// glTF with `KHR_gaussian_splatting` in one binary file.
    Glb,
    /// The same as JSON.
    Gltf,
}

/// Formats by ending, the longer ending first.
const ENDINGS: [(&str, Format); 8] = [
    (".compressed.ply", Format::CompressedPly),
    (".ply", Format::Ply),
    (".ksplat", Format::Ksplat),
    (".splat", Format::Splat),
    (".spz", Format::Spz),
    (".sog", Format::Sog),
    (".glb", Format::Glb),
    (".gltf", Format::Gltf),
];

const WRITABLE: &str = ".ply, .compressed.ply, .splat, .spz, .sog, .glb or .gltf";

impl Format {
    /// Its name, the ending without the dot.
    pub fn name(self) -> &'static str {
        match self {
            Self::Ply => "ply",
            Self::CompressedPly => "compressed.ply",
            Self::Splat => "splat",
            Self::Ksplat => "ksplat",
            Self::Spz => "spz",
            Self::Sog => "sog",
            Self::Glb => "glb",
            Self::Gltf => "gltf",
        }
    }

    /// The format that a path's ending names.
    pub fn of_ending(path: &Path) -> Option<Self> {
        let name = path.file_name()?.to_string_lossy().to_lowercase();
        ENDINGS.iter().find(|(ending, _)| name.ends_with(ending)).map(|(_, format)| *format)
    }

    /// The format of a file that starts with `head`; a compressed .ply counts as .ply.
    pub(super) fn of(head: &[u8], named: &Named<'_>) -> Result<Self> {
        let marks: [(&[u8], Self); 7] = [
            (b"ply\n", Self::Ply),
            (b"ply\r", Self::Ply),
            (b"NGSP", Self::Spz),
            (b"PK\x03\x04", Self::Sog),
            (b"glTF", Self::Glb),
            (&[0x1f, 0x8b, 8], Self::Spz),
            (b"{", Self::Gltf),
        ];
        let text = head.trim_ascii_start();
        let ending = Self::of_ending(named.0);
        // The first bytes of these two are numbers, which may look like a short mark by chance.
        let unmarked = matches!(ending, Some(Self::Splat | Self::Ksplat));
        let marked = marks
            .iter()
            .find(|(mark, _)| match mark {
                [b'{'] => text.starts_with(mark) && !unmarked,
                _ => head.starts_with(mark) && (!unmarked || mark.len() >= 4),
            })
            .map(|(_, format)| *format);
        match (marked, ending) {
            _ if head.is_empty() => Err(named.bad("is empty; give a file of splats")),
            (Some(format), _) => Ok(format),
            (None, Some(format @ (Self::Splat | Self::Ksplat))) => Ok(format),
            // Continue, so that the error names the expected start of the file.
            (None, Some(Self::Ply | Self::CompressedPly)) => Ok(Self::Ply),
            (None, Some(format)) => Err(named.bad(format!(
                "does not start like a .{} file; it is damaged or of another format: give a file \
                 of splats",
                format.name()
            ))),
            (None, None) => Err(named.bad(
                "is not a readable file of splats: .ply, .splat, .ksplat, .spz, .sog, .glb \
                 or .gltf",
            )),
        }
    }

    /// The format to write at `path`.
    pub(super) fn to_write(path: &Path) -> Result<Self> {
        match Self::of_ending(path) {
            None | Some(Self::Ksplat) => Err(Self::unwritable(path)),
            Some(format) => Ok(format),
        }
    }

    pub(super) fn unwritable(path: &Path) -> Error {
        Error::file(path, format!("has an ending that cannot be written; use {WRITABLE}"))
    }
}
