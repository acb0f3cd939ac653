//! Writes a scene in levels of detail, in bounded memory.
//!
//! The file is read twice: first a sample of positions decides the split of space into cells; then each
//! splat is written to its cell's file, and the cells are merged one by one. Consecutive cells of a level
//! share a SOG until it is as large as a cell.

use std::fs::{File, OpenOptions};
use std::io::{Read, Write};
use std::path::{Path, PathBuf};

use glam::{DMat3, DQuat, DVec3};
use rayon::prelude::*;

use super::cells::Cells;
use super::manifest::{Cell, INDEX, Manifest, Run, written};
use super::merging::merged;
use crate::error::{Error, Result};
use crate::io::{SOG_META, SplatRows, cut_degree, is_drawn, morton_order, write_sog_folder};
use crate::splats::SplatArrays;

/// Ratio of the number of splats between two levels.
const QUARTER: usize = 4;
/// Number of sampled positions that decide the split.
const SAMPLES: usize = 1 << 20;
/// Splats that are read at once, and that wait to be written to their cells' files.
const BATCH: usize = 1 << 14;
const WAITING: usize = 1 << 17;
/// Highest SH degree of SOG.
const DEGREE: u32 = 3;

/// Result of [`write_levels`].
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct LevelsWritten {
    /// Splats of each level, 0 the finest.
    pub counts: Vec<usize>,
    /// Number of cells.
    pub cells: usize,
    /// Number of SOGs.
    pub files: usize,
    /// Notes about omitted splats.
    pub notes: Vec<String>,
}

/// Writes the scene of a file into an existing, empty folder: `levels` levels, each with a quarter of the
/// splats of the next finer one, in cells of about `per_cell` splats. None, with the folder half written,
/// once `goes_on` returns false.
pub fn write_levels(
    source: &Path,
    folder: &Path,
    levels: usize,
    per_cell: usize,
    goes_on: &mut dyn FnMut() -> bool,
) -> Result<Option<LevelsWritten>> {
    if !(1..=8).contains(&levels) {
        return Err(Error::argument("lod", format!("must be from 1 to 8 levels, not {levels}")));
    }
    if !(1..=1 << 22).contains(&per_cell) {
        return Err(Error::argument(
            "per_cell",
            format!("must be from 1 to {} splats, not {per_cell}", 1 << 22),
        ));
    }
    let mut rows = SplatRows::open(source)?;
    let Some(mut points) = sample(&mut rows, goes_on)? else { return Ok(None) };
    if points.is_empty() {
        return Err(Error::file(source, "has no finite splats to make levels of"));
    }
    let tree = Cells::new(&mut points, per_cell / step(&rows));
    drop(points);
    let degree = rows.sh_degree.min(DEGREE);
    let mut spool = Spool::new(folder.join(".cells"), degree, tree.count)?;
    rows.rewind()?;
    let mut left_out = 0;
    loop {
        let mut batch = rows.next(BATCH)?;
        if batch.is_empty() {
            break;
        }
        if !goes_on() {
            return Ok(None);
        }
        if batch.sh_degree > degree {
            batch = cut_degree(&batch, degree);
        }
        for i in 0..batch.len() {
            if is_drawn(&batch, i) {
                spool.put(tree.of(&batch.means[i]), &batch, i)?;
            } else {
                left_out += 1;
            }
        }
    }
    spool.flush()?;

    let mut out = Output {
        folder,
        antialiased: rows.antialiased,
        per_file: per_cell,
        open: (0..levels).map(|_| Open::new(degree)).collect(),
        files: Vec::new(),
    };
    let mut cells = Vec::with_capacity(tree.count);
    let numbers: Vec<usize> = (0..tree.count).collect();
    for some in numbers.chunks(rayon::current_num_threads().max(1)) {
        if !goes_on() {
            return Ok(None);
        }
        let made: Vec<Option<Made>> = some
            .par_iter()
            .map(|&cell| Ok(spool.take(cell)?.map(|splats| Made::new(&splats, levels))))
            .collect::<Result<_>>()?;
        for made in made {
            cells.push(made.map(|made| out.add(made)).transpose()?);
        }
    }
    out.finish()?;
    std::fs::remove_dir_all(&spool.folder).map_err(|e| unwritable(&spool.folder, &e))?;

    let manifest = Manifest {
        folder: folder.to_owned(),
        files: out.files.iter().map(|name| Path::new(name).join(SOG_META)).collect(),
        levels,
        origin: rows.origin,
        cells: cells.iter().flatten().cloned().collect(),
        environment: None,
    };
    let path = folder.join(INDEX);
    std::fs::write(&path, written(&manifest, &tree, &cells)).map_err(|e| unwritable(&path, &e))?;
    let mut notes = Vec::new();
    if left_out > 0 {
        notes.push(format!("{left_out} splats that cannot be drawn are left out."));
    }
    if rows.sh_degree > DEGREE {
        notes.push(format!("SOG has spherical harmonics up to degree {DEGREE}."));
    }
    Ok(Some(LevelsWritten {
        counts: manifest.counts(),
        cells: manifest.cells.len(),
        files: manifest.files.len(),
        notes,
    }))
}

fn unwritable(path: &Path, why: &dyn std::fmt::Display) -> Error {
    Error::file(path, format!("cannot be written ({why})"))
}

/// Of how many splats one position is looked at to split space.
fn step(rows: &SplatRows) -> usize {
    rows.count.div_ceil(SAMPLES).max(1)
}

/// The finite positions; None if canceled.
fn sample(
    rows: &mut SplatRows,
    goes_on: &mut dyn FnMut() -> bool,
) -> Result<Option<Vec<[f32; 3]>>> {
    let step = step(rows);
    let (mut points, mut number) = (Vec::new(), 0usize);
    loop {
        let batch = rows.next(BATCH)?;
        if batch.is_empty() {
            return Ok(Some(points));
        }
        if !goes_on() {
            return Ok(None);
        }
        for mean in &batch.means {
            if number % step == 0 && mean.iter().all(|c| c.is_finite()) {
                points.push(*mean);
            }
            number += 1;
        }
    }
}

/// Splats on the disk by their cells.
struct Spool {
    folder: PathBuf,
    degree: u32,
    waiting: Vec<Vec<u8>>,
    count: usize,
}

impl Spool {
    fn new(folder: PathBuf, degree: u32, cells: usize) -> Result<Self> {
        std::fs::create_dir_all(&folder).map_err(|e| unwritable(&folder, &e))?;
        Ok(Self { folder, degree, waiting: vec![Vec::new(); cells], count: 0 })
    }

    fn put(&mut self, cell: usize, splats: &SplatArrays, i: usize) -> Result<()> {
        let row = &mut self.waiting[cell];
        let stride = splats.stride();
        let numbers = splats.means[i].iter().chain(&splats.quats[i]).chain(&splats.scales[i]);
        let sh = splats.sh[i * stride..(i + 1) * stride].iter().flatten();
        for value in numbers.chain([&splats.opacities[i]]).chain(sh) {
            row.extend(value.to_le_bytes());
        }
        self.count += 1;
        if self.count == WAITING { self.flush() } else { Ok(()) }
    }

    fn path(&self, cell: usize) -> PathBuf {
        self.folder.join(cell.to_string())
    }

    fn flush(&mut self) -> Result<()> {
        self.count = 0;
        for cell in 0..self.waiting.len() {
            let bytes = std::mem::take(&mut self.waiting[cell]);
            if !bytes.is_empty() {
                let path = self.path(cell);
                let file = OpenOptions::new().append(true).create(true).open(&path);
                let done = file.and_then(|mut file| file.write_all(&bytes));
                done.map_err(|e| unwritable(&path, &e))?;
            }
        }
        Ok(())
    }

    /// A cell's splats, whose file goes; None if it has none.
    fn take(&self, cell: usize) -> Result<Option<SplatArrays>> {
        let path = self.path(cell);
        if !path.is_file() {
            return Ok(None);
        }
        let unreadable = |e| Error::file(&path, format!("cannot be read ({e})"));
        let mut bytes = Vec::new();
        File::open(&path).and_then(|mut f| f.read_to_end(&mut bytes)).map_err(unreadable)?;
        std::fs::remove_file(&path).map_err(unreadable)?;
        let stride = crate::sh::coeffs(self.degree);
        let each = 11 + 3 * stride;
        let mut splats = SplatArrays::zeros(bytes.len() / (4 * each), self.degree);
        for (i, row) in bytes.chunks_exact(4 * each).enumerate() {
            let at = |k: usize| f32_of(row, k);
            splats.means[i] = [at(0), at(1), at(2)];
            splats.quats[i] = [at(3), at(4), at(5), at(6)];
            splats.scales[i] = [at(7), at(8), at(9)];
            splats.opacities[i] = at(10);
            for k in 0..stride {
                splats.sh[i * stride + k] = std::array::from_fn(|c| at(11 + 3 * k + c));
            }
        }
        Ok(Some(splats))
    }
}

/// The `k`th number of a row, which holds it.
fn f32_of(row: &[u8], k: usize) -> f32 {
    let mut bytes = [0; 4];
    bytes.copy_from_slice(&row[4 * k..4 * k + 4]);
    f32::from_le_bytes(bytes)
}

/// A cell's levels.
struct Made {
    low: DVec3,
    high: DVec3,
    levels: Vec<SplatArrays>,
    errors: Vec<f64>,
}

impl Made {
    fn new(splats: &SplatArrays, levels: usize) -> Self {
        let finest = splats.select(&morton_order(&splats.means));
        let counts: Vec<usize> =
            (1..levels).map(|level| finest.len().div_ceil(QUARTER.pow(level as u32))).collect();
        let (mut all, mut errors) = (Vec::new(), vec![0.0]);
        for level in merged(&finest, &counts) {
            errors.push(level.moved);
            all.push(level.splats);
        }
        all.insert(0, finest);
        let (mut low, mut high) = (DVec3::INFINITY, DVec3::NEG_INFINITY);
        for splats in &all {
            for i in 0..splats.len() {
                let (mean, half) = extent(splats, i);
                low = low.min(mean - half);
                high = high.max(mean + half);
            }
        }
        Self { low, high, levels: all, errors }
    }
}

/// The middle of a splat, and half the box around its ellipsoid.
fn extent(splats: &SplatArrays, i: usize) -> (DVec3, DVec3) {
    let [w, x, y, z] = splats.quats[i].map(f64::from);
    let turn = DMat3::from_quat(DQuat::from_xyzw(x, y, z, w).normalize());
    // A size that no number of the file can hold would be no bound at all.
    let size = DVec3::from(splats.scales[i].map(|s| f64::from(s).min(80.0).exp()));
    let along = turn * DMat3::from_diagonal(size);
    let half = (0..3).map(|k| along.row(k).length());
    let mut out = DVec3::ZERO;
    for (k, half) in half.enumerate() {
        out[k] = half;
    }
    (DVec3::from(splats.means[i].map(f64::from)), out)
}

/// SOGs that are being filled, one for each level.
struct Output<'a> {
    folder: &'a Path,
    antialiased: bool,
    per_file: usize,
    open: Vec<Open>,
    /// Names of folders that are written or begun.
    files: Vec<String>,
}

struct Open {
    splats: SplatArrays,
    /// Number in `Output::files`.
    file: Option<usize>,
    /// How many of this level came before.
    done: usize,
}

impl Open {
    fn new(degree: u32) -> Self {
        let splats = SplatArrays { sh_degree: degree, ..SplatArrays::default() };
        Self { splats, file: None, done: 0 }
    }
}

impl Output<'_> {
    fn add(&mut self, made: Made) -> Result<Cell> {
        let mut runs = Vec::new();
        for (level, splats) in made.levels.iter().enumerate() {
            let open = &mut self.open[level];
            let file = *open.file.get_or_insert_with(|| {
                self.files.push(format!("{level}_{}", open.done));
                open.done += 1;
                self.files.len() - 1
            });
            runs.push(Some(Run { file, offset: open.splats.len(), count: splats.len() }));
            open.splats.append(splats);
            if 2 * open.splats.len() > self.per_file {
                self.close(level)?;
            }
        }
        let corner = |v: DVec3| v.to_array();
        Ok(Cell { low: corner(made.low), high: corner(made.high), runs, errors: made.errors })
    }

    /// Writes a level's SOG.
    fn close(&mut self, level: usize) -> Result<()> {
        let open = &mut self.open[level];
        let Some(file) = open.file.take() else { return Ok(()) };
        let degree = open.splats.sh_degree;
        let splats = std::mem::replace(&mut open.splats, Open::new(degree).splats);
        let folder = self.folder.join(&self.files[file]);
        std::fs::create_dir_all(&folder).map_err(|e| unwritable(&folder, &e))?;
        write_sog_folder(&folder, &splats, self.antialiased)
    }

    fn finish(&mut self) -> Result<()> {
        (0..self.open.len()).try_for_each(|level| self.close(level))
    }
}
