//! Reads the splats of a fit in progress from a checkpoint of `igsr fit`, an uncompressed `.npz` of numpy
//! arrays.
//!
//! The file is untrusted: nothing compressed is read, and no memory is allocated that the file's own
//! size does not justify.

use std::io::{Read, Seek};
use std::path::Path;

use splat_render::constants::SH_DEGREE_MAX;
use splat_render::fit::SplatArrays;
use splat_render::io::{SplatFile, open_file};
use splat_render::{Error, Result, sh};
use zip::{CompressionMethod, ZipArchive};

/// Longest array header that is read, bytes.
const HEADER_MAX: usize = 4096;

pub fn read_checkpoint(path: &Path) -> Result<SplatFile> {
    let bad = |what: String| {
        Error::file(path, format!("is not a checkpoint of igsr fit ({what}); give its scene.ply"))
    };
    let file = open_file(path)?;
    let mut archive = ZipArchive::new(file).map_err(|e| bad(e.to_string()))?;
    let mut read = |name: &str| read_floats(&mut archive, name).map_err(&bad);
    let (shape, means) = read("means")?;
    let n = shape.first().copied().unwrap_or(0);
    let (quats, scales) = (read("quats")?.1, read("scales")?.1);
    let opacities = read("opacities")?.1;
    let (sh_shape, sh_rows) = read("sh")?;
    let stride = sh_shape.get(1).copied().unwrap_or(0);
    let degree = (0..=SH_DEGREE_MAX).find(|&d| sh::coeffs(d) == stride);
    let sh_degree = degree.ok_or_else(|| bad(format!("{stride} SH coefficients")))?;
    let mut doubles = |name: &str| read_doubles(&mut archive, name).map_err(&bad);
    let (origin, frame) = (doubles("origin")?, doubles("frame")?);
    let is_finite = |values: &[f64]| values.iter().all(|v| v.is_finite());
    let [x, y, z] = origin[..] else { return Err(bad("its origin is missing".to_owned())) };
    if !is_finite(&origin) {
        return Err(bad("its origin is not three finite numbers".to_owned()));
    }
    // The frame of the fit: its origin in the world, and its unit.
    let frame = <[f64; 4]>::try_from(frame).ok().filter(|v| is_finite(v) && v[3] > 0.0);
    let Some([at_x, at_y, at_z, unit]) = frame else {
        return Err(bad("its frame is not three finite numbers and a unit".to_owned()));
    };
    let origin = [at_x + unit * x, at_y + unit * y, at_z + unit * z];
    let longer = |v: f32| (f64::from(v) * unit) as f32;
    let rows = |values: Vec<f32>| values.chunks_exact(3).map(|v| [v[0], v[1], v[2]]).collect();
    let splats = SplatArrays {
        means: rows(means.into_iter().map(longer).collect()),
        quats: quats.chunks_exact(4).map(|v| [v[0], v[1], v[2], v[3]]).collect(),
        scales: rows(scales.into_iter().map(|v| v + unit.ln() as f32).collect()),
        opacities,
        sh: rows(sh_rows),
        sh_degree,
    };
    let lengths = [splats.len(), splats.quats.len(), splats.scales.len(), splats.opacities.len()];
    if lengths != [n; 4] || splats.sh.len() != n * stride {
        return Err(bad("its arrays are of different lengths".to_owned()));
    }
    Ok(SplatFile { splats, origin, antialiased: false })
}

type Reason = String;

fn read_member<R: Read + Seek>(
    archive: &mut ZipArchive<R>,
    name: &str,
    kind: &str,
    size: usize,
) -> std::result::Result<(Vec<usize>, Vec<u8>), Reason> {
    let mut member = archive.by_name(&format!("{name}.npy")).map_err(|e| format!("{name}: {e}"))?;
    if member.compression() != CompressionMethod::Stored {
        return Err(format!("{name} is compressed"));
    }
    let total = member.size();
    let mut head = [0u8; 10];
    member.read_exact(&mut head).map_err(|e| format!("{name}: {e}"))?;
    if &head[..8] != b"\x93NUMPY\x01\x00" {
        return Err(format!("{name} is not a readable array"));
    }
    let length = usize::from(u16::from_le_bytes([head[8], head[9]]));
    if length > HEADER_MAX {
        return Err(format!("{name} has a header of {length} bytes"));
    }
    let mut header = vec![0u8; length];
    member.read_exact(&mut header).map_err(|e| format!("{name}: {e}"))?;
    let header = String::from_utf8_lossy(&header).replace(' ', "");
    if !header.contains(&format!("'descr':'{kind}'")) || !header.contains("'fortran_order':False") {
        return Err(format!("{name} is not an array of {kind}"));
    }
    let shape = header
        .split_once("'shape':(")
        .and_then(|(_, rest)| rest.split_once(')'))
        .map(|(shape, _)| shape.split(',').filter(|s| !s.is_empty()).map(str::parse).collect())
        .unwrap_or_else(|| Ok(Vec::new()))
        .map_err(|e: std::num::ParseIntError| format!("{name}: {e}"))?;
    let shape: Vec<usize> = shape;
    let bytes = shape.iter().try_fold(size, |bytes, &side| bytes.checked_mul(side));
    let there = total.saturating_sub((head.len() + length) as u64);
    if bytes.map(|b| b as u64) != Some(there) {
        return Err(format!("{name} has another size than its header says"));
    }
    let mut data = Vec::new();
    member.take(there).read_to_end(&mut data).map_err(|e| format!("{name}: {e}"))?;
    if data.len() as u64 != there {
        return Err(format!("{name} is cut off"));
    }
    Ok((shape, data))
}

fn read_floats<R: Read + Seek>(
    archive: &mut ZipArchive<R>,
    name: &str,
) -> std::result::Result<(Vec<usize>, Vec<f32>), Reason> {
    let (shape, data) = read_member(archive, name, "<f4", 4)?;
    let values = data.chunks_exact(4).map(|b| f32::from_le_bytes([b[0], b[1], b[2], b[3]]));
    Ok((shape, values.collect()))
}

fn read_doubles<R: Read + Seek>(
    archive: &mut ZipArchive<R>,
    name: &str,
) -> std::result::Result<Vec<f64>, Reason> {
    if archive.index_for_name(&format!("{name}.npy")).is_none() {
        return Ok(Vec::new());
    }
    let (_, data) = read_member(archive, name, "<f8", 8)?;
    let value = |b: &[u8]| b.try_into().map(f64::from_le_bytes).unwrap_or_default();
    Ok(data.chunks_exact(8).map(value).collect())
}
