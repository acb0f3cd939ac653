//! Opens files that a user names.

use std::fs::{File, OpenOptions};
use std::path::Path;

use super::bytes::Named;
use crate::error::Result;

/// Opens a file for reading. Refuses pipes, sockets and devices: opening or reading one may block
/// forever, and their content has no size to check a claim against.
pub fn open_file(path: &Path) -> Result<File> {
    let named = Named(path);
    let closed = |e: std::io::Error| named.bad(format!("cannot be opened ({e})"));
    let mut options = OpenOptions::new();
    options.read(true);
    // Opening a pipe waits for its writer.
    #[cfg(unix)]
    std::os::unix::fs::OpenOptionsExt::custom_flags(&mut options, libc::O_NONBLOCK);
    let file = options.open(path).map_err(closed)?;
    // Of the opened file: another one may have the name by now.
    let kind = file.metadata().map_err(closed)?;
    if !kind.is_file() && !kind.is_dir() {
        return Err(
            named.bad("is a pipe or a device; save its output to a file, and name that file")
        );
    }
    Ok(file)
}
