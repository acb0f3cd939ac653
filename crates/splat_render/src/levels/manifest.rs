//! `lod-meta.json`: the cells, and the files of their levels.
//!
//! The layout is PlayCanvas's, version 1
//! (<https://developer.playcanvas.com/user-manual/gaussian-splatting/formats/streamed-sog/>). Its binary
//! tree is read as a list of its leaves, the cells. `origin` is igsr's own field, which other readers
//! ignore.

use std::io::Read;
use std::path::{Component, Path, PathBuf};

use serde_json::{Map, Value, json};

use super::cells::{Cells, Node};
use crate::error::{Error, Result};
use crate::io::{open_file, parse_json};

/// Name of the file.
pub const INDEX: &str = "lod-meta.json";
/// Largest file that is read, bytes, and most values in it: with 8 levels, a cell takes about 600 and 65.
const SIZE_MAX: u64 = 64 << 20;
const VALUES_MAX: usize = 800_000;
/// Most levels: each halves the splats, or more.
const LEVELS_MAX: u64 = 32;

/// Consecutive splats of a file.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Run {
    /// The file, by its number.
    pub file: usize,
    /// The first.
    pub offset: usize,
    /// How many; at least one.
    pub count: usize,
}

/// A part of space.
#[derive(Debug, Clone, PartialEq)]
pub struct Cell {
    /// Least corner of the box around its splats, relative to the origin.
    pub low: [f64; 3],
    /// Greatest corner.
    pub high: [f64; 3],
    /// Its splats at each level, 0 the finest; None if it has none there.
    pub runs: Vec<Option<Run>>,
    /// How far each level is from the finest: any unit, the same in all cells.
    pub errors: Vec<f64>,
}

/// The content of the file.
#[derive(Debug, Clone, PartialEq)]
pub struct Manifest {
    /// Its folder.
    pub folder: PathBuf,
    /// Paths of SOGs' `meta.json`, from the folder; they lie in it.
    pub files: Vec<PathBuf>,
    /// Number of levels.
    pub levels: usize,
    /// World position = origin + position in a file.
    pub origin: [f64; 3],
    /// Leaves of the tree.
    pub cells: Vec<Cell>,
    /// A SOG that is always drawn, such as a sky.
    pub environment: Option<PathBuf>,
}

impl Manifest {
    /// Reads the file, or the one in a folder.
    pub fn read(path: &Path) -> Result<Self> {
        let file = if path.is_dir() { path.join(INDEX) } else { path.to_owned() };
        let bad = |what: String| Error::file(&file, format!("{what}; write the levels again"));
        let mut text = Vec::new();
        open_file(&file)?
            .take(SIZE_MAX + 1)
            .read_to_end(&mut text)
            .map_err(|e| bad(format!("cannot be read ({e})")))?;
        if text.len() as u64 > SIZE_MAX {
            return Err(bad(format!("has more than {SIZE_MAX} bytes")));
        }
        let json = parse_json(&text, VALUES_MAX).map_err(bad)?;
        drop(text);
        parse(&json, file.parent().unwrap_or(Path::new(""))).map_err(bad)
    }

    /// Splats of each level.
    pub fn counts(&self) -> Vec<usize> {
        let of = |level: usize| self.cells.iter().filter_map(move |c| c.runs[level]);
        (0..self.levels).map(|level| of(level).map(|run| run.count).sum()).collect()
    }

    /// Number of splats that a file has: all of its runs.
    pub fn size_of(&self, file: usize) -> usize {
        let runs = self.cells.iter().flat_map(|cell| cell.runs.iter().flatten());
        runs.filter(|run| run.file == file).map(|run| run.offset + run.count).max().unwrap_or(0)
    }
}

type Reason = std::result::Result<Manifest, String>;

fn parse(json: &Value, folder: &Path) -> Reason {
    if let Some(version) = json.get("version")
        && version.as_f64() != Some(1.0)
    {
        return Err(format!("is of version {version}, but only 1 is known"));
    }
    let levels = json.get("lodLevels").and_then(Value::as_u64);
    let levels = levels
        .filter(|n| (1..=LEVELS_MAX).contains(n))
        .ok_or_else(|| format!("has no lodLevels from 1 to {LEVELS_MAX}"))?
        as usize;
    let names = json.get("filenames").and_then(Value::as_array);
    let files: Vec<PathBuf> = names
        .ok_or("has no list of filenames")?
        .iter()
        .map(inside)
        .collect::<std::result::Result<_, _>>()?;
    let environment = match json.get("environment") {
        None | Some(Value::Null) => None,
        Some(name) => Some(inside(name)?),
    };
    let origin = match json.get("origin") {
        None => [0.0; 3],
        Some(origin) => numbers(origin).ok_or("has an origin that is not three numbers")?,
    };
    let has_errors = json.get("lodErrors").and_then(Value::as_bool).unwrap_or(false);
    let mut out = Manifest {
        folder: folder.to_owned(),
        files,
        levels,
        origin,
        cells: Vec::new(),
        environment,
    };
    // The JSON reader limits how deep nodes lie within each other.
    let mut nodes = vec![json.get("tree").ok_or("has no tree")?];
    while let Some(node) = nodes.pop() {
        match (node.get("children"), node.get("lods")) {
            (Some(children), None) => {
                let children = children.as_array().filter(|c| !c.is_empty());
                nodes
                    .extend(children.ok_or("has a node without children and levels")?.iter().rev());
            }
            (None, Some(lods)) => {
                let cell = leaf(node, lods, &out, has_errors)?;
                if cell.runs.iter().any(Option::is_some) {
                    out.cells.push(cell);
                }
            }
            _ => return Err("has a node without either children or lods".to_owned()),
        }
    }
    check_apart(&out)?;
    Ok(out)
}

fn leaf(
    node: &Value,
    lods: &Value,
    manifest: &Manifest,
    has_errors: bool,
) -> std::result::Result<Cell, String> {
    let corner = |name: &str| node.get("bound")?.get(name).and_then(numbers);
    let (low, high) = corner("min")
        .zip(corner("max"))
        .filter(|(low, high)| (0..3).all(|k| low[k] <= high[k]))
        .ok_or("has a cell without a bound")?;
    let mut runs = vec![None; manifest.levels];
    for (level, run) in lods.as_object().ok_or("has lods that are not an object")? {
        let place = level.parse().ok().filter(|&level: &usize| level < manifest.levels);
        let place = place
            .ok_or_else(|| format!("has a level {level:?}, but there are {}", manifest.levels))?;
        let number = |name: &str| {
            let value = run.get(name).and_then(Value::as_u64).filter(|&n| n <= 1 << 30);
            value.map(|n| n as usize).ok_or_else(|| format!("has a level without a valid {name}"))
        };
        let run = Run { file: number("file")?, offset: number("offset")?, count: number("count")? };
        if run.file >= manifest.files.len() {
            return Err(format!("has a cell in file {} of {}", run.file, manifest.files.len()));
        }
        runs[place] = Some(run).filter(|run| run.count > 0);
    }
    let errors = match node.get("errors").filter(|_| has_errors) {
        Some(errors) => {
            let errors: Option<Vec<f64>> =
                errors.as_array().and_then(|e| e.iter().map(Value::as_f64).collect());
            errors
                .filter(|e| e.len() == manifest.levels && e.iter().all(|x| *x >= 0.0))
                .ok_or("has a cell without one number in errors for each level")?
        }
        None => spacings(&low, &high, &runs),
    };
    Ok(Cell { low, high, runs, errors })
}

/// Approximate distance between splats at each level, by the cell's largest face; 0 at the finest.
fn spacings(low: &[f64; 3], high: &[f64; 3], runs: &[Option<Run>]) -> Vec<f64> {
    let finest = runs.iter().position(Option::is_some);
    let face = face(low, high);
    let spacing = |(level, run): (usize, &Option<Run>)| match run {
        Some(run) if Some(level) != finest => (face / run.count as f64).sqrt(),
        _ => 0.0,
    };
    runs.iter().enumerate().map(spacing).collect()
}

/// Area of the largest face of a box.
pub fn face(low: &[f64; 3], high: &[f64; 3]) -> f64 {
    let mut sides: [f64; 3] = std::array::from_fn(|k| high[k] - low[k]);
    sides.sort_by(f64::total_cmp);
    sides[1] * sides[2]
}

/// Refuses runs that share splats: a file would be counted twice.
fn check_apart(manifest: &Manifest) -> std::result::Result<(), String> {
    let runs = manifest.cells.iter().flat_map(|cell| cell.runs.iter().flatten());
    let mut runs: Vec<&Run> = runs.collect();
    runs.sort_by_key(|run| (run.file, run.offset));
    for pair in runs.windows(2) {
        if pair[0].file == pair[1].file && pair[0].offset + pair[0].count > pair[1].offset {
            let name = manifest.files[pair[0].file].display();
            return Err(format!("gives splats of {name} to two cells or levels"));
        }
    }
    Ok(())
}

/// A path that stays in the folder.
fn inside(name: &Value) -> std::result::Result<PathBuf, String> {
    let text = name.as_str().ok_or("has a file name that is not text")?;
    let path = Path::new(text);
    let is_inside = path.components().all(|part| matches!(part, Component::Normal(_)));
    if text.is_empty() || !is_inside || text.contains(['\\', ':']) {
        return Err(format!("names {text:?}, which is not in its folder"));
    }
    Ok(path.to_owned())
}

fn numbers(value: &Value) -> Option<[f64; 3]> {
    let values: Option<Vec<f64>> = value.as_array()?.iter().map(Value::as_f64).collect();
    values?.try_into().ok().filter(|v: &[f64; 3]| v.iter().all(|x| x.is_finite()))
}

/// The text of a file with these cells, as the leaves of the tree in order; those without splats are None.
pub fn written(manifest: &Manifest, tree: &Cells, cells: &[Option<Cell>]) -> String {
    let counts = manifest.counts();
    let (_, tree) = node(tree, 0, cells).unwrap_or_else(|| {
        (([0.0; 3], [0.0; 3]), json!({ "bound": bound(&[0.0; 3], &[0.0; 3]), "lods": {} }))
    });
    let files: Vec<String> =
        manifest.files.iter().map(|f| f.to_string_lossy().replace('\\', "/")).collect();
    let mut out = json!({
        "version": 1,
        "asset": { "generator": concat!("igsr ", env!("CARGO_PKG_VERSION")) },
        "count": counts.iter().sum::<usize>(),
        "counts": counts,
        "lodLevels": manifest.levels,
        "lodErrors": true,
        "filenames": files,
        "tree": tree,
    });
    if manifest.origin != [0.0; 3] {
        out["origin"] = json!(manifest.origin);
    }
    out.to_string()
}

type Bound = ([f64; 3], [f64; 3]);

fn node(tree: &Cells, at: usize, cells: &[Option<Cell>]) -> Option<(Bound, Value)> {
    match &tree.nodes[at] {
        Node::Cell(number) => {
            let cell = cells[*number].as_ref()?;
            let mut lods = Map::new();
            for (level, run) in cell.runs.iter().enumerate() {
                if let Some(Run { file, offset, count }) = run {
                    let run = json!({ "file": file, "offset": offset, "count": count });
                    lods.insert(level.to_string(), run);
                }
            }
            let errors: Vec<f64> = cell.errors.iter().map(|&e| rounded(e)).collect();
            let json =
                json!({ "bound": bound(&cell.low, &cell.high), "lods": lods, "errors": errors });
            Some(((cell.low, cell.high), json))
        }
        Node::Split { halves, .. } => {
            let [first, second] = halves.map(|half| node(tree, half, cells));
            // Interior nodes have two children: one alone takes its parent's place.
            let ((a, first), (b, second)) = match (first, second) {
                (Some(first), Some(second)) => (first, second),
                (one, other) => return one.or(other),
            };
            let low = std::array::from_fn(|k| a.0[k].min(b.0[k]));
            let high = std::array::from_fn(|k| a.1[k].max(b.1[k]));
            let json = json!({ "bound": bound(&low, &high), "children": [first, second] });
            Some(((low, high), json))
        }
    }
}

fn bound(low: &[f64; 3], high: &[f64; 3]) -> Value {
    json!({ "min": low.map(rounded), "max": high.map(rounded) })
}

/// To seven digits, as the format has its numbers.
fn rounded(x: f64) -> f64 {
    format!("{x:.6e}").parse().unwrap_or(x)
}
