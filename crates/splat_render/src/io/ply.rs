//! INRIA's `.ply` of 3DGS: one `vertex` element of float properties, binary little-endian.
//!
//! Properties: x y z, nx ny nz (zero), f_dc_0..2, f_rest_* (all red, then green, then blue),
//! opacity (logit), scale_0..2 (logs), rot_0..3 (wxyz). A header line `comment origin X Y Z` holds
//! the f64 origin where it is not zero; means are then relative to it.

use std::fs::File;
use std::io::{BufRead, BufReader, Read, Write};
use std::path::Path;

use super::{SplatFile, write_atomically};
use crate::constants::SH_DEGREE_MAX;
use crate::error::{Error, Result};
use crate::fit::SplatArrays;
use crate::sh;

/// Longest header that is read: real ones are under 3 kB.
const HEADER_MAX: u64 = 1 << 16;
/// Most splats that ids of 32 bits leave room for.
const SPLATS_MAX: u64 = 1 << 30;

/// Bytes of a scalar type, and whether it is a 32-bit float; None if unknown.
fn scalar(name: &str) -> Option<(usize, bool)> {
    Some(match name {
        "char" | "uchar" | "int8" | "uint8" => (1, false),
        "short" | "ushort" | "int16" | "uint16" => (2, false),
        "int" | "uint" | "int32" | "uint32" => (4, false),
        "float" | "float32" => (4, true),
        "double" | "float64" => (8, false),
        _ => return None,
    })
}

struct Header {
    count: u64,
    stride: usize,
    /// Name and byte offset of every float property.
    floats: Vec<(String, usize)>,
    origin: [f64; 3],
}

impl Header {
    fn read(reader: &mut impl BufRead, bad: &dyn Fn(String) -> Error) -> Result<Self> {
        let mut limited = reader.take(HEADER_MAX);
        let mut line = || -> Result<String> {
            let mut bytes = Vec::new();
            limited
                .read_until(b'\n', &mut bytes)
                .map_err(|e| bad(format!("cannot be read ({e})")))?;
            if bytes.last() != Some(&b'\n') {
                return Err(bad("ends within its header; it is not a whole .ply file".into()));
            }
            Ok(String::from_utf8_lossy(&bytes).trim_end().to_owned())
        };
        if line()? != "ply" {
            return Err(bad("does not start with 'ply'; give a .ply file of splats".into()));
        }
        let mut header = Self { count: 0, stride: 0, floats: Vec::new(), origin: [0.0; 3] };
        let (mut elements, mut format) = (0, false);
        loop {
            let line = line()?;
            let words: Vec<&str> = line.split_whitespace().collect();
            match words.as_slice() {
                ["end_header"] => break,
                ["format", kind, ..] => {
                    format = true;
                    if *kind != "binary_little_endian" {
                        return Err(bad(format!(
                            "is in the format {kind}; only binary_little_endian can be read"
                        )));
                    }
                }
                ["comment", "origin", xyz @ ..] => {
                    let values: Option<Vec<f64>> = xyz.iter().map(|v| v.parse().ok()).collect();
                    header.origin = values
                        .and_then(|v| <[f64; 3]>::try_from(v).ok())
                        .filter(|v| v.iter().all(|c| c.is_finite()))
                        .ok_or_else(|| bad("has an origin that is not three numbers".into()))?;
                }
                ["element", name, count] => {
                    elements += 1;
                    if elements > 1 {
                        // What follows the vertices is of no use here.
                        continue;
                    }
                    if *name != "vertex" {
                        return Err(bad(format!("starts with '{name}' where 'vertex' belongs")));
                    }
                    header.count =
                        count.parse().ok().filter(|&n| n <= SPLATS_MAX).ok_or_else(|| {
                            bad(format!("claims {count} splats; at most 2^30 can be"))
                        })?;
                }
                ["property", "list", ..] if elements <= 1 => {
                    return Err(
                        bad("holds lists in its vertices; it is a mesh, not splats".into()),
                    );
                }
                ["property", kind, name] if elements == 1 => {
                    let (size, float) = scalar(kind)
                        .ok_or_else(|| bad(format!("has a property of unknown type {kind}")))?;
                    if float {
                        header.floats.push(((*name).to_owned(), header.stride));
                    }
                    header.stride += size;
                }
                _ => {}
            }
        }
        if !format || elements == 0 {
            return Err(bad("has no format or no vertex element in its header".into()));
        }
        Ok(header)
    }

    fn offset(&self, name: &str) -> Option<usize> {
        self.floats.iter().find(|(n, _)| n == name).map(|(_, offset)| *offset)
    }
}

/// Reads splats. Sizes are checked against the file's before anything is allocated.
pub fn read_ply(path: &Path) -> Result<SplatFile> {
    let bad = |reason: String| Error::file(path, reason);
    let file = File::open(path).map_err(|e| bad(format!("cannot be opened ({e})")))?;
    let size = file.metadata().map_err(|e| bad(format!("cannot be read ({e})")))?.len();
    let mut reader = BufReader::new(file);
    let header = Header::read(&mut reader, &bad)?;
    let need = |name: String| {
        header.offset(&name).ok_or_else(|| {
            bad(format!("has no float property '{name}'; it is not a .ply of Gaussian splats"))
        })
    };
    let columns = |names: &[&str]| -> Result<Vec<usize>> {
        names.iter().map(|n| need((*n).to_owned())).collect()
    };
    let xyz = columns(&["x", "y", "z"])?;
    let quat = columns(&["rot_0", "rot_1", "rot_2", "rot_3"])?;
    let scale = columns(&["scale_0", "scale_1", "scale_2"])?;
    let opacity = columns(&["opacity"])?;
    let dc = columns(&["f_dc_0", "f_dc_1", "f_dc_2"])?;
    let rest_count = header.floats.iter().filter(|(n, _)| n.starts_with("f_rest_")).count();
    let degree =
        (0..=SH_DEGREE_MAX).find(|&d| 3 * (sh::coeffs(d) - 1) == rest_count).ok_or_else(|| {
            bad(format!("has {rest_count} f_rest properties, which is no SH degree in 0..=4"))
        })?;
    let rest: Vec<usize> =
        (0..rest_count).map(|k| need(format!("f_rest_{k}"))).collect::<Result<_>>()?;
    if header.count * header.stride as u64 > size {
        return Err(bad(format!(
            "claims {} splats of {} bytes but has only {size} bytes; it is truncated",
            header.count, header.stride
        )));
    }

    let n = header.count as usize;
    let mut splats = SplatArrays::zeros(n, degree);
    let (stride, per_channel) = (splats.stride(), splats.stride() - 1);
    let mut row = vec![0u8; header.stride];
    for i in 0..n {
        reader
            .read_exact(&mut row)
            .map_err(|_| bad(format!("ends at splat {i} of {n}; it is truncated")))?;
        let at = |offset: usize| {
            f32::from_le_bytes([row[offset], row[offset + 1], row[offset + 2], row[offset + 3]])
        };
        splats.means[i] = std::array::from_fn(|k| at(xyz[k]));
        splats.quats[i] = std::array::from_fn(|k| at(quat[k]));
        splats.scales[i] = std::array::from_fn(|k| at(scale[k]));
        splats.opacities[i] = at(opacity[0]);
        splats.sh[i * stride] = std::array::from_fn(|c| at(dc[c]));
        for k in 0..per_channel {
            splats.sh[i * stride + 1 + k] = std::array::from_fn(|c| at(rest[c * per_channel + k]));
        }
    }
    Ok(SplatFile { splats, origin: header.origin })
}

/// Writes splats, atomically.
pub fn write_ply(path: &Path, file: &SplatFile) -> Result<()> {
    let SplatFile { splats, origin } = file;
    splats.validate()?;
    let (stride, per_channel) = (splats.stride(), splats.stride() - 1);
    let mut names: Vec<String> =
        ["x", "y", "z", "nx", "ny", "nz", "f_dc_0", "f_dc_1", "f_dc_2"].map(String::from).into();
    names.extend((0..3 * per_channel).map(|k| format!("f_rest_{k}")));
    names.push("opacity".into());
    names.extend((0..3).map(|k| format!("scale_{k}")));
    names.extend((0..4).map(|k| format!("rot_{k}")));
    write_atomically(path, |out| {
        writeln!(out, "ply\nformat binary_little_endian 1.0")?;
        if *origin != [0.0; 3] {
            let [x, y, z] = origin;
            writeln!(out, "comment origin {x:?} {y:?} {z:?}")?;
        }
        writeln!(out, "element vertex {}", splats.len())?;
        for name in &names {
            writeln!(out, "property float {name}")?;
        }
        writeln!(out, "end_header")?;
        let mut row: Vec<f32> = Vec::with_capacity(names.len());
        for i in 0..splats.len() {
            row.clear();
            row.extend(splats.means[i]);
            row.extend([0.0; 3]);
            let sh = &splats.sh[i * stride..(i + 1) * stride];
            row.extend(sh[0]);
            for c in 0..3 {
                row.extend(sh[1..].iter().map(|rgb| rgb[c]));
            }
            row.push(splats.opacities[i]);
            row.extend(splats.scales[i]);
            row.extend(splats.quats[i]);
            for value in &row {
                out.write_all(&value.to_le_bytes())?;
            }
        }
        Ok(())
    })
}
