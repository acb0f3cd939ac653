//! INRIA's `.ply` of 3DGS: one `vertex` element of float properties, binary little-endian.
//!
//! Properties: x y z, nx ny nz (zero), f_dc_0..2, f_rest_* (all red, then green, then blue), opacity
//! (logit), scale_0..2 (logs), rot_0..3 (wxyz). A header line `comment origin X Y Z` holds a nonzero f64
//! origin, and means are then relative to it; `comment SplatRenderMode: mip` marks antialiased opacities.
//! Doubles are read, too, and the 3D filter of Mip-Splatting (Yu et al. 2024, eq. 7), `filter_3D`, is applied.

use std::io::{BufRead, Write};

use super::bytes::{Named, f32_at};
use super::ply_header::{Header, Kind, write_comments};
use super::quantize::{logit, sigmoid};
use super::{Format, Loaded, SplatFile};
use crate::constants::SH_DEGREE_MAX;
use crate::error::Result;
use crate::sh;
use crate::splats::SplatArrays;

/// Column of Mip-Splatting's filter.
pub const FILTER: &str = "filter_3D";
/// For infinite logits and negative infinite log-scales: their sigmoid and exponential are exact in f32.
const INFINITE_LOG: f32 = 80.0;

/// Applies a 3D filter of standard deviation `filter` to a splat.
fn filtered(scales: &mut [f32; 3], opacity: &mut f32, filter: f32) {
    let mut kept = 1.0;
    for scale in scales {
        let variance = (2.0 * f64::from(*scale)).exp();
        let wider = variance + f64::from(filter).powi(2);
        kept *= (variance / wider).sqrt();
        *scale = (0.5 * wider.ln()) as f32;
    }
    *opacity = logit(sigmoid(*opacity) * kept);
}

/// First byte in a row, and whether it is a double.
type Column = (usize, bool);

/// Columns of a splat's numbers in the rows of a `.ply`.
pub struct Rows {
    pub count: usize,
    pub degree: u32,
    xyz: Vec<Column>,
    quat: Vec<Column>,
    scale: Vec<Column>,
    opacity: Vec<Column>,
    dc: Vec<Column>,
    rest: Vec<Column>,
    filter: Option<Column>,
    row: Vec<u8>,
}

impl Rows {
    /// The columns by the header of a file of `size` bytes; allocates nothing large.
    pub fn new(header: &Header, size: u64, named: &Named<'_>) -> Result<Self> {
        let vertex = &header.elements[0];
        if vertex.name != "vertex" {
            return Err(named.bad(format!("starts with '{}' instead of 'vertex'", vertex.name)));
        }
        if vertex.lists {
            return Err(named.bad("holds lists in its vertices; it is a mesh, not splats"));
        }
        let find = |name: &str| {
            let float = vertex.offset(name, Kind::Float).map(|at| (at, false));
            float.or(vertex.offset(name, Kind::Double).map(|at| (at, true)))
        };
        let need = |name: &str| {
            find(name).ok_or_else(|| match name {
                "scale_2" => named.bad("has flat splats of 2DGS; only 3DGS's can be read"),
                _ => named.bad(format!(
                    "has no float property '{name}'; it is not a .ply of Gaussian splats"
                )),
            })
        };
        let columns =
            |names: &[&str]| -> Result<Vec<Column>> { names.iter().map(|n| need(n)).collect() };
        let xyz = columns(&["x", "y", "z"])?;
        let quat = columns(&["rot_0", "rot_1", "rot_2", "rot_3"])?;
        let scale = columns(&["scale_0", "scale_1", "scale_2"])?;
        let opacity = columns(&["opacity"])?;
        let dc = columns(&["f_dc_0", "f_dc_1", "f_dc_2"])?;
        let rest_count = vertex.properties.iter().filter(|p| p.name.starts_with("f_rest_")).count();
        let degree = (0..=SH_DEGREE_MAX)
            .find(|&d| 3 * (sh::coeffs(d) - 1) == rest_count)
            .ok_or_else(|| {
                named.bad(format!(
                    "has {rest_count} f_rest properties, which match no SH degree in 0..=4"
                ))
            })?;
        let rest: Vec<Column> =
            (0..rest_count).map(|k| need(&format!("f_rest_{k}"))).collect::<Result<_>>()?;
        if vertex.size() > size {
            return Err(named.bad(format!(
                "claims {} splats of {} bytes but has only {size} bytes; it is truncated",
                vertex.count, vertex.stride
            )));
        }
        let (count, row) = (vertex.count as usize, vec![0u8; vertex.stride]);
        let filter = find(FILTER);
        Ok(Self { count, degree, xyz, quat, scale, opacity, dc, rest, filter, row })
    }

    /// Reads the next row, of splat `number`, into splat `i`.
    pub fn read(
        &mut self,
        reader: &mut impl BufRead,
        number: usize,
        splats: &mut SplatArrays,
        i: usize,
        named: &Named<'_>,
    ) -> Result<()> {
        reader.read_exact(&mut self.row).map_err(|_| {
            named.bad(format!("ends at splat {number} of {}; it is truncated", self.count))
        })?;
        let at = |(offset, is_double): Column| match is_double {
            false => f32_at(&self.row, offset),
            true => self.row[offset..].first_chunk().map_or(0.0, |&b| f64::from_le_bytes(b) as f32),
        };
        let stride = splats.stride();
        splats.means[i] = std::array::from_fn(|k| at(self.xyz[k]));
        splats.quats[i] = std::array::from_fn(|k| at(self.quat[k]));
        splats.scales[i] = std::array::from_fn(|k| at(self.scale[k]));
        splats.opacities[i] = at(self.opacity[0]);
        if let Some(column) = self.filter {
            filtered(&mut splats.scales[i], &mut splats.opacities[i], at(column));
        }
        // An opacity of 1, and a flat splat, as finite numbers.
        for value in splats.scales[i].iter_mut().chain([&mut splats.opacities[i]]) {
            if *value == f32::NEG_INFINITY {
                *value = -INFINITE_LOG;
            }
        }
        if splats.opacities[i] == f32::INFINITY {
            splats.opacities[i] = INFINITE_LOG;
        }
        splats.sh[i * stride] = std::array::from_fn(|c| at(self.dc[c]));
        for k in 0..stride - 1 {
            splats.sh[i * stride + 1 + k] =
                std::array::from_fn(|c| at(self.rest[c * (stride - 1) + k]));
        }
        Ok(())
    }
}

/// Reads the data of a `.ply` of `size` bytes row by row; checks sizes before allocating.
pub fn read(
    reader: &mut impl BufRead,
    header: &Header,
    size: u64,
    named: &Named<'_>,
) -> Result<Loaded> {
    let mut rows = Rows::new(header, size, named)?;
    let mut splats = SplatArrays::zeros(rows.count, rows.degree);
    for i in 0..rows.count {
        rows.read(reader, i, &mut splats, i, named)?;
    }
    Ok(Loaded {
        file: SplatFile { splats, origin: header.origin, antialiased: header.antialiased },
        format: Format::Ply,
        notes: match rows.filter {
            Some(_) => vec!["the 3D filter of Mip-Splatting is applied to its splats.".to_owned()],
            None => Vec::new(),
        },
    })
}

/// Writes all of `file`: nothing is rounded and nothing left out.
pub fn write(out: &mut impl Write, file: &SplatFile) -> std::io::Result<()> {
    let splats = &file.splats;
    let (stride, per_channel) = (splats.stride(), splats.stride() - 1);
    let mut names: Vec<String> =
        ["x", "y", "z", "nx", "ny", "nz", "f_dc_0", "f_dc_1", "f_dc_2"].map(String::from).into();
    names.extend((0..3 * per_channel).map(|k| format!("f_rest_{k}")));
    names.push("opacity".into());
    names.extend((0..3).map(|k| format!("scale_{k}")));
    names.extend((0..4).map(|k| format!("rot_{k}")));
    write_comments(out, file)?;
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
}
