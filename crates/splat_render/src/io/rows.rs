//! A file of splats read a part at a time, so that it may be larger than memory.

use std::fs::File;
use std::io::{BufReader, Seek, SeekFrom};
use std::path::{Path, PathBuf};

use super::bytes::Named;
use super::ply::Rows;
use super::ply_header::Header;
use super::{open_file, read_splats};
use crate::error::Result;
use crate::splats::SplatArrays;

/// A stream of a file's splats. A `.ply` of floats is read in parts, smaller formats whole.
pub struct SplatRows {
    path: PathBuf,
    source: Source,
    /// Splats that were given out.
    done: usize,
    /// Number of all splats.
    pub count: usize,
    /// SH degree.
    pub sh_degree: u32,
    /// World position = origin + mean.
    pub origin: [f64; 3],
    /// Whether they must be rendered antialiased.
    pub antialiased: bool,
}

enum Source {
    /// The file, its columns, and the offset of its rows.
    Ply(BufReader<File>, Rows, u64),
    Whole(SplatArrays),
}

impl SplatRows {
    /// Opens a file of any format.
    pub fn open(path: &Path) -> Result<Self> {
        if let Some(rows) = Self::open_ply(path)? {
            return Ok(rows);
        }
        let file = read_splats(path)?.file;
        Ok(Self {
            path: path.to_owned(),
            done: 0,
            count: file.splats.len(),
            sh_degree: file.splats.sh_degree,
            origin: file.origin,
            antialiased: file.antialiased,
            source: Source::Whole(file.splats),
        })
    }

    /// None if it is no `.ply` of floats.
    fn open_ply(path: &Path) -> Result<Option<Self>> {
        let named = Named(path);
        let unreadable = |e| named.bad(format!("cannot be read ({e})"));
        if path.extension().is_none_or(|ending| !ending.eq_ignore_ascii_case("ply")) {
            return Ok(None);
        }
        let file = open_file(path)?;
        let size = file.metadata().map_err(unreadable)?.len();
        let mut reader = BufReader::with_capacity(1 << 20, file);
        let header = Header::read(&mut reader, &named)?;
        if header.starts_with("chunk") {
            return Ok(None);
        }
        let rows = Rows::new(&header, size, &named)?;
        let start = reader.stream_position().map_err(unreadable)?;
        Ok(Some(Self {
            path: path.to_owned(),
            done: 0,
            count: rows.count,
            sh_degree: rows.degree,
            origin: header.origin,
            antialiased: header.antialiased,
            source: Source::Ply(reader, rows, start),
        }))
    }

    /// Begins again at the first splat.
    pub fn rewind(&mut self) -> Result<()> {
        self.done = 0;
        if let Source::Ply(reader, _, start) = &mut self.source {
            let named = Named(&self.path);
            reader
                .seek(SeekFrom::Start(*start))
                .map_err(|e| named.bad(format!("cannot be read ({e})")))?;
        }
        Ok(())
    }

    /// The next splats, at most `most`; empty at the end.
    pub fn next(&mut self, most: usize) -> Result<SplatArrays> {
        let named = Named(&self.path);
        let first = self.done;
        let n = most.min(self.count - first);
        self.done += n;
        match &mut self.source {
            Source::Whole(splats) => Ok(splats.select(&(first..first + n).collect::<Vec<_>>())),
            Source::Ply(reader, rows, _) => {
                let mut splats = SplatArrays::zeros(n, self.sh_degree);
                for i in 0..n {
                    rows.read(reader, first + i, &mut splats, i, &named)?;
                }
                Ok(splats)
            }
        }
    }
}
