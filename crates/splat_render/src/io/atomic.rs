//! Files appear whole or not at all.

use std::ffi::OsString;
use std::fs::{self, DirBuilder, File};
use std::hash::{BuildHasher, RandomState};
use std::io::{BufWriter, ErrorKind, Result as IoResult, Write};
use std::path::{Path, PathBuf};
use std::time::Duration;

use crate::error::{Error, Result};

/// End of the names of folders that hold unfinished files.
const UNFINISHED: &[u8] = b".unfinished";
/// Younger folders may be in use by another computer: network file systems may lock for one only.
const LEFT_AFTER: Duration = Duration::from_secs(3600);

/// Writes to a temporary file and renames it; on errors the old file stays. An old file's mode is kept.
///
/// Leftovers of writers to `path` that were killed are removed.
pub fn write_atomically(
    path: &Path,
    write: impl FnOnce(&mut BufWriter<File>) -> IoResult<()>,
) -> Result<()> {
    let run = || -> IoResult<()> {
        let unfinished = Unfinished::of(path)?;
        let temporary = unfinished.folder.join("new");
        let mut out = BufWriter::new(File::create_new(&temporary)?);
        write(&mut out)?;
        out.flush()?;
        if let Ok(old) = fs::symlink_metadata(path)
            && old.is_file()
        {
            out.get_ref().set_permissions(old.permissions())?;
        }
        out.get_ref().sync_all()?;
        drop(out);
        fs::rename(&temporary, path)
    };
    if path.file_name().is_none() {
        return Err(Error::file(path, "is not a file name; give the file to write"));
    }
    run().map_err(|error| {
        Error::file(path, format!("cannot be written ({error}); the existing file is unchanged"))
    })
}

/// A private folder next to a file, for the file's next content. Dropping it removes it.
///
/// It is locked as long as its process lives, on systems that lock folders. Python's `atomic_write`
/// uses the same names and locks.
struct Unfinished {
    folder: PathBuf,
    _lock: Option<File>,
}

impl Unfinished {
    fn of(path: &Path) -> IoResult<Self> {
        let mut prefix = OsString::from(".");
        prefix.push(path.file_name().unwrap_or_default());
        prefix.push("-");
        remove_leftovers(path, prefix.as_encoded_bytes());
        loop {
            let mut name = prefix.clone();
            name.push(format!("{:016x}.unfinished", RandomState::new().hash_one(0)));
            let folder = path.with_file_name(name);
            let mut builder = DirBuilder::new();
            #[cfg(unix)]
            std::os::unix::fs::DirBuilderExt::mode(&mut builder, 0o700);
            match builder.create(&folder) {
                // Forked processes draw the same names.
                Err(error) if error.kind() == ErrorKind::AlreadyExists => continue,
                made => made?,
            }
            let lock = File::open(&folder).ok().filter(|file| file.lock().is_ok());
            // Another writer may have removed it before it was locked.
            if folder.is_dir() {
                return Ok(Self { folder, _lock: lock });
            }
        }
    }
}

impl Drop for Unfinished {
    fn drop(&mut self) {
        let _ = fs::remove_dir_all(&self.folder);
    }
}

/// Removes the old, unlocked folders of the file `path`.
fn remove_leftovers(path: &Path, prefix: &[u8]) {
    let parent = path.parent().filter(|parent| !parent.as_os_str().is_empty());
    for entry in fs::read_dir(parent.unwrap_or(Path::new("."))).into_iter().flatten().flatten() {
        let name = entry.file_name();
        let random = name.as_encoded_bytes().strip_prefix(prefix);
        // With a "-" it belongs to a file with a longer name.
        if random.and_then(|end| end.strip_suffix(UNFINISHED)).is_some_and(|it| !it.contains(&b'-'))
            && let Ok(data) = entry.metadata()
            && data.is_dir()
            && data.modified().is_ok_and(|time| time.elapsed().is_ok_and(|age| age > LEFT_AFTER))
            && let Ok(lock) = File::open(entry.path())
            && lock.try_lock().is_ok()
        {
            let _ = fs::remove_dir_all(entry.path());
        }
    }
}
