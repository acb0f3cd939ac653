//! PlayCanvas's compressed `.ply`: 16 bytes a splat, packed against the bounds of its chunk of 256.
//!
//! Element `chunk`: bounds of positions, log-scales and colors, floats. Element `vertex`: four
//! packed u32. Element `sh`, if any: one byte for each coefficient, all red, green, then blue.

use std::io::{BufRead, Read};

use super::bytes::{Bytes, Named, f32_at, u32_at};
use super::limits;
use super::ply_header::{Element, Header, Kind, write_comments};
use super::prepare::{Room, prepare, say_clipped};
use super::quantize::{
    SmallestThree, color_of_dc, dc_of_color, logit_of_byte, opacity_byte, to_f32, to_f64, unit_bits,
};
use super::{Format, Loaded, SplatFile};
use crate::error::Result;
use crate::morton::morton_order;
use crate::sh;
use crate::splats::SplatArrays;

/// Splats that share bounds.
const CHUNK: usize = 256;
/// SH coefficients are in plus or minus half of this.
const SH_RANGE: f64 = 8.0;
const SH_DEGREE: u32 = 3;
/// Maximum magnitude of a log-scale in the bounds, as clamped by the format's own writers.
const SCALE_MAX: f32 = 20.0;

const ROOM: Room =
    Room { name: "compressed .ply", sh_degree: SH_DEGREE, origin: true, antialiased: true };
const PACKED: [&str; 4] = ["packed_position", "packed_rotation", "packed_scale", "packed_color"];
const BOUNDS: [[&str; 6]; 3] = [
    ["min_x", "min_y", "min_z", "max_x", "max_y", "max_z"],
    ["min_scale_x", "min_scale_y", "min_scale_z", "max_scale_x", "max_scale_y", "max_scale_z"],
    ["min_r", "min_g", "min_b", "max_r", "max_g", "max_b"],
];

/// Columns of the six bounds of one kind in a row of `chunk`.
type Columns = [usize; 6];

fn columns<const N: usize>(
    element: &Element,
    names: &[&str; N],
    kind: Kind,
    named: &Named<'_>,
) -> Result<[usize; N]> {
    let mut offsets = [0; N];
    for (offset, name) in offsets.iter_mut().zip(names) {
        *offset = element.offset(name, kind).ok_or_else(|| {
            named.bad(format!(
                "has no '{name}' in its {}s; it is not a compressed .ply",
                element.name
            ))
        })?;
    }
    Ok(offsets)
}

/// Reads the data after the header.
pub fn read(
    reader: &mut impl BufRead,
    header: &Header,
    size: u64,
    named: &Named<'_>,
) -> Result<Loaded> {
    let (chunk, vertex) = match header.elements.as_slice() {
        [chunk, vertex, ..] if vertex.name == "vertex" => (chunk, vertex),
        _ => {
            return Err(
                named.bad("has chunks but no vertices after them; it is not a compressed .ply")
            );
        }
    };
    if header.elements.iter().any(|element| element.lists) {
        return Err(named.bad("holds lists, which a compressed .ply cannot have"));
    }
    let sh = header.elements.get(2).filter(|element| element.name == "sh");
    let wanted =
        chunk.size().saturating_add(vertex.size()).saturating_add(sh.map_or(0, Element::size));
    if wanted > size {
        return Err(named.bad(format!(
            "claims {} splats in {wanted} bytes but has only {size} bytes; it is truncated",
            vertex.count
        )));
    }
    limits::check_file_size(named, size)?;
    if chunk.count != vertex.count.div_ceil(CHUNK as u64) {
        return Err(named.bad(format!(
            "has {} chunks for {} splats, but a chunk has {CHUNK}; it is damaged",
            chunk.count, vertex.count
        )));
    }
    let position = columns(chunk, &BOUNDS[0], Kind::Float, named)?;
    let scale = columns(chunk, &BOUNDS[1], Kind::Float, named)?;
    // Older files have no bounds of colors: those are then in [0, 1].
    let color = match chunk.offset(BOUNDS[2][0], Kind::Float) {
        Some(_) => Some(columns(chunk, &BOUNDS[2], Kind::Float, named)?),
        None => None,
    };
    let packed = columns(vertex, &PACKED, Kind::Uint, named)?;
    let (degree, rest) = match sh {
        Some(sh) => rest_columns(sh, vertex.count, named)?,
        None => (0, Vec::new()),
    };
    let n = limits::check_claim(named, vertex.count, degree, size as usize)?;

    let mut bytes = Vec::new();
    reader
        .take(wanted)
        .read_to_end(&mut bytes)
        .map_err(|e| named.bad(format!("cannot be read ({e})")))?;
    let mut bytes = Bytes::new(&bytes, named);
    let chunks = bytes.take_rows(chunk.count as usize, chunk.stride, "chunks")?;
    let vertices = bytes.take_rows(n, vertex.stride, "vertices")?;
    let mut splats = SplatArrays::zeros(n, degree);
    let stride = splats.stride();
    for i in 0..n {
        let bounds = &chunks[i / CHUNK * chunk.stride..][..chunk.stride];
        let row = &vertices[i * vertex.stride..][..vertex.stride];
        let [p, q, s, c] = packed.map(|offset| u32_at(row, offset));
        splats.means[i] = to_f32(within(bounds, &position, unpack_11_10_11(p)));
        splats.scales[i] = to_f32(within(bounds, &scale, unpack_11_10_11(s)));
        splats.quats[i] = to_f32(unpack_rotation(q));
        let [r, g, b, opacity] = c.to_be_bytes();
        let unit = [r, g, b].map(|byte| f64::from(byte) / 255.0);
        let rgb = color.map_or(unit, |color| within(bounds, &color, unit));
        splats.sh[i * stride] = rgb.map(dc_of_color);
        splats.opacities[i] = logit_of_byte(opacity);
    }
    if let Some(sh) = sh {
        let rows = bytes.take_rows(n, sh.stride, "spherical harmonics")?;
        for i in 0..n {
            let row = &rows[i * sh.stride..][..sh.stride];
            for k in 1..stride {
                splats.sh[i * stride + k] =
                    std::array::from_fn(|c| unpack_sh(row[rest[c * (stride - 1) + k - 1]]));
            }
        }
    }
    Ok(Loaded {
        file: SplatFile { splats, origin: header.origin, antialiased: header.antialiased },
        format: Format::CompressedPly,
        notes: Vec::new(),
    })
}

/// The degree of the element `sh`, and the column of each `f_rest_k` in its rows.
fn rest_columns(sh: &Element, count: u64, named: &Named<'_>) -> Result<(u32, Vec<usize>)> {
    if sh.count != count {
        return Err(named.bad(format!(
            "has spherical harmonics of {} splats but {count} splats; it is damaged",
            sh.count
        )));
    }
    let rest = sh.properties.len();
    let degree = (1..=SH_DEGREE).find(|&d| 3 * (sh::coeffs(d) - 1) == rest).ok_or_else(|| {
        named.bad(format!("has {rest} f_rest properties, which match no SH degree in 1..=3"))
    })?;
    let offsets = (0..rest)
        .map(|k| {
            let name = format!("f_rest_{k}");
            sh.offset(&name, Kind::Uchar).ok_or_else(|| {
                named.bad(format!("has no byte property '{name}'; it is not a compressed .ply"))
            })
        })
        .collect::<Result<_>>()?;
    Ok((degree, offsets))
}

/// The point at `unit` of [0, 1]^3 between the bounds at `columns`.
fn within(bounds: &[u8], columns: &Columns, unit: [f64; 3]) -> [f64; 3] {
    std::array::from_fn(|k| {
        let low = f64::from(f32_at(bounds, columns[k]));
        let high = f64::from(f32_at(bounds, columns[k + 3]));
        low * (1.0 - unit[k]) + high * unit[k]
    })
}

fn unpack_11_10_11(packed: u32) -> [f64; 3] {
    [
        f64::from(packed >> 21) / 2047.0,
        f64::from(packed >> 11 & 1023) / 1023.0,
        f64::from(packed & 2047) / 2047.0,
    ]
}

fn pack_11_10_11(unit: [f64; 3]) -> u32 {
    unit_bits(unit[0], 11) << 21 | unit_bits(unit[1], 10) << 11 | unit_bits(unit[2], 11)
}

fn unpack_rotation(packed: u32) -> [f64; 4] {
    let others = [packed >> 20 & 1023, packed >> 10 & 1023, packed & 1023]
        .map(|bits| (f64::from(bits) / 1023.0 - 0.5) * std::f64::consts::SQRT_2);
    SmallestThree { largest: (packed >> 30) as usize, others }.quat()
}

fn pack_rotation(quat: [f32; 4]) -> u32 {
    let three = SmallestThree::of(to_f64(quat));
    three.others.iter().fold(three.largest as u32, |packed, c| {
        packed << 10 | unit_bits(c / std::f64::consts::SQRT_2 + 0.5, 10)
    })
}

fn unpack_sh(byte: u8) -> f32 {
    // The outermost bytes decode to the ends of the range, inner bytes to the middle of a step.
    let unit = match byte {
        0 => 0.0,
        255 => 1.0,
        byte => (f64::from(byte) + 0.5) / 256.0,
    };
    ((unit - 0.5) * SH_RANGE) as f32
}

fn pack_sh(coefficient: f32) -> u8 {
    ((f64::from(coefficient) / SH_RANGE + 0.5) * 256.0).floor() as u8
}

/// The whole file. Splats are put in Morton's order, without which chunks would be large.
pub fn encode(file: &SplatFile, notes: &mut Vec<String>) -> Vec<u8> {
    let prepared = prepare(file, &ROOM, notes);
    let mut splats = prepared.select(&morton_order(&prepared.means));
    let scales = splats.scales.as_flattened_mut();
    say_clipped(
        notes,
        scales.iter().filter(|s| s.abs() > SCALE_MAX).count(),
        "log-scale",
        &format!("{SCALE_MAX}"),
    );
    for scale in scales {
        *scale = scale.clamp(-SCALE_MAX, SCALE_MAX);
    }
    let (n, stride) = (splats.len(), splats.stride());
    let rest = 3 * (stride - 1);

    let mut out = Vec::with_capacity(4096 + n * (16 + rest) + n / CHUNK * 72);
    let mut head = || -> std::io::Result<()> {
        use std::io::Write;
        write_comments(&mut out, file)?;
        writeln!(out, "element chunk {}", n.div_ceil(CHUNK))?;
        for name in BOUNDS.as_flattened() {
            writeln!(out, "property float {name}")?;
        }
        writeln!(out, "element vertex {n}")?;
        for name in PACKED {
            writeln!(out, "property uint {name}")?;
        }
        if rest > 0 {
            writeln!(out, "element sh {n}")?;
            for k in 0..rest {
                writeln!(out, "property uchar f_rest_{k}")?;
            }
        }
        writeln!(out, "end_header")
    };
    // Writing to memory does not fail.
    let _ = head();

    let colors: Vec<[f32; 3]> =
        splats.sh.iter().step_by(stride).map(|dc| dc.map(|c| color_of_dc(c) as f32)).collect();
    let mut vertices = Vec::with_capacity(16 * n);
    for start in (0..n).step_by(CHUNK) {
        let ids = start..(start + CHUNK).min(n);
        let position = Bounds::of(&splats.means[ids.clone()]);
        let scale = Bounds::of(&splats.scales[ids.clone()]);
        let color = Bounds::of(&colors[ids.clone()]);
        for bounds in [&position, &scale, &color] {
            for value in bounds.low.iter().chain(&bounds.high) {
                out.extend(value.to_le_bytes());
            }
        }
        for i in ids {
            let rgb = color.unit(colors[i]).map(|c| unit_bits(c, 8) as u8);
            let opacity = opacity_byte(splats.opacities[i]);
            for packed in [
                pack_11_10_11(position.unit(splats.means[i])),
                pack_rotation(splats.quats[i]),
                pack_11_10_11(scale.unit(splats.scales[i])),
                u32::from_be_bytes([rgb[0], rgb[1], rgb[2], opacity]),
            ] {
                vertices.extend(packed.to_le_bytes());
            }
        }
    }
    out.extend(vertices);
    let mut clipped = 0;
    for row in splats.sh.chunks_exact(stride) {
        for c in 0..3 {
            for rgb in &row[1..] {
                clipped += usize::from(f64::from(rgb[c].abs()) > SH_RANGE / 2.0);
                out.push(pack_sh(rgb[c]));
            }
        }
    }
    say_clipped(notes, clipped, "SH coefficient", &format!("{}", SH_RANGE / 2.0));
    out
}

/// Bounds of the splats of a chunk.
struct Bounds {
    low: [f32; 3],
    high: [f32; 3],
}

impl Bounds {
    fn of(rows: &[[f32; 3]]) -> Self {
        let fold = |start: f32, pick: fn(f32, f32) -> f32| {
            std::array::from_fn(|k| rows.iter().fold(start, |value, row| pick(value, row[k])))
        };
        Self { low: fold(f32::INFINITY, f32::min), high: fold(f32::NEG_INFINITY, f32::max) }
    }

    /// Position of `row` between the bounds, 0 to 1; 0 if they coincide.
    fn unit(&self, row: [f32; 3]) -> [f64; 3] {
        std::array::from_fn(|k| {
            let (low, high) = (f64::from(self.low[k]), f64::from(self.high[k]));
            if high > low { (f64::from(row[k]) - low) / (high - low) } else { 0.0 }
        })
    }
}
