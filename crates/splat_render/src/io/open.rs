//! Opens files that a user names.

use std::fs::File;
use std::path::Path;

use super::bytes::Named;
use crate::error::Result;

/// Opens a file for reading. Refuses pipes, sockets and devices: opening or reading one may block
/// forever, and their content has no size to check a claim against.
pub fn open_file(path: &Path) -> Result<File> {
    let named = Named(path);
    let closed = |e: std::io::Error| named.bad(format!("cannot be opened ({e})"));
    let kind = std::fs::metadata(path).map_err(closed)?;
    if !kind.is_file() && !kind.is_dir() {
        return Err(
            named.bad("is a pipe or a device; save its output to a file, and name that file")
        );
    }
    File::open(path).map_err(closed)
}
